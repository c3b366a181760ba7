//! Every registered stage type through the conformance kit: with the settings of its registration, so that a new type is
//! tried without a word here, and built-in ones with more settings.

mod device;

use conefield_conformance::{Options, Report, Unmet, With, check_encoder, check_settings, check_type, check_wgsl};
use conefield_core::opened::Opened;
use conefield_core::registry::read;
use conefield_core::registry::{Kind, stage_types};
use conefield_core::runner::Runner;
use conefield_core::settings::{EncoderSpec, InitializerSpec, LossSpec, PriorSpec};
use conefield_core::spec::{load, schema};
use conefield_core::{Result, arena::Weights};
use serde_json::{Value, json};
use std::sync::Arc;

// Stage types register themselves where their crate is linked.
use conefield_encoders as _;
use conefield_fields as _;
use conefield_projectors as _;
use conefield_solvers as _;

fn expect(report: Report) {
    println!("{report}");
    assert!(report.passed(), "{report}\nfails {:?}", report.failed());
}

/// Checks a stage with these settings, on a device too if there is one. Returns the descriptions of those checked.
fn try_check(kind: Kind, settings: &Value, width: usize, options: &dyn Fn(Options) -> Options) -> Result<Vec<String>> {
    let shared = device::shared("the WGSL of stages");
    let device = || shared.map(|shared| shared as &dyn Runner).ok_or_else(|| "no adapter".into());
    let found = check_type(kind, settings, &With { widths: &[width], options, device: &device })?;
    Ok(found.into_iter().map(|(_, report)| checked(kind, report)).collect())
}

/// The description of a stage without failure. Encoders, losses, priors and projectors must run on a device as well.
fn checked(kind: Kind, report: Report) -> String {
    let none = Err(Unmet::Skipped("the stage offers none".into()));
    let on_device = !report.entries.contains(&("WGSL parity", none));
    let may = !matches!(kind, Kind::Encoder | Kind::Loss | Kind::Prior | Kind::Projector);
    assert!(on_device || may, "{} offers no WGSL", report.stage);
    let stage = report.stage.clone();
    expect(report);
    stage
}

fn check(kind: Kind, settings: &Value, width: usize, options: &dyn Fn(Options) -> Options) {
    let found = try_check(kind, settings, width, options).unwrap_or_else(|e| panic!("{settings}: {e}"));
    assert!(!found.is_empty(), "{settings}");
}

/// An encoder whose largest difference of single from double precision is `single`.
fn encoder(settings: Value, single: f64) {
    check(Kind::Encoder, &settings, 3, &|o| Options { single, ..o });
}

fn registered(kinds: &[Kind]) {
    for kind in kinds {
        let all: Vec<_> = stage_types().into_iter().filter(|t| t.kind == *kind).collect();
        assert!(!all.is_empty(), "no {kind} is registered");
        for t in all {
            println!("{kind} {}", t.name);
            match kind {
                // Three channels suit a field that reads positions as well. Larger parameters would saturate the last
                // sigmoid of a deep one.
                Kind::Field => check(*kind, &t.example(), 3, &|_| Options {
                    params: Some(0.2),
                    single: 5e-5,
                    ..Options::encoder()
                }),
                _ => check(*kind, &t.example(), 20, &|o| Options { single: 4e-5, ..o }),
            }
        }
    }
}

#[test]
fn registered_encoders_and_normalizers() {
    registered(&[Kind::Encoder, Kind::Normalizer]);
}

#[test]
fn registered_fields_and_projectors() {
    registered(&[Kind::Field, Kind::Projector]);
}

#[test]
fn registered_losses_and_priors() {
    registered(&[Kind::Loss, Kind::Prior]);
    for t in stage_types() {
        match t.kind {
            Kind::Loss => expect(check_settings::<dyn LossSpec>(t.name, &t.example())),
            Kind::Prior => expect(check_settings::<dyn PriorSpec>(t.name, &t.example())),
            _ => {}
        }
    }
}

#[test]
fn registered_parts_of_iterative_methods() {
    registered(&[Kind::VoxelProjector, Kind::Basis, Kind::DataTerm, Kind::Regularizer]);
}

