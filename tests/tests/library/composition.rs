//! Stages of every kind put together in every way that fits, from JSON alone, and trained; what does not fit is
//! refused in words.

use crate::common::{scan, solve, volume};
use serde_json::{Value, json};

/// With their channels and whether these stand from coarse to fine.
fn encoders() -> Vec<(&'static str, Value, usize, bool)> {
    let hash = |convention: &str| json!({"type": "hash-grid", "convention": convention, "levels": 4, "base_resolution": 3, "log2_table_size": 9});
    let frequency = json!({"type": "frequency", "bands": 3, "max_frequency": 4.0});
    let dense = json!({"type": "dense-grid", "levels": 3, "base_resolution": 3});
    let concat = json!({"type": "concat", "encoders": [{"type": "identity"}, frequency, dense, hash("naf")]});
    vec![
        ("naf", hash("naf"), 8, true),
        ("instant-ngp", hash("instant-ngp"), 8, true),
        ("frequency", frequency, 21, true),
        ("dense", dense, 6, true),
        ("concat", concat, 38, false),
        ("identity", json!({"type": "identity"}), 3, false),
    ]
}

/// Normalizers and masks.
fn chains(width: usize, ordered: bool) -> Vec<[Value; 2]> {
    // 8 views, all of them an epoch: measured at step 16. These encoders are coarse, most channels stay.
    let measured = json!({"type": "fft-mask", "epoch": 2, "scope": if ordered { "finer" } else { "channel" }});
    let given = json!({"type": "fft-mask", "keep": kept(width)});
    let norm = json!({"type": "layer-norm"});
    vec![
        [json!([]), json!([])],
        [json!([norm]), json!([])],
        [json!([]), json!([measured])],
        [json!([norm]), json!([measured])],
        [json!([]), json!([given])],
        [json!([norm]), json!([given])],
    ]
}

/// Every other channel: of each level, wave and part something stays and something goes.
fn kept(width: usize) -> Vec<usize> {
    (0..width).step_by(2).collect()
}

fn projectors() -> Vec<Value> {
    vec![
        json!({"type": "ray-march", "samples": 24, "extent": "clipped", "sampling": "stratified"}),
        json!({"type": "ray-march", "samples": 24, "extent": "published", "sampling": "uniform"}),
        json!({"type": "ray-march", "step_mm": 8.0}),
    ]
}

fn mlp() -> Value {
    json!({"type": "mlp", "width": 16, "depth": 3, "skips": [1]})
}

fn pipeline(encoder: &Value, [normalizers, masks]: &[Value; 2], field: &Value, projector: &Value) -> Value {
    json!({
        "encoder": encoder, "normalizers": normalizers, "field": field, "projector": projector,
        "type": "neural-field", "loss": "l2", "callbacks": masks, "training": {"steps": 30, "rays": 96, "report_every": 5}, "optimizer": {"lr": 0.02},
    })
}

/// Trains: the loss falls to less than half, the volume is finite. Returns how many channels the field reads.
fn learns(name: &str, spec: &Value) -> usize {
    let (solution, records) = solve(spec, &scan()).unwrap_or_else(|e| panic!("{name}: {e}"));
    let (first, last) = (records.first().unwrap().loss.unwrap(), records.last().unwrap().loss.unwrap());
    // A record every five steps, and others between them, so that there are at least ten.
    assert_eq!(solution.steps, 30, "{name}");
    assert!(records.len() >= 10, "{name}: {}", records.len());
    assert!(last < 0.5 * first, "{name}: the loss went from {first} to {last}");
    assert!(volume(&solution).data.iter().all(|x| x.is_finite()), "{name}");
    // A mask in the chain was decided on the way.
    let masks = spec["callbacks"].as_array().unwrap().len();
    let events: Vec<_> = records.iter().flat_map(|r| &r.events).collect();
    assert_eq!(events.len(), masks, "{name}: {events:?}");
    solution.result.field().unwrap().model.pipeline.field.info().input
}

#[test]
fn every_combination_that_fits_learns() {
    for (name, encoder, width, ordered) in encoders() {
        for (c, chain) in chains(width, ordered).iter().enumerate() {
            for (p, projector) in projectors().iter().enumerate() {
                let name = format!("{name}, chain {c}, projector {p}");
                let left = learns(&name, &pipeline(&encoder, chain, &mlp(), projector));
                match c {
                    0 | 1 => assert_eq!(left, width, "{name}"),
                    2 | 3 => assert!((1..=width).contains(&left), "{name}"),
                    _ => assert_eq!(left, kept(width).len(), "{name}"),
                }
            }
        }
    }
}

