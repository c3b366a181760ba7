//! A pipeline with stages of plugins gives the same bits as the same code built in, for weights and volume, also after
//! a kill.

use crate::build::example;
use crate::common::{Folder, SCAN, text};
use conefield_backend_cpu::Cpu;
use conefield_core::backend::{Backend, BlockWork, Work};
use conefield_core::method::{Context, Job, Limits, Silent};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::random::{mix, unit};
use conefield_core::registry::read;
use conefield_core::settings::{EncoderSpec, FieldSpec, NormalizerSpec, ProjectorSpec};
use conefield_core::stage::UnitRay;

// Stage types register themselves when their crate is linked.
use conefield_encoders as _;
use conefield_fields as _;
use conefield_projectors as _;
use conefield_solvers as _;
use conefield_solvers::losses::L2;
use conefield_solvers::priors::TotalVariation;

// The plugins' own source files, compiled into this test.
#[path = "../../../plugins/examples/huber/src/huber.rs"]
mod huber;
#[path = "../../../plugins/examples/triplane/src/planes.rs"]
mod planes;
#[path = "../../../plugins/examples/siren/src/sine.rs"]
mod sine;
#[path = "../../../plugins/examples/siren/src/smooth.rs"]
mod smooth;

const SPEC: &str = r#"
type = "neural-field"
name = "of plugins"

[encoder]
type = "triplane"
levels = 1
resolution = 12
features = 3

[[normalizers]]
type = "layer-norm"

[[normalizers]]
type = "ray-smooth"

[field]
type = "siren"
width = 12

[projector]
type = "ray-march"
samples = 24
sampling = "stratified"

[training]
rays = 48
"#;

/// A folder with a scan and the spec.
fn place() -> Folder {
    let d = Folder::after(&[SCAN]);
    d.put("plugins.toml", SPEC);
    d
}

/// The options that load the plugins of the spec.
fn plugins() -> String {
    ["siren", "triplane"].map(|name| format!("--plugin {} ", text(&example(name)))).concat()
}

fn reconstruct(run: &str, more: &str) -> String {
    format!("{}reconstruct scan --spec plugins.toml -o {run} --seed 7 {more}", plugins())
}

fn weights(d: &Folder, run: &str) -> conefield_core::arena::Weights {
    conefield_io::read_weights(d.at(run).join("weights.safetensors")).unwrap()
}

#[test]
fn as_built_in() {
    let d = place();
    d.done(&reconstruct("run", "--steps 60"));

    let scan = conefield_scans::read_scan(d.at("scan")).unwrap();
    let spec = conefield_core::spec::load::parse(SPEC, "plugins.toml", &[], &[]).unwrap().spec;
    let (backend, limits) = (Cpu::new(), Limits { steps: Some(60), ..Limits::default() });
    let job = Job { seed: 7, limits, ..Job::new(&scan, &backend) };
    let solution = spec.method.plan(&Context::new(&backend)).unwrap().run(&job, &mut Silent).unwrap();
    let field = solution.result.field().unwrap();
    let weights = weights(&d, "run");
    let blocks = &field.model.pipeline.layout().blocks;
    assert_eq!(weights.tensors.len(), blocks.len());
    for b in blocks {
        let (shape, values) = &weights.tensors[&b.name];
        assert_eq!(*shape, b.shape, "{}", b.name);
        let bits = |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert!(bits(values) == bits(&field.model.arena.params[b.range.clone()]), "{} differs", b.name);
    }
    let volume = conefield_io::read_volume(d.at("run/volume.nii.gz")).unwrap();
    let built_in = solution.result.volume(&Cpu::new()).unwrap();
    assert!(volume.data == built_in.data, "the volumes differ");
}

/// A plugin's regularizer has the same weight, penalty and proximal map as a built-in one, and its state is saved in
/// checkpoints.
#[test]
fn a_regularizer_as_built_in() {
    const SPEC: &str = "type = 'fista'\nprior = 'huber'\nsubsets = 2\nstop = { passes = 400 }\n";
    let d = Folder::after(&[SCAN]);
    d.put("huber.toml", SPEC);
    let library = text(&example("huber"));
    let line = |run: &str| format!("--plugin {library} reconstruct scan --spec huber.toml -o {run}");
    d.done(&format!("{} --steps 10", line("short")));
    d.done(&line("whole"));
    let read = |run: &str| conefield_io::read_volume(d.at(run).join("volume.nii.gz")).unwrap().data;

    let scan = conefield_scans::read_scan(d.at("scan")).unwrap();
    let spec = conefield_core::spec::load::parse(SPEC, "huber.toml", &[], &[]).unwrap().spec;
    let (backend, limits) = (Cpu::new(), Limits { steps: Some(10), ..Limits::default() });
    let job = Job { limits, ..Job::new(&scan, &backend) };
    let solution = spec.method.plan(&Context::new(&backend)).unwrap().run(&job, &mut Silent).unwrap();
    assert!(read("short") == solution.result.volume(&backend).unwrap().data, "the volumes differ");

    d.killed_at_a_checkpoint("broken", &format!("{} --checkpoint-every 0.01s", line("broken")));
    let kept = conefield_io::read_checkpoint(d.at("broken/checkpoint.safetensors")).unwrap();
    assert!(["prior.dual.x", "prior.dual.y", "prior.dual.z"].iter().all(|name| kept.tensors.contains_key(*name)));
    d.done(&format!("{} --resume", line("broken")));
    assert!(read("whole") == read("broken"), "the volumes differ after a kill");
}

