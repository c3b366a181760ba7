//! Every built-in stage, with several settings each, through the conformance kit.

mod device;

use conefield_conformance::{
    Options, Report, check_basis, check_data_term, check_encoder, check_field, check_initializer, check_loss,
    check_loss_wgsl, check_normalizer, check_prior, check_prior_wgsl, check_projector, check_projector_wgsl,
    check_regularizer, check_settings, check_voxel_projector, check_wgsl, ready,
};
use conefield_core::arena::Weights;
use conefield_core::basis::BasisSpec;
use conefield_core::data_term::DataTermSpec;
use conefield_core::loss::Loss;
use conefield_core::opened::Opened;
use conefield_core::registry::{Kind, Settings, names};
use conefield_core::regularizer::RegularizerSpec;
use conefield_core::settings::{
    EncoderSpec, FieldSpec, InitializerSpec, LineFieldSpec, LossSpec, NormalizerSpec, PriorSpec, ProjectorSpec,
};
use conefield_core::spec::stage::read;
use conefield_core::stage::{Field, Stage};
use conefield_core::voxel::VoxelProjectorSpec;
use serde::de::DeserializeOwned;
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

/// The stage's WGSL, where there is a device. Every built-in stage that does anything has one, but those that look along
/// rays.
fn on_a_device(stage: &dyn Stage, options: &Options) {
    if stage.wgsl().is_none() {
        return;
    }
    if let Some(shared) = device::shared("the WGSL of a stage") {
        expect(check_wgsl(stage, options, &|s, p, x, dy, rows| shared.pass(s, p, x, dy, rows)));
    }
}

fn encoder(settings: Value, options: &Options) {
    let spec: Box<dyn EncoderSpec> = serde_json::from_value(settings).unwrap();
    let stage = spec.build().unwrap();
    expect(check_encoder(stage.as_ref(), options));
    on_a_device(stage.as_ref(), options);
}

fn normalizer(settings: Value, width: usize, options: &Options) {
    let spec: Box<dyn NormalizerSpec> = serde_json::from_value(settings).unwrap();
    let stage = spec.build(width).unwrap();
    expect(check_normalizer(stage.as_ref(), options));
    on_a_device(stage.as_ref(), options);
}

fn field(settings: Value, width: usize, options: &Options) {
    let spec: Box<dyn FieldSpec> = serde_json::from_value(settings).unwrap();
    let stage = spec.build(width).unwrap();
    expect(check_field(stage.as_ref(), options));
    on_a_device(stage.as_ref(), options);
}

fn line_field(settings: Value, options: &Options) {
    let spec: Box<dyn LineFieldSpec> = serde_json::from_value(settings).unwrap();
    let stage = spec.build().unwrap();
    expect(check_field(stage.as_ref(), options));
    on_a_device(stage.as_ref(), options);
}

#[test]
fn identity() {
    encoder(json!({"type": "identity"}), &Options::encoder());
}

#[test]
fn frequency() {
    for (settings, single) in [
        (json!({"type": "frequency"}), 2e-6),
        (json!({"type": "frequency", "bands": 1, "max_frequency": 3.0}), 2e-6),
        (json!({"type": "frequency", "bands": 5, "max_frequency": 40.0}), 2e-5),
        // A product f·x is rounded to 2⁻²⁴ of up to f turns.
        (json!({"type": "frequency", "bands": 7, "spacing": "linear", "max_frequency": 100.0}), 5e-5),
    ] {
        encoder(settings, &Options { single, ..Options::encoder() });
    }
}

#[test]
fn frequency_outside_the_cube() {
    encoder(
        json!({"type": "frequency", "bands": 3, "max_frequency": 4.0}),
        &Options { inputs: -30.0..30.0, ..Options::encoder() },
    );
}

#[test]
fn dense_grid() {
    for settings in [
        json!({"type": "dense-grid", "levels": 1, "base_resolution": 1, "features": 1}),
        json!({"type": "dense-grid", "levels": 3, "base_resolution": 4, "growth": 1.7}),
        json!({"type": "dense-grid", "levels": 2, "base_resolution": 3, "features": 8, "growth": 1.0}),
        json!({"type": "dense-grid", "levels": 2, "base_resolution": 30, "features": 4}),
    ] {
        encoder(settings, &Options { single: 4e-5, ..Options::encoder() });
    }
}

#[test]
fn hash_grid() {
    for (settings, single) in [
        (json!({"type": "hash-grid", "levels": 3, "log2_table_size": 8, "base_resolution": 4}), 2e-5),
        (json!({"type": "hash-grid", "levels": 4, "features": 1, "growth": 1.5, "log2_table_size": 10}), 2e-5),
        (
            json!({"type": "hash-grid", "convention": "instant-ngp", "levels": 2, "features": 8, "log2_table_size": 6}),
            2e-5,
        ),
        // Positions in fine cells are rounded to 2⁻²⁴ of the resolution.
        (json!({"type": "hash-grid", "levels": 8, "features": 4, "log2_table_size": 12}), 5e-4),
    ] {
        encoder(settings, &Options { single, ..Options::encoder() });
    }
}

