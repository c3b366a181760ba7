//! The drift that the callback `drift` logs: what it measures, and what it leaves alone.

use crate::common::{Heard, goes_on, model, neural_field, pipeline, planned, scan, solve, state};
use conefield_backend_cpu::Cpu;
use conefield_core::Result;
use conefield_core::backend::Backend;
use conefield_core::checkpoint::Resume;
use conefield_core::host;
use conefield_core::method::{DriftRecord, Job, Record};
use conefield_core::pipeline::Model;
use conefield_core::scene::{Scene, SceneSettings};
use conefield_solvers::training::callbacks::Drift;
use conefield_solvers::training::{CallbackSpec, Run};
use serde_json::{Value, json};
use std::sync::Arc;

/// 40 steps over 8 views: 5 epochs.
fn settings() -> Value {
    let mut all = neural_field(
        12,
        json!({
            "callbacks": [{"type": "rollback"}, {"type": "drift", "every": 1.5, "points": 300}],
            "training": {"steps": 40, "rays": 64, "report_every": 5}, "optimizer": {"lr": 0.02},
        }),
    );
    all["field"]["output"] = json!("none");
    all
}

fn with(path: &str, value: Value) -> Value {
    let mut all = settings();
    *all.pointer_mut(path).unwrap() = value;
    all
}

/// With a mask after two epochs.
fn masked() -> Value {
    let mut all = settings();
    let mask = json!({"type": "fft-mask", "epoch": 2, "threshold": 1e-6});
    all["callbacks"].as_array_mut().unwrap().push(mask);
    all
}

fn drift(records: &[Record]) -> Vec<DriftRecord> {
    records.iter().flat_map(|r| r.drift.clone()).collect()
}

fn events(records: &[Record]) -> Vec<String> {
    records.iter().flat_map(|r| r.events.clone()).collect()
}

#[test]
fn stages_on_the_host_compute_what_the_backend_does() {
    let model = Model::random(pipeline(&settings()), 3);
    let (mut exe, _) = Cpu::new().compile(&model.pipeline).unwrap();
    // More than a tile of rows, and not a whole number of tiles.
    let points: Vec<[f32; 3]> = (0..300).map(|i| [0.1, 0.37, 0.73].map(|k| (i as f32 * k).fract())).collect();
    let mut expected = vec![0.0; points.len()];
    exe.evaluate(&model, &points, &mut expected).unwrap();
    let features = exe.encode(&model, &points).unwrap();
    assert_eq!(host::attenuation(&model, &features, points.len()).unwrap(), expected);
    let normal = host::normalize(&model, &features, points.len()).unwrap();
    assert_eq!(normal.len(), features.len());
    for row in [0, 255, 256, 299] {
        let mean: f32 = normal.chunks_exact(300).map(|c| c[row]).sum::<f32>() / 6.0;
        assert!(mean.abs() < 1e-5, "{mean}");
    }
    let e = host::normalize(&model, &features[1..], points.len()).unwrap_err().to_string();
    assert!(e.contains("1799") && e.contains("6 channels"), "{e}");
}

#[test]
fn a_field_that_moves_by_a_known_amount_drifts_by_it() {
    let (scan, cpu) = (scan(), Cpu::new());
    let scene = Scene::new(&scan, &SceneSettings::default()).unwrap();
    let model = Model::random(pipeline(&settings()), 3);
    let exe = cpu.compile(&model.pipeline).unwrap().0;
    let job = Job { seed: 3, ..Job::new(&scan, &cpu) };
    let mut heard = Heard::default();
    let mut run = Run::new(&job, &scene, &mut heard, model, exe);
    run.steps_an_epoch = 4;
    let mut callback = Drift { every: 2.0, points: 500 }.build().unwrap();
    callback.begin(&mut run).unwrap();
    let mut look = |step: u64, run: &mut Run<'_>| {
        for step in [step, step, step + 1] {
            run.step = step;
            callback.between_steps(run).unwrap();
        }
        std::mem::take(&mut run.tally.window.drift)
    };
    assert_eq!(look(0, &mut run), []);
    // The last bias alone adds to every attenuation.
    let last = run.model.arena.params.len() - 1;
    run.model.arena.params[last] += 0.25;
    let found = look(8, &mut run);
    assert!(found.len() == 1 && (found[0].mean_l1 - 0.25).abs() < 1e-6, "{found:?}");
    assert_eq!((found[0].from_step, found[0].step, found[0].epoch), (0, 8, 2.0));
    // Against the last recording, not the first.
    assert_eq!(look(16, &mut run)[0].mean_l1, 0.0);
    // The encoder is not within what is evaluated again; a LayerNorm is.
    let ranges = run.model.pipeline.ranges().to_vec();
    run.model.arena.params[ranges[0].clone()].iter_mut().for_each(|p| *p = 1.0 - *p);
    assert_eq!(look(24, &mut run)[0].mean_l1, 0.0);
    run.model.arena.params[ranges[1].clone()].iter_mut().for_each(|p| *p += 0.5);
    assert!(look(32, &mut run)[0].mean_l1 > 1e-3);
    assert!(run.tally.window.events.is_empty());
}