/// A mask for which a run is too short says so in the last record.
#[test]
fn a_mask_that_is_never_decided_is_reported() {
    let (_, encoder, ..) = encoders().remove(0);
    let mask = json!([{"type": "fft-mask", "epoch": 1000}]);
    let spec = pipeline(&encoder, &[json!([]), mask], &mlp(), &projectors()[0]);
    let (_, records) = solve(&spec, &scan()).unwrap();
    let (last, before) = records.split_last().unwrap();
    assert!(before.iter().all(|r| r.events.is_empty()));
    assert_eq!(last.events.len(), 1);
    let words = ["fft-mask: no channel was evaluated", "ends after 3.75 epochs", "before epoch 1000"];
    assert!(words.iter().all(|w| last.events[0].contains(w)), "{:?}", last.events);
}

#[test]
fn voxels_behind_positions_learn() {
    let grid = json!({"type": "voxel-grid", "resolution": 16});
    for (p, projector) in projectors().iter().enumerate() {
        let mut spec = pipeline(&json!({"type": "identity"}), &[json!([]), json!([])], &grid, projector);
        // Every voxel moves by about the rate a step, from softplus(−2) on.
        spec["optimizer"]["lr"] = json!(0.1);
        learns(&format!("voxels, projector {p}"), &spec);
    }
}

/// The refusal of `spec` holds every one of `words`.
fn refused(spec: &Value, words: &[&str]) {
    let Err(e) = solve(spec, &scan()) else { panic!("{words:?}: not refused") };
    let e = e.to_string();
    assert!(words.iter().all(|w| e.contains(w)), "{e:?} lacks one of {words:?}");
}

/// Zero levels and zero samples are among the extremes.
#[test]
fn what_does_not_fit_is_refused_in_words() {
    let hash = json!({"type": "hash-grid", "levels": 4, "base_resolution": 3, "log2_table_size": 9});
    let none = [json!([]), json!([])];
    let march = &projectors()[0];
    let voxels = json!({"type": "voxel-grid", "resolution": 16});
    refused(&pipeline(&hash, &none, &voxels, march), &["8 channels", "identity"]);
    let drops = [json!([]), json!([{"type": "fft-mask", "keep": [0, 2]}])];
    let spec = pipeline(&json!({"type": "identity"}), &drops, &voxels, march);
    refused(&spec, &["voxel-grid", "all three coordinates"]);
    let good = pipeline(&hash, &none, &mlp(), march);
    for key in ["encoder", "field", "projector", "type"] {
        let mut spec = good.clone();
        spec.as_object_mut().unwrap().remove(key);
        let known = if key == "type" { "neural-field".to_owned() } else { format!("{key} type") };
        refused(&spec, &[key, "nothing", &known]);
    }
    type Change = fn(&mut Value);
    let changes: [(Change, &[&str]); 8] = [
        (|v| v["field"]["skips"] = json!([3]), &["field.skips", "3", "1 to 2"]),
        (|v| v["field"]["skips"] = json!([0]), &["field.skips", "0", "1 to 2"]),
        (|v| v["encoder"] = json!({"type": "dense-grid", "levels": 0}), &["encoder.levels", "found 0", "1 to 32"]),
        (|v| v["encoder"] = json!({"type": "frequency", "bands": 0}), &["encoder.bands", "found 0"]),
        (|v| v["encoder"] = json!({"type": "concat", "encoders": []}), &["encoder.encoders", "a list of 0"]),
        (
            |v| v["encoder"] = json!({"type": "concat", "encoders": [{"type": "hash-grid", "levels": 0}]}),
            &["encoder.encoders.0.levels", "found 0"],
        ),
        (|v| v["field"]["type"] = json!("mlpp"), &["field.type", "mlpp", "mlp"]),
        (|v| v["field"]["widht"] = json!(8), &["field.widht", "width"]),
    ];
    for (change, words) in changes {
        let mut spec = good.clone();
        change(&mut spec);
        refused(&spec, words);
    }
}

/// "All finer channels" needs an order: side by side, encoders have none, nor have coordinates. Frequency bands do.
#[test]
fn finer_channels_without_an_order_are_refused() {
    for (name, encoder, _, ordered) in encoders() {
        let mask = [json!([]), json!([{"type": "fft-mask", "epoch": 1, "scope": "finer"}])];
        let spec = pipeline(&encoder, &mask, &mlp(), &projectors()[0]);
        if ordered {
            learns(name, &spec);
        } else {
            refused(&spec, &["callbacks.0.scope", "coarse to fine", "\"channel\""]);
        }
    }
}
