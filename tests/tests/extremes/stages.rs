//! Stages at the edge of their settings and inputs.

use crate::case::{Case, Ends, Seen};
use crate::common::apart;
use crate::growth::Pair;
use crate::scans::with;
use conefield_core::settings::{EncoderSpec, NormalizerSpec};
use conefield_core::stage::Normalizer;
use serde_json::{Value, json};

fn levels(levels: usize, growth: f64, base: u32) -> impl FnOnce(&mut Value) + Send {
    move |v| {
        v["encoder"] = json!({"type": "hash-grid", "levels": levels, "growth": growth, "base_resolution": base,
                              "log2_table_size": 8, "features": 2});
    }
}

pub fn sizes() -> Vec<Case> {
    let trains = "finite, better than nothing";
    let mut all = vec![];
    for (n, growth) in [(1, 2.0), (20, 2.0), (32, 1.0), (32, 1.5)] {
        let cells = 16.0 * f64::powi(growth, n as i32 - 1);
        let what = format!("levels: {n}, {cells:.0} cells a side on the finest");
        all.push(Case::right(what, trains, move || with(levels(n, growth, 16))));
    }
    for (n, growth) in [(21, 2.0), (29, 2.0), (32, 2.0), (32, 16.0)] {
        let finest = (16.0 * f64::powi(growth, n as i32 - 1)).log2();
        let what = format!("levels: {n}, 2^{finest:.0} cells a side on the finest");
        all.push(Case::refused(what, &["encoder.levels", "2^23 cells per side"], move || with(levels(n, growth, 16))));
    }
    for (n, words) in [(0, &["encoder.levels: found 0"][..]), (33, &["encoder.levels: found 33"])] {
        all.push(Case::refused(format!("levels: {n}"), words, move || with(levels(n, 1.1, 16))));
    }
    for cells in [16, 1 << 10, 1 << 16, 1 << 20] {
        let what = format!("features of a level of {cells} cells a side");
        all.push(Case::right(what, "position off by 2^-24 of the cube at most", move || grid(cells)));
    }
    for bits in [4, 10, 19] {
        let set = move |v: &mut Value| v["encoder"]["log2_table_size"] = json!(bits);
        all.push(Case::right(format!("tables of 2^{bits}"), trains, move || with(set)));
    }
    for bits in [3, 29] {
        let set = move |v: &mut Value| v["encoder"]["log2_table_size"] = json!(bits);
        let what = format!("tables of 2^{bits}");
        all.push(Case::refused(what, &["encoder.log2_table_size", "4 to 28"], move || with(set)));
    }
    for width in [1, 2, 512] {
        let set = move |v: &mut Value| {
            v["field"]["width"] = json!(width);
            v["training"]["steps"] = json!(if width > 100 { 4 } else { 300 });
            v["optimizer"]["lr"] = json!(1e-2);
        };
        let case = Case::right(format!("MLP of width {width}"), "finite, or said to be for nothing", move || with(set));
        all.push(case.ends(Ends::Any));
    }
    let set = |v: &mut Value| v["field"]["width"] = json!(0);
    all.push(Case::refused("MLP of width 0", &["field.width"], move || with(set)));
    all
}

/// Features of one level against double precision: a position is rounded to 2⁻²⁴ of the cube, and with it by 2⁻²⁴ times
/// the resolution in cells, over which a feature changes by what neighbours differ.
fn grid(cells: u32) -> conefield_core::Result<Seen> {
    let spec: Box<dyn EncoderSpec> = serde_json::from_value(
        json!({"type": "hash-grid", "levels": 1, "base_resolution": cells, "log2_table_size": 12}),
    )
    .unwrap();
    let stage = spec.build()?;
    let e = Pair::new(stage.as_ref(), Some(0.5), 0.0..1.0, 200, 3).errors().outputs;
    let limit = 1e-6 + 6.0 * 2f64.powi(-24) * f64::from(cells);
    let wrong = (e > limit).then(|| format!("more than {limit:.1e}"));
    Ok(Seen { figure: format!("{e:.1e}"), reference: "double precision".into(), wrong, ..Seen::default() })
}

pub fn large() -> Vec<Case> {
    let set = |v: &mut Value| {
        v["encoder"] =
            json!({"type": "hash-grid", "levels": 1, "features": 1, "base_resolution": 1024, "log2_table_size": 24});
        v["training"]["steps"] = json!(5);
    };
    vec![Case::right("tables of 2^24", "finite, or said to be for nothing", move || with(set)).ends(Ends::Any)]
}