/// Those without a file of weights: the others are tried in tests of their own.
#[test]
fn registered_initializers() {
    for t in stage_types().into_iter().filter(|t| t.kind == Kind::Initializer) {
        let spec = read::<dyn InitializerSpec>(t.example()).unwrap();
        let built = spec.build(&|_| Ok(Weights::default())).unwrap();
        if t.name == "random" || built.volume().is_some() {
            check(Kind::Initializer, &t.example(), 0, &|o| o);
        }
    }
}

/// Every type is in the schema that editors read. The refusal of an unknown type lists the known ones.
#[test]
fn every_type_is_in_the_schema_and_in_refusals() {
    let schema = schema::spec().to_string();
    for t in stage_types() {
        assert!(schema.contains(&format!("\"{}.{}\"", t.kind.name(), t.name)), "{} {}", t.kind, t.name);
    }
    for t in stage_types().into_iter().filter(|t| t.kind == Kind::Encoder) {
        let text = "type = 'neural-field'\nfield = 'mlp'\nprojector = 'ray-march'\nencoder = 'none'\n";
        let e = load::parse(text, "a.toml", &[], &[]).err().unwrap().to_string();
        assert!(e.contains(t.name), "{e}");
    }
}

/// Encoders with the largest difference of single from double precision that each may have.
#[test]
fn encoders() {
    for (settings, single) in [
        (json!({"type": "frequency"}), 2e-6),
        (json!({"type": "frequency", "bands": 1, "max_frequency": 3.0}), 2e-6),
        (json!({"type": "frequency", "bands": 5, "max_frequency": 40.0}), 2e-5),
        // A product f·x is rounded to 2⁻²⁴ of up to f turns.
        (json!({"type": "frequency", "bands": 7, "spacing": "linear", "max_frequency": 100.0}), 5e-5),
        (json!({"type": "dense-grid", "levels": 1, "base_resolution": 1, "features": 1}), 4e-5),
        (json!({"type": "dense-grid", "levels": 3, "base_resolution": 4, "growth": 1.7}), 4e-5),
        (json!({"type": "dense-grid", "levels": 2, "base_resolution": 3, "features": 8, "growth": 1.0}), 4e-5),
        (json!({"type": "dense-grid", "levels": 2, "base_resolution": 30, "features": 4}), 4e-5),
        (json!({"type": "b-spline-grid", "levels": 1, "base_resolution": 1, "features": 1}), 4e-5),
        (json!({"type": "b-spline-grid", "levels": 3, "base_resolution": 4, "growth": 1.7}), 4e-5),
        (json!({"type": "b-spline-grid", "levels": 2, "base_resolution": 3, "features": 8, "growth": 1.0}), 4e-5),
        // More than one range of a level.
        (json!({"type": "b-spline-grid", "levels": 1, "base_resolution": 78, "features": 1}), 4e-5),
        (json!({"type": "planes", "levels": 3, "base_resolution": 4, "growth": 1.7}), 4e-5),
        (json!({"type": "planes", "levels": 2, "base_resolution": 5, "features": 1}), 4e-5),
        (json!({"type": "planes", "form": "tri-plane", "levels": 2, "base_resolution": 7, "features": 2}), 4e-5),
        (json!({"type": "planes", "form": "tri-plane", "levels": 1, "base_resolution": 1, "features": 8}), 4e-5),
    ] {
        encoder(settings, single);
    }
}

#[test]
fn hashed_encoders() {
    for (settings, single) in [
        (json!({"type": "hash-grid", "levels": 3, "log2_table_size": 8, "base_resolution": 4}), 2e-5),
        (json!({"type": "hash-grid", "levels": 4, "features": 1, "growth": 1.5, "log2_table_size": 10}), 2e-5),
        (
            json!({"type": "hash-grid", "convention": "instant-ngp", "levels": 2, "features": 8, "log2_table_size": 6}),
            2e-5,
        ),
        // Positions in fine cells are rounded to 2⁻²⁴ of the resolution.
        (json!({"type": "hash-grid", "levels": 8, "features": 4, "log2_table_size": 12}), 5e-4),
        // The first level is direct, the others are hashed.
        (json!({"type": "permutohedral", "levels": 3, "log2_table_size": 9, "base_resolution": 4}), 2e-5),
        (json!({"type": "permutohedral", "levels": 4, "features": 1, "growth": 1.5, "log2_table_size": 10}), 2e-5),
        (json!({"type": "permutohedral", "levels": 2, "features": 8, "log2_table_size": 6}), 2e-5),
        // As for the hash grid.
        (json!({"type": "permutohedral", "levels": 8, "features": 4, "log2_table_size": 12}), 5e-4),
    ] {
        encoder(settings, single);
    }
}