#[test]
fn permutohedral() {
    for (settings, single) in [
        // The first level is direct, the others are hashed.
        (json!({"type": "permutohedral", "levels": 3, "log2_table_size": 9, "base_resolution": 4}), 2e-5),
        (json!({"type": "permutohedral", "levels": 4, "features": 1, "growth": 1.5, "log2_table_size": 10}), 2e-5),
        (json!({"type": "permutohedral", "levels": 2, "features": 8, "log2_table_size": 6}), 2e-5),
        // As for the hash grid.
        (json!({"type": "permutohedral", "levels": 8, "features": 4, "log2_table_size": 12}), 5e-4),
    ] {
        encoder(settings, &Options { single, ..Options::encoder() });
    }
}

#[test]
fn b_spline_grid() {
    for settings in [
        json!({"type": "b-spline-grid", "levels": 1, "base_resolution": 1, "features": 1}),
        json!({"type": "b-spline-grid", "levels": 3, "base_resolution": 4, "growth": 1.7}),
        json!({"type": "b-spline-grid", "levels": 2, "base_resolution": 3, "features": 8, "growth": 1.0}),
        // More than one range of a level.
        json!({"type": "b-spline-grid", "levels": 1, "base_resolution": 78, "features": 1}),
    ] {
        encoder(settings, &Options { single: 4e-5, ..Options::encoder() });
    }
}

#[test]
fn planes() {
    for settings in [
        json!({"type": "planes", "levels": 3, "base_resolution": 4, "growth": 1.7}),
        json!({"type": "planes", "levels": 2, "base_resolution": 5, "features": 1}),
        json!({"type": "planes", "form": "tri-plane", "levels": 2, "base_resolution": 7, "features": 2}),
        json!({"type": "planes", "form": "tri-plane", "levels": 1, "base_resolution": 1, "features": 8}),
    ] {
        encoder(settings, &Options { single: 4e-5, ..Options::encoder() });
    }
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
        encoder(json!({"type": "concat", "encoders": encoders}), &Options { single: 4e-5, ..Options::encoder() });
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
        normalizer(settings.clone(), width, &Options { params: Some(1.0), ..Options::features() });
        normalizer(settings, width, &Options::features());
    }
}

#[test]
fn layer_norm_of_one_channel() {
    normalizer(json!({"type": "layer-norm"}), 1, &Options::features());
}

#[test]
fn level_attention() {
    for (features, width) in [(2, 20), (4, 16), (1, 5), (3, 3)] {
        let settings = json!({"type": "level-attention", "features": features});
        normalizer(settings.clone(), width, &Options { params: Some(1.0), single: 4e-5, ..Options::features() });
        normalizer(settings, width, &Options { single: 4e-5, ..Options::features() });
    }
}

#[test]
fn line_attention() {
    for (settings, width) in [
        (json!({"type": "line-attention"}), 32),
        (json!({"type": "line-attention", "segment": 3, "heads": 2, "head_width": 3, "expansion": 2}), 5),
        (json!({"type": "line-attention", "segment": 1, "heads": 1, "head_width": 1, "expansion": 1}), 1),
    ] {
        normalizer(settings, width, &Options { single: 1e-4, ..Options::features() });
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
        field(settings, width, &Options { single: 1e-4, ..Options::features() });
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
        on_a_device(&opened, &options);
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
        field(settings, width, &Options { single: 5e-5, ..Options::features() });
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
        field(settings, 3, &Options { single: 4e-5, ..Options::encoder() });
    }
}

/// Every registered type of a kind with default settings, and others of them.
fn each<T: Settings + ?Sized>(others: &[Value]) -> Vec<Box<T>>
where
    Box<T>: DeserializeOwned,
{
    let all = names(T::KIND);
    assert!(!all.is_empty(), "no {}", T::KIND);
    let settings = all.iter().map(|name| json!({ "type": name })).chain(others.iter().cloned());
    settings.map(|s| read(s).unwrap()).collect()
}

#[test]
fn voxels_joseph() {
    for settings in [
        json!({"type": "voxels-joseph", "resolution": 16}),
        json!({"type": "voxels-joseph", "resolution": [12, 17, 9]}),
        // More than one range of voxels.
        json!({"type": "voxels-joseph", "resolution": [41, 37, 43]}),
    ] {
        line_field(settings, &Options { single: 4e-5, ..Options::encoder() });
    }
}

