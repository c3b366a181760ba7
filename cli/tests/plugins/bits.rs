//! A pipeline with stages of plugins gives the same bits as the same code built in, for weights and volume, also after
//! a kill.

use crate::build::example;
use crate::common::{conefield, done, json, refused, started, text};
use conefield_backend_cpu::Cpu;
use conefield_core::backend::{Backend, BlockWork, Work};
use conefield_core::method::{Context, Job, Limits, Silent};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::random::{mix, unit};
use conefield_core::registry::read;
use conefield_core::settings::{EncoderSpec, FieldSpec, NormalizerSpec, ProjectorSpec};
use conefield_core::stage::UnitRay;
use std::path::{Path, PathBuf};

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

struct Place {
    dir: tempfile::TempDir,
    scan: PathBuf,
    spec: PathBuf,
    plugins: [String; 2],
}

fn place() -> Place {
    let dir = tempfile::tempdir().unwrap();
    let (scan, spec) = (dir.path().join("scan"), dir.path().join("plugins.toml"));
    done(&["simulate", "phantom:head:16", "-o", &text(&scan), "--views", "8", "--detector", "16x16"]);
    std::fs::write(&spec, SPEC).unwrap();
    Place { dir, scan, spec, plugins: ["siren", "triplane"].map(|p| text(&example(p))) }
}