#[test]
fn drift_is_logged_where_it_is_asked_for_and_changes_nothing() {
    let scan = scan();
    let (solution, records) = solve(&settings(), &scan).unwrap();
    let found = drift(&records);
    let steps: Vec<[u64; 2]> = found.iter().map(|d| [d.from_step, d.step]).collect();
    assert_eq!(steps, [[0, 12], [12, 24], [24, 36]]);
    assert!(found.iter().all(|d| d.mean_l1 > 0.0 && d.mean_l1.is_finite()), "{found:?}");
    assert!((found[1].epoch - 3.0).abs() < 1e-12);
    let (plain, without) = solve(&with("/callbacks", json!([{"type": "rollback"}])), &scan).unwrap();
    assert!(drift(&without).is_empty() && !serde_json::to_string(&without[0]).unwrap().contains("drift"));
    assert_eq!(*model(solution).arena.params, *model(plain).arena.params);
    // A rate too small to change a number leaves nothing to see.
    let (_, still) = solve(&with("/optimizer/lr", json!(1e-30)), &scan).unwrap();
    assert!(drift(&still).iter().all(|d| d.mean_l1 == 0.0) && drift(&still).len() == 3);
}

#[test]
fn an_interval_in_which_channels_are_masked_has_no_drift() {
    let (solution, records) = solve(&masked(), &scan()).unwrap();
    assert_eq!(model(solution).masks().len(), 1, "nothing was masked");
    let steps: Vec<u64> = drift(&records).iter().map(|d| d.step).collect();
    assert_eq!(steps, [12, 36]);
    let said = events(&records);
    assert!(said.iter().any(|e| e.contains("no drift from step 12 to 24")), "{said:?}");
}

/// What a run that is interrupted after step 14 goes on from.
fn stopped() -> Resume {
    let (scan, cpu, mut heard) = (scan(), Cpu::new(), Heard::until(14));
    let job = Job { seed: 7, ..Job::new(&scan, &cpu) };
    assert!(planned(&settings(), &cpu).unwrap().run(&job, &mut heard).is_err());
    heard.kept.unwrap()
}

fn resumed(value: &Value, resume: &Resume) -> Result<()> {
    let (scan, cpu) = (scan(), Cpu::new());
    let job = Job { seed: 7, resume: Some(resume), ..Job::new(&scan, &cpu) };
    planned(value, &cpu)?.run(&job, &mut Heard::default()).map(drop)
}

#[test]
fn a_resumed_run_finds_the_same_drift_to_the_bit() {
    let (scan, cpu) = (scan(), Cpu::new());
    for settings in [settings(), masked()] {
        let mut plan = planned(&settings, &cpu).unwrap();
        let job = Job { seed: 7, ..Job::new(&scan, &cpu) };
        // Between two looks, at one, after a mask that spoilt the recording, and before any.
        let steps = |_: &_| vec![5, 12, 14, 18, 24];
        let (_, records) = goes_on(plan.as_mut(), &job, steps, |solution| state(&model(solution.unwrap()).arena));
        assert!(!drift(&records).is_empty());
    }
}

#[test]
fn a_recording_of_another_shape_is_refused() {
    let mut resume = stopped();
    let features = Arc::make_mut(&mut resume.weights).tensors.remove("drift.features").unwrap();
    let refused = |resume: &Resume, words: &[&str]| {
        let e = resumed(&settings(), resume).unwrap_err().to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{e}");
    };
    refused(&resume, &["kept", "drift.features", "nothing", "[6, 300]"]);
    Arc::make_mut(&mut resume.weights).tensors.insert("drift.features".into(), (vec![300, 6], features.1));
    refused(&resume, &["drift.features", "[300, 6]", "[6, 300]"]);
}

/// State that is missing or that nothing takes is refused with the name of whose it is.
#[test]
fn a_checkpoint_of_other_callbacks_is_refused() {
    let kept = stopped();
    let refused = |settings: &Value, resume: &Resume, words: &[&str]| {
        let e = resumed(settings, resume).unwrap_err().to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{e}");
    };
    refused(&with("/callbacks", json!([{"type": "rollback"}])), &kept, &["kept: drift", "field-monitor, rollback"]);
    refused(&masked(), &kept, &["kept: fft-mask", "nothing"]);
    let mut more = kept.clone();
    Arc::make_mut(&mut more.weights).tensors.insert("drift.more".into(), (vec![1], vec![0.0]));
    refused(&settings(), &more, &["kept: drift.more", "only what this run keeps"]);
    let mut other = kept.clone();
    other.standing.method["callbacks"]["rollback"] = json!({"level": 1.0});
    refused(&settings(), &other, &["kept: rollback", "missing field"]);
    assert!(resumed(&settings(), &kept).is_ok());
}

#[test]
fn times_and_sizes_that_are_none_are_refused() {
    for (mut drift, word) in [
        (json!({"every": 0.0}), "callbacks.0.every"),
        (json!({"every": -1.0}), "callbacks.0.every"),
        (json!({"points": 0}), "callbacks.0.points"),
        (json!({"points": 65537}), "65536"),
        (json!({"epochs": 3}), "epochs"),
    ] {
        drift["type"] = json!("drift");
        let said = planned(&with("/callbacks", json!([drift])), &Cpu::new()).err().unwrap().to_string();
        assert!(said.contains(word), "{said}");
    }
}
