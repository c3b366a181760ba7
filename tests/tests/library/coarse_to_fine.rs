//! Training whose encoder opens level by level.

use crate::common::{bits, goes_on, model, neural_field, pipeline, planned, psnr, scan};
use conefield_backend_cpu::Cpu;
use conefield_core::backend::Backend;
use conefield_core::method::Job;
use conefield_core::pipeline::Model;
use serde_json::{Value, json};

fn settings(encoder: Value, callbacks: Value) -> Value {
    neural_field(
        12,
        json!({
            "encoder": encoder, "callbacks": callbacks,
            "training": {"steps": 60, "rays": 64, "report_every": 5}, "optimizer": {"lr": 0.02},
        }),
    )
}

fn hash_grid() -> Value {
    json!({"type": "hash-grid", "levels": 4, "base_resolution": 3, "log2_table_size": 8})
}

fn opening(levels: usize, until: f64) -> Value {
    json!([{"type": "rollback"}, {"type": "coarse-to-fine", "levels": levels, "until": until}])
}

/// Closed channels are 0 and learn nothing; open ones are as they were, and so is the arena.
#[test]
fn a_pipeline_opens_and_closes_without_a_trace() {
    let mut model = Model::random(pipeline(&settings(hash_grid(), json!([]))), 3);
    let points: Vec<[f32; 3]> = (0..40).map(|i| [0.1, 0.37, 0.73].map(|k| (i as f32 * k).fract())).collect();
    let encode = |model: &Model| Cpu::new().compile(&model.pipeline).unwrap().0.encode(model, &points).unwrap();
    let (whole, layout) = (encode(&model), model.pipeline.layout().clone());
    model.pipeline.open(4).unwrap();
    assert_eq!(model.pipeline.open_channels(), 4);
    let part = encode(&model);
    let n = points.len();
    assert_eq!(part[..4 * n], whole[..4 * n]);
    assert!(part[4 * n..].iter().all(|y| *y == 0.0) && whole[4 * n..].iter().any(|y| *y != 0.0));
    // A mask counts channels of the whole; what was open stays so.
    let mut masked = Model::random(model.pipeline.clone(), 3);
    masked.mask(vec![0, 3, 5]).unwrap();
    assert_eq!((masked.pipeline.encoder.info().output, masked.pipeline.open_channels()), (3, 2));
    masked.pipeline.open(3).unwrap();
    assert_eq!(encode(&masked)[2 * n..], whole[5 * n..6 * n]);
    model.pipeline.open(8).unwrap();
    assert_eq!((encode(&model), model.pipeline.layout()), (whole, &layout));
}

/// Levels open when they should, for every encoder that has some; what comes out is good and whole.
#[test]
fn levels_open_one_by_one() {
    for encoder in [
        hash_grid(),
        json!({"type": "permutohedral", "levels": 4, "base_resolution": 3, "log2_table_size": 8}),
        json!({"type": "dense-grid", "levels": 4, "base_resolution": 2}),
        json!({"type": "b-spline-grid", "levels": 4, "base_resolution": 2}),
        json!({"type": "planes", "levels": 4, "base_resolution": 3}),
    ] {
        let name = encoder["type"].clone();
        let (found, records) = psnr(&settings(encoder, opening(1, 0.5)), &Cpu::new());
        let events: Vec<(u64, String)> =
            records.iter().flat_map(|r| r.events.iter().map(|e| (r.step, e.clone()))).collect();
        let want = [(5, 1), (15, 2), (25, 3), (35, 4)];
        assert_eq!(events.len(), want.len(), "{name}: {events:?}");
        for ((step, event), (by, open)) in events.iter().zip(want) {
            assert!(*step == by && event.contains(&format!("{open} of 4 levels")), "{name}: {events:?}");
        }
        // An empty volume has 10.8 dB.
        assert!(found > 15.0, "{name}: {found} dB");
    }
}

/// Wherever a run is interrupted, it goes on to the same bits and records.
#[test]
fn a_run_resumes_to_the_same_bits() {
    let ((scan, held), backend) = (scan().split(&[1]).unwrap(), Cpu::new());
    let mut plan = planned(&settings(hash_grid(), opening(2, 0.5)), &backend).unwrap();
    let job = Job { seed: 7, held_out: Some(&held), ..Job::new(&scan, &backend) };
    goes_on(
        plan.as_mut(),
        &job,
        |_| vec![7, 15, 40],
        |solution| {
            let model = model(solution.unwrap());
            assert_eq!(model.pipeline.open_channels(), model.pipeline.encoder.info().output);
            bits(&model.arena.params)
        },
    );
}

#[test]
fn encoders_without_levels_are_refused() {
    for (encoder, levels, words) in [
        (json!({"type": "frequency"}), 1, ["frequency", "tables of features"]),
        (json!({"type": "concat", "encoders": [hash_grid(), {"type": "identity"}]}), 1, ["concat", "coarse to fine"]),
        (hash_grid(), 5, ["callbacks.1.levels", "1 to 4"]),
    ] {
        let e = planned(&settings(encoder, opening(levels, 0.5)), &Cpu::new()).err().unwrap().to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{e}");
    }
}