#[test]
fn killed_and_resumed() {
    let d = place();
    d.done(&reconstruct("whole", "--steps 1500"));
    let killed = reconstruct("killed", "--steps 1500 --checkpoint-every 0.02s");
    d.killed_at_a_checkpoint("killed", &killed);

    // Without the plugins the spec is refused.
    d.refused_with(
        1,
        &format!("{} --resume", killed.replace(&plugins(), "")),
        &["no encoder type \"triplane\"", "load it with --plugin PATH"],
    );

    d.done(&format!("{killed} --resume"));
    for file in ["volume.nii.gz", "weights.safetensors"] {
        assert!(d.bytes(format!("whole/{file}")) == d.bytes(format!("killed/{file}")), "{file} differs");
    }
}

#[test]
fn explained_and_in_the_schema() {
    let (d, plugins) = (place(), plugins());
    let report = d.json(&format!("{plugins}explain plugins.toml --scan scan --json"));
    assert_eq!(report["stages"][0]["type"], "triplane");
    assert_eq!(report["stages"][3]["what"], "9 -> 2 layers of 12 -> 1, sines of frequency 3");
    assert_eq!(report["plugins"].as_array().unwrap().len(), 2);
    assert_eq!(report["stages"][0]["parameters"], 3 * (12 * 12 + 12) * 3);
    let schema = d.json(&format!("{plugins}schema"));
    assert!(schema["$defs"]["field.siren"]["properties"]["omega"].is_object());
    // A mistake in a plugin's settings is reported like one in built-in settings.
    for (set, want) in [
        ("field.omgea=2.0", "field.omgea: found an unknown key, expected \"omega\""),
        ("field.omega=-2.0", "--set field.omega=-2.0: field.omega: found -2, expected above 0"),
    ] {
        d.refused_with(1, &format!("{plugins}explain plugins.toml --set {set}"), &[want]);
    }
}

/// Weights pre-trained with a plugin's field start another run of it.
#[test]
fn mapping_consistency() {
    let d = place();
    let small = "--steps 20 --set pretraining.points=200";
    d.done(&format!("{}pretrain phantom:head:16 --spec plugins.toml -o w.safetensors {small}", plugins()));
    d.done(&reconstruct("mci", "--steps 5 --init w.safetensors"));
    // A field of another width is refused by name.
    d.refused_with(
        1,
        &reconstruct("other", "--steps 5 --init w.safetensors --set field.width=13"),
        &["field.0.weight"],
    );
}

/// Plugin initializers support everything that built-in ones do: weights read by the host, a check before the run, a
/// known volume.
#[test]
fn initializers_of_plugins() {
    let d = place();
    let small = "--set encoder.log2_table_size=10 --set pretraining.points=200 --steps 20";
    d.done(&format!("pretrain phantom:head:16 --spec fast -o w.safetensors {small}"));
    let plugin = text(&example("rehashed"));
    let line = |run: &str, initializer: &str| {
        let small = "--set encoder.log2_table_size=10 --set training.rays=48 --set projector.samples=16 --steps 5";
        format!("--plugin {plugin} reconstruct scan --spec fast -o {run} {small} --set 'initializer={{{initializer}}}'")
    };
    for (kind, settings) in [("mci", "weights=\"w.safetensors\""), ("volume", "path=\"scan/truth.nii.gz\", steps=4")] {
        let of = [kind.to_owned(), format!("again-{kind}")].map(|kind| {
            d.done(&line(&kind, &format!("type=\"{kind}\", {settings}")));
            weights(&d, &kind).tensors
        });
        assert!(of[0] == of[1], "{kind}: the weights differ");
    }
    // A misfit is refused before a run begins.
    let misfit = line("other", "type=\"again-mci\", weights=\"w.safetensors\"");
    d.refused_with(1, &format!("{misfit} --set field.width=13"), &["field.0.weight", "initializer"]);
    assert!(!d.has("other"), "a run was begun");
}