pub fn samples() -> Vec<Case> {
    let mut all = vec![];
    for n in [1, 2, 8192] {
        let set = move |v: &mut Value| {
            v["projector"]["samples"] = json!(n);
            v["training"]["steps"] = json!(if n > 1000 { 3 } else { 120 });
        };
        let what = if n == 1 { "1 sample a ray".to_owned() } else { format!("{n} samples a ray") };
        all.push(Case::right(what, "finite, or said to be for nothing", move || with(set)).ends(Ends::Any));
    }
    for n in [0, 65_537] {
        let set = move |v: &mut Value| v["projector"]["samples"] = json!(n);
        all.push(Case::refused(format!("{n} samples a ray"), &["projector.samples", "1 to 65536"], move || with(set)));
    }
    for step in [1e-12, 1e12] {
        let set = move |v: &mut Value| {
            v["projector"] = json!({"type": "ray-march", "step_mm": step});
            v["training"]["steps"] = json!(1);
            v["training"]["rays"] = json!(2);
        };
        all.push(
            Case::right(format!("a sample every {step:e} mm"), "bounded in number, finite", move || with(set))
                .ends(Ends::Any),
        );
    }
    all
}

fn norm(width: usize) -> Box<dyn Normalizer> {
    let spec: Box<dyn NormalizerSpec> = serde_json::from_value(json!({"type": "layer-norm"})).unwrap();
    spec.build(width).unwrap()
}

pub fn layer_norm() -> Vec<Case> {
    // A variance below its rounding leaves no slope in single precision: there the gradient's limit is all of it.
    let within = |what: &str, width: usize, x: Vec<f32>, slope: f64| {
        let expected = match slope {
            s if s < 1.0 => "finite; outputs and gradients to 1e-5 of double precision",
            _ => "finite; outputs to 1e-5 of double precision, no gradient",
        };
        Case::right(what, expected, move || {
            let stage = norm(width);
            let errors = Pair::new(stage.as_ref(), None, -1.0..1.0, 1, 5).at(x).errors();
            let far = errors.outputs > 1e-5 || errors.inputs > slope || errors.params > 1e-5;
            let wrong = (far || !errors.finite).then(|| "too far".to_owned());
            let figure = format!("outputs {:.1e}, input gradient {:.1e}", errors.outputs, errors.inputs);
            Ok(Seen { figure, reference: "double precision".into(), wrong, ..Seen::default() })
        })
    };
    let case = |what: &str, width: usize, x: Vec<f32>| within(what, width, x, 1e-5);
    let signs = |v: f32| (0..8).map(|c| if c % 2 == 0 { v } else { -v }).collect::<Vec<f32>>();
    let mut all = vec![
        case("8 equal channels of 0.1", 8, vec![0.1; 8]),
        within("8 equal channels of 1e30", 8, vec![1e30; 8], 1.0),
        case("1 channel of 3", 1, vec![3.0]),
        case("1 channel of 1e-30", 1, vec![1e-30]),
        case("one channel of 1e30 among zeros", 8, [vec![1e30], vec![0.0; 7]].concat()),
        case("a difference of 1e-4 on 1000", 8, (0..8).map(|c| 1000.0 + 1.2207e-4 * c as f32).collect()),
    ];
    for v in [1e-40, 1e-30, 1e-10, 1e10, 1e30, 3e38] {
        all.push(case(&format!("channels of ± {v:e}"), 8, signs(v)));
    }
    all
}

pub fn masks() -> Vec<Case> {
    let masked = |mask: Value| {
        move |v: &mut Value| {
            v["callbacks"] = json!([{"type": "rollback"}, mask]);
        }
    };
    let all = json!({"type": "fft-mask", "epoch": 0, "threshold": 1e-9, "scope": "channel"});
    let finer = json!({"type": "fft-mask", "epoch": 0, "threshold": 1e-9, "scope": "finer"});
    let none = json!({"type": "fft-mask", "keep": []});
    vec![
        Case::right("every channel counts as noise", "the first stays, trains on", move || with(masked(all))),
        Case::right("the first and all finer count as noise", "the first stays, trains on", move || {
            with(masked(finer))
        }),
        Case::refused("no channel is to be kept", &["callbacks.1.keep", "[]"], move || with(masked(none))),
    ]
}

#[test]
fn errors_are_found() {
    let exact = [1.0f64, 2.0];
    assert!(apart(&[1.0, 2.0], &exact) == 0.0 && apart(&[1.0, 2.02], &exact) > 0.009);
    assert!(apart(&[f32::NAN, 2.0], &exact).is_infinite());
}