#[test]
fn frequency_outside_the_cube() {
    let settings = json!({"type": "frequency", "bands": 3, "max_frequency": 4.0});
    check(Kind::Encoder, &settings, 3, &|o| Options { inputs: -30.0..30.0, ..o });
}

#[test]
fn concat() {
    let frequency = json!({"type": "frequency", "bands": 2, "max_frequency": 2.0});
    let dense = json!({"type": "dense-grid", "levels": 2, "base_resolution": 3});
    let hash = json!({"type": "hash-grid", "levels": 2, "log2_table_size": 7, "base_resolution": 4});
    for encoders in [
        json!([dense]),
        json!([frequency, {"type": "identity"}]),
        json!([frequency, dense, hash]),
        json!([hash, {"type": "concat", "encoders": [{"type": "identity"}, dense]}, dense]),
    ] {
        encoder(json!({"type": "concat", "encoders": encoders}), 4e-5);
    }
}

#[test]
fn concat_says_where_a_mistake_stands() {
    let settings = json!({"type": "concat", "encoders": [
        {"type": "identity"},
        {"type": "concat", "encoders": [{"type": "frequency", "bands": 0}]},
    ]});
    let spec: Box<dyn EncoderSpec> = serde_json::from_value(settings).unwrap();
    let e = spec.build().err().unwrap().to_string();
    assert!(e.contains("encoders.1.encoders.0.bands"), "{e}");
    let none: Box<dyn EncoderSpec> = serde_json::from_value(json!({"type": "concat", "encoders": []})).unwrap();
    assert!(none.build().err().unwrap().to_string().contains("at least one"));
}

#[test]
fn layer_norm() {
    for (settings, width) in [
        (json!({"type": "layer-norm"}), 20),
        (json!({"type": "layer-norm", "affine": false}), 7),
        (json!({"type": "layer-norm", "eps": 0.1}), 2),
        (json!({"type": "layer-norm"}), 33),
    ] {
        check(Kind::Normalizer, &settings, width, &|o| Options { params: Some(1.0), ..o });
        check(Kind::Normalizer, &settings, width, &|o| o);
    }
}

#[test]
fn layer_norm_of_one_channel() {
    check(Kind::Normalizer, &json!({"type": "layer-norm"}), 1, &|o| o);
}

#[test]
fn level_attention() {
    for (features, width) in [(2, 20), (4, 16), (1, 5), (3, 3)] {
        let settings = json!({"type": "level-attention", "features": features});
        check(Kind::Normalizer, &settings, width, &|o| Options { params: Some(1.0), single: 4e-5, ..o });
        check(Kind::Normalizer, &settings, width, &|o| Options { single: 4e-5, ..o });
    }
}

#[test]
fn line_attention() {
    for (settings, width) in [
        (json!({"type": "line-attention"}), 32),
        (json!({"type": "line-attention", "segment": 3, "heads": 2, "head_width": 3, "expansion": 2}), 5),
        (json!({"type": "line-attention", "segment": 1, "heads": 1, "head_width": 1, "expansion": 1}), 1),
    ] {
        check(Kind::Normalizer, &settings, width, &|o| Options { single: 1e-4, ..o });
    }
}

#[test]
fn line_transformer() {
    for (settings, width) in [
        (json!({"type": "line-transformer"}), 32),
        (
            json!({"type": "line-transformer", "width": 9, "blocks": 2, "attention": {"segment": 5, "heads": 3, "head_width": 2}}),
            5,
        ),
        (json!({"type": "line-transformer", "width": 4, "activation": "gelu", "output": "squareplus"}), 3),
    ] {
        check(Kind::Field, &settings, width, &|o| Options { single: 1e-4, ..o });
    }
}