/// A mask removes channels of a plugin's encoder, as of a built-in one.
#[test]
fn masks_of_plugins() {
    let d = place();
    let plugin = text(&example("rehashed"));
    let runs = ["hash-grid", "rehashed"].map(|encoder| {
        let lines = format!(
            "extends = 'ni-naf'\ncallbacks = [{{ type = 'fft-mask', keep = [0, 1, 3] }}]\n\
             [encoder]\ntype = '{encoder}'\nconvention = 'naf'\nfeatures = 2\ngrowth = 2.0\nlevels = 3\nlog2_table_size = 10\nbase_resolution = 16\n\
             [projector]\nsamples = 16\n[training]\nrays = 48\n"
        );
        d.put("masked.toml", lines);
        d.done(&format!("--plugin {plugin} reconstruct scan --spec masked.toml -o {encoder} --steps 80"));
        let metrics = d.text(format!("{encoder}/metrics.jsonl"));
        assert!(metrics.contains("events"), "nothing was masked: {metrics}");
        weights(&d, encoder).tensors
    });
    let shape = &runs[0]["normalizers.0.weight"].0;
    assert_eq!(*shape, [3], "three channels are left");
    assert!(runs[0] == runs[1], "the weights differ");
}

/// A point off any ray is a ray of one sample: there a stage that depends on rays changes neither values nor gradients;
/// along rays it does.
#[test]
fn points_off_any_ray_stand_alone() {
    let build = |smooth: bool| {
        let encoder =
            serde_json::json!({"type": "hash-grid", "levels": 2, "log2_table_size": 10, "base_resolution": 4});
        let encoder = read::<dyn EncoderSpec>(encoder).unwrap().build().unwrap();
        let width = encoder.info().output;
        let smoothing = || smooth::RaySmooth { strength: 0.5 }.build(width).unwrap();
        let normalizers = smooth.then(smoothing).into_iter().collect();
        let field = serde_json::json!({"type": "mlp", "width": 8});
        let field = read::<dyn FieldSpec>(field).unwrap().build(width).unwrap();
        let march = read::<dyn ProjectorSpec>(serde_json::json!({"type": "ray-march", "samples": 20})).unwrap();
        let model = Model::random(Pipeline::new(encoder, normalizers, field, march.build().unwrap()).unwrap(), 3);
        let exe = Cpu::new().compile(&model.pipeline).unwrap().0;
        (model, exe)
    };
    let ((mut plain, mut exe), (mut smoothed, mut smoothed_exe)) = (build(false), build(true));
    // Large features, so that smoothing has a visible effect.
    for (i, p) in plain.arena.params.iter_mut().enumerate() {
        *p += 0.3 * (i as f32 * 0.7).sin();
    }
    smoothed.arena.params.copy_from_slice(&plain.arena.params);
    let point = |i: usize, k: u64| unit(mix(i as u64, k));
    let points: Vec<[f32; 3]> = (0..700).map(|i| [point(i, 1), point(i, 2), point(i, 3)]).collect();
    let mut values = [vec![0.0; points.len()], vec![0.0; points.len()]];
    exe.evaluate(&plain, &points, &mut values[0]).unwrap();
    smoothed_exe.evaluate(&smoothed, &points, &mut values[1]).unwrap();
    assert!(values[0] == values[1], "values differ");

    let known: Vec<([f32; 3], f32)> = points.iter().map(|p| (*p, 0.3)).collect();
    let corners: Vec<_> = points[..40].iter().map(|p| p.map(|x| 0.8 * x)).collect();
    let prior = TotalVariation { weight: 0.1, edge: 4, smoothing: 1e-3, ..TotalVariation::default() };
    let priors = [BlockWork { prior: &prior, corners: &corners, spacing: [0.02; 3] }];
    let work = Work { step: 1, seed: 2, loss: &L2 {}, rays: &[], points: &known, priors: &priors };
    let stats = exe.step(&mut plain, &work).unwrap();
    let found = smoothed_exe.step(&mut smoothed, &work).unwrap();
    assert_eq!((stats.loss.to_bits(), stats.prior.to_bits()), (found.loss.to_bits(), found.prior.to_bits()));
    assert!(stats.loss > 0.0 && stats.prior > 0.0 && plain.arena.grads.iter().any(|g| *g != 0.0));
    assert!(*plain.arena.grads == *smoothed.arena.grads, "gradients differ");

    let (origin, direction) = ([-1.0, 0.4, 0.6], [1.0, 0.0, 0.0]);
    let ray = UnitRay { origin, direction, inside: [1.0, 2.0], published: [1.0, 2.0], per_mm: 0.01 };
    let mut lines = [[0.0f32], [0.0f32]];
    exe.render(&plain, &[ray], &mut lines[0]).unwrap();
    smoothed_exe.render(&smoothed, &[ray], &mut lines[1]).unwrap();
    assert_ne!(lines[0], lines[1], "smoothing along rays shows nowhere");
}
