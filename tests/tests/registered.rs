//! Every registered stage type through the conformance kit, by the settings of its registration. A new type is tried without
//! a word here.

mod device;

use conefield_conformance::{
    Options, Report, check_basis, check_data_term, check_encoder, check_field, check_initializer, check_loss,
    check_loss_wgsl, check_normalizer, check_prior, check_prior_wgsl, check_projector, check_projector_wgsl,
    check_regularizer, check_voxel_projector, check_wgsl,
};
use conefield_core::arena::Weights;
use conefield_core::basis::BasisSpec;
use conefield_core::data_term::DataTermSpec;
use conefield_core::registry::{Kind, Settings, stage_types};
use conefield_core::regularizer::RegularizerSpec;
use conefield_core::settings::{
    EncoderSpec, FieldSpec, InitializerSpec, LineFieldSpec, LossSpec, NormalizerSpec, PriorSpec, ProjectorSpec,
};
use conefield_core::spec::{load, schema, stage::read};
use conefield_core::stage::Stage;
use conefield_core::voxel::VoxelProjectorSpec;
use serde::de::DeserializeOwned;

// Stage types register themselves where their crate is linked.
use conefield_encoders as _;
use conefield_fields as _;
use conefield_projectors as _;
use conefield_solvers as _;

/// Hands every registered type of a kind to `run`, and refuses a kind that has none.
fn each<T: Settings + ?Sized>(run: impl Fn(Box<T>))
where
    Box<T>: DeserializeOwned,
{
    let all: Vec<_> = stage_types().into_iter().filter(|t| t.kind == T::KIND).collect();
    assert!(!all.is_empty(), "no {} is registered", T::KIND);
    for t in all {
        println!("{} {}", t.kind, t.name);
        run(read(t.example()).unwrap_or_else(|e| panic!("{} {}: {e}", t.kind, t.name)));
    }
}

fn expect(report: Report) {
    println!("{report}");
    assert!(report.passed(), "{report}\nfails {:?}", report.failed());
}

/// The stage's WGSL, where it has some and there is a device.
fn on_a_device(stage: &dyn Stage, options: &Options) {
    if stage.wgsl().is_none() {
        return println!("{}: it has no WGSL and runs on the CPU alone", stage.describe());
    }
    if let Some(shared) = device::shared("the WGSL of a stage") {
        expect(check_wgsl(stage, options, &|s, p, x, dy, rows| shared.pass(s, p, x, dy, rows)));
    }
}

#[test]
fn encoders() {
    each::<dyn EncoderSpec>(|spec| {
        let (stage, options) = (spec.build().unwrap(), Options { single: 4e-5, ..Options::encoder() });
        expect(check_encoder(stage.as_ref(), &options));
        on_a_device(stage.as_ref(), &options);
    });
}

#[test]
fn normalizers() {
    each::<dyn NormalizerSpec>(|spec| {
        let (stage, options) = (spec.build(20).unwrap(), Options::features());
        expect(check_normalizer(stage.as_ref(), &options));
        on_a_device(stage.as_ref(), &options);
    });
}

#[test]
fn fields() {
    // Three channels suit a field that reads positions as well. Larger parameters would saturate the last sigmoid of a deep one.
    let options = Options { params: Some(0.2), single: 5e-5, ..Options::encoder() };
    each::<dyn FieldSpec>(|spec| {
        let stage = spec.build(3).unwrap();
        expect(check_field(stage.as_ref(), &options));
        on_a_device(stage.as_ref(), &options);
    });
    each::<dyn LineFieldSpec>(|spec| {
        let stage = spec.build().unwrap();
        assert!(stage.lines().is_some() && stage.lines_reference().is_some(), "{}", stage.describe());
        expect(check_field(stage.as_ref(), &options));
    });
}

#[test]
fn projectors() {
    each::<dyn ProjectorSpec>(|spec| {
        let projector = spec.build().unwrap();
        expect(check_projector(projector.as_ref()));
        if let (Some(_), Some(shared)) = (projector.wgsl(), device::shared("the WGSL of a projector")) {
            expect(check_projector_wgsl(projector.as_ref(), &|p, rays| shared.samples(p, rays)));
        }
    });
    each::<dyn VoxelProjectorSpec>(|spec| expect(check_voxel_projector(spec.build().unwrap().as_ref())));
}

#[test]
fn initializers() {
    each::<dyn InitializerSpec>(|spec| {
        // Of weights from a file, those of an empty one: they are tried in tests of their own.
        let built = spec.build(&|_| Ok(Weights::default())).unwrap();
        if spec.typetag_name() == "random" || built.volume().is_some() {
            expect(check_initializer(built.as_ref()));
        }
    });
}

#[test]
fn losses_and_priors() {
    each::<dyn LossSpec>(|spec| {
        let loss = spec.build().unwrap();
        expect(check_loss(loss.as_ref()));
        if let (Some(_), Some(shared)) = (loss.wgsl(), device::shared("the WGSL of a loss")) {
            expect(check_loss_wgsl(loss.as_ref(), &|l, pairs| shared.losses(l, pairs)));
        }
    });
    each::<dyn PriorSpec>(|spec| {
        let prior = spec.build().unwrap();
        expect(check_prior(prior.as_ref()));
        if let (Some(_), Some(shared)) = (prior.wgsl(), device::shared("the WGSL of a prior")) {
            expect(check_prior_wgsl(prior.as_ref(), &|p, values| shared.penalty(p, values)));
        }
    });
}

#[test]
fn what_iterative_methods_are_put_together_from() {
    each::<dyn BasisSpec>(|spec| expect(check_basis(spec.build().unwrap().as_ref())));
    each::<dyn DataTermSpec>(|spec| expect(check_data_term(spec.build().unwrap().as_ref())));
    each::<dyn RegularizerSpec>(|spec| expect(check_regularizer(spec.build().unwrap().as_ref())));
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