/// Line fields do, in both precisions; fields that a projector samples do not.
#[test]
fn line_fields_alone_bring_line_integrals() {
    let lines = |stage: &dyn Field| [stage.lines().is_some(), stage.lines_reference().is_some()];
    for spec in each::<dyn FieldSpec>(&[]) {
        assert_eq!(lines(spec.build(3).unwrap().as_ref()), [false; 2], "{}", spec.typetag_name());
    }
    for spec in each::<dyn LineFieldSpec>(&[]) {
        assert_eq!(lines(spec.build().unwrap().as_ref()), [true; 2], "{}", spec.typetag_name());
    }
}

#[test]
fn voxel_projectors() {
    for spec in each::<dyn VoxelProjectorSpec>(&[json!({"type": "trilinear", "samples_per_voxel": 5.0})]) {
        expect(check_voxel_projector(spec.build().unwrap().as_ref()));
    }
}

#[test]
fn bases() {
    for spec in each::<dyn BasisSpec>(&[]) {
        expect(check_basis(spec.build().unwrap().as_ref()));
    }
}

#[test]
fn data_terms() {
    for spec in each::<dyn DataTermSpec>(&[]) {
        expect(check_data_term(spec.build().unwrap().as_ref()));
    }
}

#[test]
fn regularizers() {
    for spec in each::<dyn RegularizerSpec>(&[json!({"type": "total-variation", "weight": {"fixed": 0.1}, "inner": 1})])
    {
        expect(check_regularizer(spec.build().unwrap().as_ref()));
    }
}

#[test]
fn ray_projectors() {
    for settings in [
        json!({"type": "ray-march"}),
        json!({"type": "ray-march", "samples": 1}),
        json!({"type": "ray-march", "samples": 9, "sampling": "end-to-end"}),
        json!({"type": "ray-march", "sampling": "stratified", "extent": "clipped"}),
        json!({"type": "ray-march", "step_mm": 3.0, "extent": "published"}),
    ] {
        let spec: Box<dyn ProjectorSpec> = serde_json::from_value(settings).unwrap();
        let projector = spec.build().unwrap();
        expect(check_projector(projector.as_ref()));
        assert!(projector.wgsl().is_some());
        if let Some(shared) = device::shared("the WGSL of a projector") {
            expect(check_projector_wgsl(projector.as_ref(), &|p, rays| shared.samples(p, rays)));
        }
    }
}

#[test]
fn random_initializer() {
    let spec: Box<dyn InitializerSpec> = serde_json::from_value(json!({"type": "random"})).unwrap();
    expect(check_initializer(spec.build(&|_| Ok(Weights::default())).unwrap().as_ref()));
}

fn loss(loss: &dyn Loss) {
    expect(check_loss(loss));
    assert!(loss.wgsl().is_some(), "{} offers no WGSL", loss.describe());
    if let Some(shared) = device::shared("the WGSL of a loss") {
        expect(check_loss_wgsl(loss, &|l, pairs| shared.losses(l, pairs)));
    }
}

/// Every registered loss by its defaults, and with `more` settings.
#[test]
fn losses() {
    let more = [("huber", json!({"delta": 0.5})), ("huber", json!({"delta": 3.0}))];
    let all = names(Kind::Loss).into_iter().map(|name| (name, json!({}))).chain(more);
    for (name, settings) in all {
        expect(check_settings::<dyn LossSpec>(name, &settings));
        let mut table = settings;
        table["type"] = json!(name);
        let built = read::<dyn LossSpec>(table).unwrap().build().unwrap();
        loss(built.as_ref());
        if let Some(fitted) = ready(built.as_ref()) {
            loss(fitted.as_ref());
        }
    }
    let refused = read::<dyn LossSpec>(json!({"type": "huber", "delta": 0.0})).unwrap().build().err().unwrap();
    assert!(refused.to_string().contains("delta"), "{refused}");
}

/// Every registered prior by its defaults, and with `more` settings.
#[test]
fn priors() {
    let more = [
        ("total-variation", json!({"edge": 2, "blocks": 3, "smoothing": 0.01})),
        ("total-variation", json!({"edge": 5, "weight": 0.0, "spacing": 2.5, "smoothing": 0.3})),
    ];
    let all = names(Kind::Prior).into_iter().map(|name| (name, json!({}))).chain(more);
    for (name, settings) in all {
        expect(check_settings::<dyn PriorSpec>(name, &settings));
        let mut table = settings;
        table["type"] = json!(name);
        let built = read::<dyn PriorSpec>(table).unwrap().build().unwrap();
        expect(check_prior(built.as_ref()));
        assert!(built.wgsl().is_some(), "{} offers no WGSL", built.describe());
        if let Some(shared) = device::shared("the WGSL of a prior") {
            expect(check_prior_wgsl(built.as_ref(), &|p, values| shared.penalty(p, values)));
        }
    }
    for wrong in ["edge", "blocks", "spacing", "smoothing"] {
        let settings = json!({"type": "total-variation", wrong: 0});
        let refused = read::<dyn PriorSpec>(settings).unwrap().build().err().unwrap();
        assert!(refused.to_string().contains(wrong), "{refused}");
    }
}