impl Place {
    fn reconstruct<'a>(&'a self, run: &'a str, steps: &'a str, more: &[&'a str]) -> Vec<&'a str> {
        let [siren, triplane] = &self.plugins;
        let mut all = vec!["--plugin", siren, "--plugin", triplane, "reconstruct"];
        all.extend([self.scan.to_str().unwrap(), "--spec", self.spec.to_str().unwrap(), "-o", run, "--seed", "7"]);
        all.extend(["--steps", steps]);
        all.extend(more);
        all
    }
}

/// Runs the command with `args`, and kills it after its first checkpoint.
fn kill_after(checkpoint: &Path, args: &[&str]) {
    let mut child = started(args);
    while !checkpoint.exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(checkpoint.exists(), "it was over before it could be killed");
}

#[test]
fn as_built_in() {
    let place = place();
    let run = text(&place.dir.path().join("run"));
    done(&place.reconstruct(&run, "60", &[]));

    let scan = conefield_scans::read_scan(&place.scan).unwrap();
    let spec = conefield_core::spec::load::parse(SPEC, "plugins.toml", &[], &[]).unwrap().spec;
    let (backend, limits) = (Cpu::new(), Limits { steps: Some(60), ..Limits::default() });
    let job = Job { seed: 7, limits, ..Job::new(&scan, &backend) };
    let solution = spec.method.plan(&Context::new(&backend)).unwrap().run(&job, &mut Silent).unwrap();
    let field = solution.result.field().unwrap();
    let weights = conefield_io::read_weights(Path::new(&run).join("weights.safetensors")).unwrap();
    let blocks = &field.model.pipeline.layout().blocks;
    assert_eq!(weights.tensors.len(), blocks.len());
    for b in blocks {
        let (shape, values) = &weights.tensors[&b.name];
        assert_eq!(*shape, b.shape, "{}", b.name);
        let bits = |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert!(bits(values) == bits(&field.model.arena.params[b.range.clone()]), "{} differs", b.name);
    }
    let volume = conefield_io::read_volume(Path::new(&run).join("volume.nii.gz")).unwrap();
    let built_in = solution.result.volume(&Cpu::new()).unwrap();
    assert!(volume.data == built_in.data, "the volumes differ");
}

/// A plugin's regularizer has the same weight, penalty and proximal map as a built-in one, and its state is saved in
/// checkpoints.
#[test]
fn a_regularizer_as_built_in() {
    const SPEC: &str = "type = 'fista'\nprior = 'huber'\nsubsets = 2\nstop = { passes = 400 }\n";
    let dir = tempfile::tempdir().unwrap();
    let (scan, spec) = (dir.path().join("scan"), dir.path().join("huber.toml"));
    done(&["simulate", "phantom:head:16", "-o", &text(&scan), "--views", "8", "--detector", "16x16"]);
    std::fs::write(&spec, SPEC).unwrap();
    let library = text(&example("huber"));
    let (scan_at, spec_at) = (text(&scan), text(&spec));
    let [short, whole, broken] = ["short", "whole", "broken"].map(|run| text(&dir.path().join(run)));
    let args = |run| ["--plugin", &library, "reconstruct", &scan_at, "--spec", &spec_at, "-o", run];
    done(&[&args(&short)[..], &["--steps", "10"]].concat());
    done(&args(&whole));
    let read = |run: &str| conefield_io::read_volume(Path::new(run).join("volume.nii.gz")).unwrap().data;

    let scan = conefield_scans::read_scan(&scan).unwrap();
    let spec = conefield_core::spec::load::parse(SPEC, "huber.toml", &[], &[]).unwrap().spec;
    let (backend, limits) = (Cpu::new(), Limits { steps: Some(10), ..Limits::default() });
    let job = Job { limits, ..Job::new(&scan, &backend) };
    let solution = spec.method.plan(&Context::new(&backend)).unwrap().run(&job, &mut Silent).unwrap();
    assert!(read(&short) == solution.result.volume(&backend).unwrap().data, "the volumes differ");

    let checkpoint = Path::new(&broken).join("checkpoint.safetensors");
    kill_after(&checkpoint, &[&args(&broken)[..], &["--checkpoint-every", "0.01s"]].concat());
    let kept = conefield_io::read_checkpoint(&checkpoint).unwrap();
    assert!(["prior.dual.x", "prior.dual.y", "prior.dual.z"].iter().all(|name| kept.tensors.contains_key(*name)));
    done(&[&args(&broken)[..], &["--resume"]].concat());
    assert!(read(&whole) == read(&broken), "the volumes differ after a kill");
}

#[test]
fn killed_and_resumed() {
    let place = place();
    let [whole, killed] = ["whole", "killed"].map(|f| text(&place.dir.path().join(f)));
    done(&place.reconstruct(&whole, "1500", &[]));
    let checkpoint = Path::new(&killed).join("checkpoint.safetensors");
    let arguments = place.reconstruct(&killed, "1500", &["--checkpoint-every", "0.02s"]);
    kill_after(&checkpoint, &arguments);

    // Without the plugins the spec is refused.
    let mut bare = arguments[4..].to_vec();
    bare.push("--resume");
    let e = refused(1, &bare);
    assert!(e.contains("no encoder type \"triplane\"") && e.contains("load it with --plugin PATH"), "{e}");

    let mut again = arguments.clone();
    again.push("--resume");
    done(&again);
    for file in ["volume.nii.gz", "weights.safetensors"] {
        let [a, b] = [&whole, &killed].map(|r| std::fs::read(Path::new(r).join(file)).unwrap());
        assert!(a == b, "{file} differs");
    }
}

#[test]
fn explained_and_in_the_schema() {
    let place = place();
    let [siren, triplane] = &place.plugins;
    let spec = text(&place.spec);
    let report =
        json(&["--plugin", siren, "--plugin", triplane, "explain", &spec, "--scan", &text(&place.scan), "--json"]);
    assert_eq!(report["stages"][0]["type"], "triplane");
    assert_eq!(report["stages"][3]["what"], "9 -> 2 layers of 12 -> 1, sines of frequency 3");
    assert_eq!(report["plugins"].as_array().unwrap().len(), 2);
    assert_eq!(report["stages"][0]["parameters"], 3 * (12 * 12 + 12) * 3);
    let schema = json(&["--plugin", siren, "schema"]);
    assert!(schema["$defs"]["field.siren"]["properties"]["omega"].is_object());
    // A mistake in a plugin's settings is reported like one in built-in settings.
    let set = |s| refused(1, &["--plugin", siren, "--plugin", triplane, "explain", &spec, "--set", s]);
    let e = set("field.omgea=2.0");
    assert!(e.contains("field.omgea: found an unknown key, expected \"omega\""), "{e}");
    let e = set("field.omega=-2.0");
    assert!(e.contains("--set field.omega=-2.0: field.omega: found -2, expected above 0"), "{e}");
}

/// Weights pre-trained with a plugin's field start another run of it.
#[test]
fn mapping_consistency() {
    let place = place();
    let [siren, triplane] = &place.plugins;
    let weights = text(&place.dir.path().join("weights.safetensors"));
    let spec = text(&place.spec);
    let small = ["--steps", "20", "--set", "pretraining.points=200"];
    let pretrain =
        ["--plugin", siren, "--plugin", triplane, "pretrain", "phantom:head:16", "--spec", &spec, "-o", &weights];
    done(&[&pretrain[..], &small].concat());
    let run = text(&place.dir.path().join("mci"));
    done(&place.reconstruct(&run, "5", &["--init", &weights]));
    // A field of another width is refused by name.
    let other = text(&place.dir.path().join("other"));
    let output =
        conefield(&place.reconstruct(&other, "5", &["--init", &weights, "--set", "field.width=13"])).output().unwrap();
    let e = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && e.contains("field.0.weight"), "{e}");
}

