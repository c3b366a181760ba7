//! Masks in whole pipelines: what is removed, and that the rest computes the same as before.

use crate::common::pipeline;
use conefield_core::pipeline::Model;
use conefield_core::stage::{Stage, Tile, TileMut};
use serde_json::{Value, json};

fn model(normalizers: Value) -> Model {
    let mut model = Model::random(
        pipeline(&json!({
            "encoder": {"type": "dense-grid", "levels": 3, "base_resolution": 3}, "normalizers": normalizers,
            "field": {"type": "mlp", "width": 8}, "projector": "ray-march", "type": "neural-field",
        })),
        5,
    );
    for (i, p) in model.arena.params.iter_mut().enumerate() {
        *p += (i as f32).sin() * 0.2;
    }
    model
}

fn run(stage: &dyn Stage, params: &[f32], x: &[f32], rows: usize) -> Vec<f32> {
    let (mut y, mut tape) = (vec![0.0; stage.info().output * rows], vec![0.0; stage.info().tape * rows]);
    stage.kernel().forward(params, Tile::new(x, rows), TileMut::new(&mut y, rows), TileMut::new(&mut tape, rows));
    y
}

/// Outputs of every stage at some points. `zero` sets channels of the encoder's output to 0.
fn evaluate(model: &Model, points: &[[f32; 3]], zero: &[usize]) -> Vec<Vec<f32>> {
    let n = points.len();
    let mut x: Vec<f32> = (0..3).flat_map(|d| points.iter().map(move |p| p[d])).collect();
    let mut all = vec![];
    for ((_, stage), range) in model.pipeline.stages().into_iter().zip(model.pipeline.ranges()) {
        x = run(stage, &model.arena.params[range.clone()], &x, n);
        if all.is_empty() {
            zero.iter().for_each(|c| x[c * n..(c + 1) * n].fill(0.0));
        }
        all.push(x.clone());
    }
    all
}

fn points() -> Vec<[f32; 3]> {
    (0..50).map(|i| [0.37, 0.61, 0.83].map(|a| (i as f32 * a).fract())).collect()
}

/// Without a normalizer the rest of the pipeline is as if the masked channels were 0.
#[test]
fn masked_channels_count_as_zeros() {
    let mut model = model(json!([]));
    let before = evaluate(&model, &points(), &[2, 3, 5]);
    model.mask(vec![0, 1, 4]).unwrap();
    assert_eq!((model.pipeline.encoder.info().output, model.masks()), (3, &[vec![0, 1, 4]][..]));
    let after = evaluate(&model, &points(), &[]);
    for (a, b) in after[1].iter().zip(&before[1]) {
        assert!((a - b).abs() < 1e-6, "{a} {b}");
    }
}

/// A mask takes whole levels out of the encoder and channels out of the statistics.
#[test]
fn a_mask_removes_levels_and_parameters() {
    let mut model = model(json!(["layer-norm"]));
    let features = evaluate(&model, &points(), &[]).swap_remove(0);
    let old = model.arena.params.len();
    model.mask(vec![0, 1]).unwrap();
    let after = evaluate(&model, &points(), &[]);
    assert_eq!(after[0], features[..2 * points().len()]);
    assert_eq!(model.pipeline.normalizers[0].info().input, 2);
    let names: Vec<_> = model.pipeline.layout().blocks.iter().map(|b| b.name.as_str()).collect();
    assert_eq!(names[..3], ["encoder.0.table", "normalizers.0.weight", "normalizers.0.bias"]);
    assert!(model.arena.params.len() < old / 2);
}

#[test]
fn channels_that_are_not_there_are_refused_and_nothing_changes() {
    let mut model = model(json!([]));
    let old = model.arena.params.clone();
    for keep in [vec![], vec![1, 0], vec![6]] {
        let e = model.mask(keep).unwrap_err().to_string();
        assert!(e.contains("channels 0 to 5"), "{e}");
    }
    assert!(model.masks().is_empty() && *model.arena.params == *old);
}