/// An encoder with closed levels is a stage like any other.
#[test]
fn opened() {
    for (settings, channels) in [
        (json!({"type": "hash-grid", "levels": 3, "log2_table_size": 8, "base_resolution": 4}), 4),
        (json!({"type": "planes", "levels": 2, "base_resolution": 3, "features": 2}), 6),
    ] {
        let spec: Box<dyn EncoderSpec> = serde_json::from_value(settings).unwrap();
        let (stage, options) = (spec.build().unwrap(), Options { single: 4e-5, ..Options::encoder() });
        let opened = Opened::new(Arc::from(stage), channels).unwrap();
        expect(check_encoder(&opened, &options));
        if let Some(shared) = device::shared("the WGSL of a stage") {
            expect(check_wgsl(&opened, &options, shared));
        }
    }
    let of = |settings| serde_json::from_value::<Box<dyn EncoderSpec>>(settings).unwrap().build().unwrap();
    let refused = Opened::new(Arc::from(of(json!({"type": "frequency"}))), 3).err().unwrap().to_string();
    assert!(refused.contains("no tables of features"), "{refused}");
}

#[test]
fn mlp() {
    for (settings, width) in [
        (json!({"type": "mlp"}), 20),
        (json!({"type": "mlp", "width": 9, "depth": 1, "skips": [], "output": "none"}), 3),
        (
            json!({"type": "mlp", "width": 12, "depth": 3, "skips": [1, 2], "activation": "relu", "output": "softplus"}),
            5,
        ),
        (
            json!({"type": "mlp", "width": 33, "depth": 2, "skips": [1], "activation": "leaky-relu", "output": "sigmoid", "init": "he"}),
            17,
        ),
        (json!({"type": "mlp", "width": 8, "activation": "squareplus", "init": "glorot", "output": "gelu"}), 4),
    ] {
        check(Kind::Field, &settings, width, &|o| Options { single: 5e-5, ..o });
    }
}

#[test]
fn voxel_grid() {
    for settings in [
        json!({"type": "voxel-grid", "resolution": 6, "output": "none"}),
        json!({"type": "voxel-grid", "resolution": [5, 1, 9], "output": "softplus"}),
        json!({"type": "voxel-grid", "resolution": [1, 1, 1], "output": "squareplus"}),
        json!({"type": "voxel-grid", "resolution": [7, 8, 4], "output": "relu"}),
        json!({"type": "voxel-grid", "resolution": 70, "output": "squareplus"}),
    ] {
        check(Kind::Field, &settings, 3, &|_| Options { single: 4e-5, ..Options::encoder() });
    }
}

#[test]
fn parts_of_iterative_methods() {
    for (kind, settings) in [
        (Kind::VoxelProjector, json!({"type": "trilinear", "samples_per_voxel": 5.0})),
        (Kind::Regularizer, json!({"type": "total-variation", "weight": {"fixed": 0.1}, "inner": 1})),
    ] {
        check(kind, &settings, 0, &|o| o);
    }
}

#[test]
fn ray_projectors() {
    for settings in [
        json!({"type": "ray-march", "samples": 1}),
        json!({"type": "ray-march", "samples": 9, "sampling": "end-to-end"}),
        json!({"type": "ray-march", "sampling": "stratified", "extent": "clipped"}),
        json!({"type": "ray-march", "step_mm": 3.0, "extent": "published"}),
    ] {
        check(Kind::Projector, &settings, 0, &|o| o);
    }
}

/// Settings are written and read again, and those out of range are refused by name.
#[test]
fn losses_and_priors() {
    for settings in [json!({"type": "huber", "delta": 0.5}), json!({"type": "huber", "delta": 3.0})] {
        expect(check_settings::<dyn LossSpec>("huber", &settings));
        check(Kind::Loss, &settings, 0, &|o| o);
    }
    for settings in [
        json!({"type": "total-variation", "edge": 2, "blocks": 3, "smoothing": 0.01}),
        json!({"type": "total-variation", "edge": 5, "weight": 0.0, "spacing": 2.5, "smoothing": 0.3}),
    ] {
        expect(check_settings::<dyn PriorSpec>("total-variation", &settings));
        check(Kind::Prior, &settings, 0, &|o| o);
    }
    for (kind, wrong) in [
        (Kind::Loss, "delta"),
        (Kind::Prior, "edge"),
        (Kind::Prior, "blocks"),
        (Kind::Prior, "spacing"),
        (Kind::Prior, "smoothing"),
    ] {
        let name = if kind == Kind::Loss { "huber" } else { "total-variation" };
        let refused = try_check(kind, &json!({"type": name, wrong: 0}), 0, &|o| o).unwrap_err();
        assert!(refused.to_string().contains(wrong), "{refused}");
    }
}