/// Plugin initializers support everything that built-in ones do: weights read by the host, a check before the run, a
/// known volume.
#[test]
fn initializers_of_plugins() {
    let place = place();
    let plugin = text(&example("rehashed"));
    let [scan, weights] = [&place.scan, &place.dir.path().join("weights.safetensors")].map(|p| text(p));
    let small = ["--set", "encoder.log2_table_size=10", "--set", "pretraining.points=200", "--steps", "20"];
    done(&[&["pretrain", "phantom:head:16", "--spec", "fast", "-o", &weights][..], &small].concat());
    let truth = text(&place.scan.join("truth.nii.gz"));
    let sets = ["--set", "encoder.log2_table_size=10", "--set", "training.rays=48", "--set", "projector.samples=16"];
    let args = |command: &'static str, initializer: &str| {
        let start = ["--plugin", &plugin, command].map(String::from);
        let end = ["--spec", "fast", "--steps", "5", "--set"].map(String::from);
        [
            &start[..],
            std::slice::from_ref(&scan),
            &end,
            &[format!("initializer={initializer}")],
            &sets.map(String::from),
        ]
        .concat()
    };
    for settings in [format!("weights={weights:?}"), format!("path={truth:?}, steps=4")] {
        let kind = if settings.starts_with('w') { "mci" } else { "volume" };
        let of = ["", "again-"].map(|prefix| {
            let run = place.dir.path().join(format!("{prefix}{kind}"));
            let mut args = args("reconstruct", &format!("{{type=\"{prefix}{kind}\", {settings}}}"));
            args.extend(["-o".into(), text(&run)]);
            done(&args.iter().map(String::as_str).collect::<Vec<_>>());
            conefield_io::read_weights(run.join("weights.safetensors")).unwrap().tensors
        });
        assert!(of[0] == of[1], "{kind}: the weights differ");
    }
    // A misfit is refused before a run begins.
    let run = text(&place.dir.path().join("other"));
    let mut other = args("reconstruct", &format!("{{type=\"again-mci\", weights={weights:?}}}"));
    other.extend(["-o", &run, "--set", "field.width=13"].map(String::from));
    let said = refused(1, &other.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(said.contains("field.0.weight") && said.contains("initializer"), "{said}");
    assert!(!Path::new(&run).exists(), "a run was begun");
}

/// A mask removes channels of a plugin's encoder, as of a built-in one.
#[test]
fn masks_of_plugins() {
    let place = place();
    let plugin = text(&example("rehashed"));
    let runs = ["hash-grid", "rehashed"].map(|encoder| {
        let spec = text(&place.dir.path().join(format!("{encoder}.toml")));
        let lines = format!(
            "extends = 'ni-naf'\ncallbacks = [{{ type = 'fft-mask', keep = [0, 1, 3] }}]\n\
             [encoder]\ntype = '{encoder}'\nconvention = 'naf'\nfeatures = 2\ngrowth = 2.0\nlevels = 3\nlog2_table_size = 10\nbase_resolution = 16\n\
             [projector]\nsamples = 16\n[training]\nrays = 48\n"
        );
        std::fs::write(&spec, lines).unwrap();
        let run = place.dir.path().join(encoder);
        let scan = text(&place.scan);
        done(&["--plugin", &plugin, "reconstruct", &scan, "--spec", &spec, "-o", &text(&run), "--steps", "80"]);
        let metrics = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
        assert!(metrics.contains("events"), "nothing was masked: {metrics}");
        conefield_io::read_weights(run.join("weights.safetensors")).unwrap().tensors
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
