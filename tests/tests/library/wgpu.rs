//! The wgpu backend against the CPU's: whole steps, runs, masks, weights, checkpoints, refusals.

use crate::common::{
    Heard, apart, model, moved, neural_field, pipeline, planned, point, psnr, rays, scan, solve, solve_on,
};
use crate::pipeline::pretrained;
use conefield_backend_cpu::Cpu;
use conefield_backend_cpu::rows::Kernels;
use conefield_backend_cpu::step::Slots;
use conefield_backend_wgpu::Wgpu;
use conefield_conformance::{Options, check_projector_wgsl, check_wgsl};
use conefield_core::Result;
use conefield_core::backend::{Adam, Backend, BlockWork, TrainRay, Work};
use conefield_core::loss::Loss;
use conefield_core::method::{Job, Record};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::prior::Prior;
use conefield_core::random::mix;
use conefield_core::scene::Scene;
use conefield_core::settings::{EncoderSpec, FieldSpec, NormalizerSpec, ProjectorSpec};
use conefield_core::stage::{
    Encoder, Field, Info, Kernel, Normalizer, Parameter, Projector, Reduced, Samples, Scope, Stage, UnitRay,
};
use conefield_core::wgsl::Fragment;
use conefield_solvers::losses::{Huber, L1, L2};
use conefield_solvers::priors::TotalVariation;
use serde_json::{Value, json};
use std::sync::Arc;

fn settings() -> Value {
    neural_field(
        8,
        json!({
            "projector": {"type": "ray-march", "samples": 20, "sampling": "stratified"}, "loss": "l2",
            "training": {"steps": 40, "rays": 128, "report_every": 5}, "optimizer": {"lr": 0.02},
        }),
    )
}

// ---- whole steps ----

/// Largest difference, block by block as a share of the block's largest gradient.
fn worst(pipeline: &Pipeline, found: &[f32], exact: &[f64]) -> f64 {
    let blocks = pipeline.layout().blocks.iter();
    blocks.map(|b| apart(&found[b.range.clone()], &exact[b.range.clone()])).fold(0.0, f64::max)
}

/// Gradients and losses of a step with rays, points and blocks: double precision, the CPU, and every device. Sums of a
/// thousand rows in single precision are off by some 1e-6; positions in cells, and with them weights of corners, by
/// 1e-6 more. A wrong formula is off by far more, see the negative controls.
fn steps_agree(settings: &Value) {
    let limit = 2e-5;
    let devices = crate::device::backends("whole steps");
    let pipeline = pipeline(settings);
    let rays = rays(40, |i| if i % 2 == 0 { 0.5 } else { 3.0 });
    let points: Vec<_> = (0..150).map(|i| (point(i), if i % 2 == 0 { 0.7 } else { 4.0 })).collect();
    let corners: Vec<_> = (200..208).map(|i| point(i).map(|x| 0.7 * x)).collect();
    let fine = TotalVariation { weight: 0.3, edge: 5, smoothing: 1e-2, ..TotalVariation::default() };
    let coarse = TotalVariation { weight: 0.2, edge: 4, smoothing: 3e-2, ..TotalVariation::default() };
    let priors = [
        BlockWork { prior: &fine, corners: &corners[..5], spacing: [0.06, 0.05, 0.07] },
        BlockWork { prior: &coarse, corners: &corners[5..], spacing: [0.1; 3] },
    ];
    let params: Vec<f64> = moved(&pipeline).arena.params.iter().map(|&p| f64::from(p)).collect();
    let losses: [&dyn Loss; 3] = [&L1 {}, &L2 {}, &Huber { delta: 0.5 }];
    for (k, loss) in losses.into_iter().enumerate() {
        let text = loss.describe();
        let work = Work { step: 4, seed: 9, loss, rays: &rays, points: &points, priors: &priors };
        let kernels = Kernels::new(&pipeline, |s| s.reference().unwrap());
        let mut exact = vec![0.0; params.len()];
        let projector = pipeline.projector.as_ref();
        let want = Slots::new(&kernels).step(&kernels, projector, &params, &mut exact, &work);
        let on = |backend: &dyn Backend| {
            let mut model = moved(&pipeline);
            let mut exe = backend.compile(&model.pipeline).unwrap().0;
            let stats = exe.step(&mut model, &work).unwrap();
            exe.fetch(&mut model).unwrap();
            (stats, model.arena.grads.to_vec())
        };
        let (_, cpu) = on(&Cpu::new());
        // Limits change what surrounds a loss, not the loss: one is enough for all of them. Compilation takes seconds.
        let tried = if k == 0 { devices.len() } else { 1 };
        for (name, backend) in devices.iter().take(tried) {
            let (stats, grads) = on(*backend);
            let (e, on_cpu) = (worst(&pipeline, &grads, &exact), worst(&pipeline, &cpu, &exact));
            println!("{text}, {name}: gradients {e:.1e} (CPU {on_cpu:.1e}), loss {} and {}", stats.loss, want.loss);
            assert!(e < limit, "{text}, {name}: {e:e}");
            assert!((stats.loss - want.loss).abs() < 1e-5 * want.loss, "{} {}", stats.loss, want.loss);
            assert!((stats.prior - want.prior).abs() < 1e-5 * want.prior, "{} {}", stats.prior, want.prior);
            let all = 20 * 40 - missed(&pipeline, &rays) + 150 + 5 * 125 + 3 * 64;
            assert_eq!([stats.samples, want.samples], [all; 2], "{name}");
            // Negative control: a percent of one block's largest gradient.
            let mut wrong = grads.clone();
            let block = &pipeline.layout().blocks[0];
            let top = block.range.clone().max_by(|&i, &j| exact[i].abs().total_cmp(&exact[j].abs())).unwrap();
            wrong[top] *= 1.01;
            assert!(worst(&pipeline, &wrong, &exact) > limit);
        }
    }
}

/// The first rays of a pipeline may have no samples, as those beside the object.
#[test]
fn rays_that_miss_the_scene_are_zero() {
    let scan = scan();
    let scene = Scene::new(&scan, &conefield_core::scene::SceneSettings::default()).unwrap();
    for (name, backend) in crate::device::backends("rays beside the scene") {
        let mut model = Model::random(pipeline(&settings()), 3);
        let ray = UnitRay { inside: [0.0; 2], ..scene.pixel_ray(&scan.geometry, 0, 8, 8) };
        assert_eq!(model.pipeline.projector.max_samples(&ray), 0);
        let mut exe = backend.compile(&model.pipeline).unwrap().0;
        let mut lines = [1.0; 3];
        exe.render(&model, &[ray; 3], &mut lines).unwrap();
        assert_eq!(lines, [0.0; 3], "{name}");
        let mut exe = backend.compile(&model.pipeline).unwrap().0;
        let rays = [TrainRay { ray, target: 2.0 }; 3];
        let work = Work { step: 1, seed: 1, loss: &L2 {}, rays: &rays, points: &[], priors: &[] };
        let stats = exe.step(&mut model, &work).unwrap();
        assert_eq!((stats.samples, stats.loss), (0, 2.0), "{name}");
    }
}

/// Samples that rays do not have because they miss the box.
fn missed(pipeline: &Pipeline, rays: &[TrainRay]) -> u64 {
    rays.iter().map(|r| 20 - pipeline.projector.max_samples(&r.ray).min(20) as u64).sum()
}

#[test]
fn a_step_is_that_of_the_cpu() {
    steps_agree(&settings());
}

#[test]
fn a_step_is_that_of_the_cpu_with_voxels() {
    let mut s = settings();
    s["encoder"] = json!({"type": "identity"});
    s["normalizers"] = json!([]);
    s["field"] = json!({"type": "voxel-grid", "resolution": 9});
    steps_agree(&s);
}

#[test]
fn a_step_is_that_of_the_cpu_with_several_encoders_and_published_rays() {
    let mut s = settings();
    s["encoder"] = json!({"type": "concat", "encoders": [
        {"type": "frequency", "bands": 2, "max_frequency": 2.0},
        {"type": "dense-grid", "levels": 2, "base_resolution": 3},
    ]});
    s["projector"] = json!({"type": "ray-march", "samples": 20, "sampling": "uniform", "extent": "published"});
    steps_agree(&s);
}

#[test]
fn a_step_is_that_of_the_cpu_without_parameters_in_the_encoder() {
    let mut s = settings();
    s["encoder"] = json!({"type": "frequency", "bands": 3, "max_frequency": 4.0});
    steps_agree(&s);
}

/// Updates, values at points, features and line integrals after some steps.
#[test]
fn what_is_asked_of_a_trained_model_is_that_of_the_cpu() {
    let rays = rays(64, |_| 0.7);
    let points: Vec<[f32; 3]> = (0..5000).map(point).collect();
    let run = |backend: &dyn Backend| {
        let mut model = Model::random(pipeline(&settings()), 3);
        let mut exe = backend.compile(&model.pipeline).unwrap().0;
        for step in 1..=10 {
            let work = Work { step, seed: 9, loss: &L2 {}, rays: &rays, points: &[], priors: &[] };
            exe.step(&mut model, &work).unwrap();
            exe.update(&mut model, &Adam { lr: 1e-2, beta1: 0.9, beta2: 0.999, eps: 1e-8, step }).unwrap();
        }
        let mut values = vec![0.0; points.len()];
        exe.evaluate(&model, &points, &mut values).unwrap();
        let features = exe.encode(&model, &points).unwrap();
        let rays: Vec<_> = rays.iter().map(|r| r.ray).collect();
        let mut lines = vec![0.0; rays.len()];
        exe.render(&model, &rays, &mut lines).unwrap();
        exe.fetch(&mut model).unwrap();
        [values, features, lines, model.arena.params.to_vec()]
    };
    let want = run(&Cpu::new());
    for (name, backend) in crate::device::backends("a trained model") {
        for (what, (found, want)) in
            ["values", "features", "lines", "parameters"].iter().zip(run(backend).iter().zip(&want))
        {
            let e = apart(found, want);
            println!("{name}: {what} {e:.1e}");
            // Adam divides by the root of the second moment, which makes of rounding in a tiny gradient a step.
            assert!(e < 2e-3, "{name}: {what} off by {e:e}");
        }
    }
}

// ---- runs ----

#[test]
fn a_run_with_a_prior_ends_where_the_cpu_does() {
    let mut s = settings();
    s["priors"] = json!([{"type": "total-variation", "weight": 0.01, "blocks": 4, "edge": 4}]);
    let (want, records) = psnr(&s, &Cpu::new());
    for (name, backend) in crate::device::backends("a run").into_iter().take(1) {
        let (found, on_device) = psnr(&s, backend);
        println!("{name}: {found:.3} dB, CPU {want:.3} dB");
        assert!((found - want).abs() < 0.1, "{name}: {found} dB, CPU {want} dB");
        let losses = |r: &[Record]| (r[0].loss.unwrap(), r.last().unwrap().loss.unwrap());
        let ((a, b), (c, d)) = (losses(&records), losses(&on_device));
        assert!((a - c).abs() < 1e-4 * a && (b - d).abs() < 0.05 * b, "{a} {b} {c} {d}");
    }
}

#[test]
fn masked_channels_leave_the_kernels() {
    let Some((_, backend)) = crate::device::backends("masks").into_iter().next() else { return };
    let mut s = settings();
    s["encoder"]["levels"] = json!(6);
    s["encoder"]["base_resolution"] = json!(2);
    let mask = json!({"type": "fft-mask", "epoch": 1, "rule": "relative", "threshold": 0.72});
    s["callbacks"] = json!([{"type": "rollback"}, mask]);
    let (solution, records) = solve_on(backend, &s, &scan()).unwrap();
    let events: Vec<&String> = records.iter().flat_map(|r| &r.events).collect();
    assert_eq!(events.len(), 1, "{events:?}");
    let kept = model(solution).pipeline.encoder.info().output;
    assert!((1..12).contains(&kept), "{kept}");
    let on_cpu = model(solve(&s, &scan()).unwrap().0).pipeline.encoder.info().output;
    assert_eq!(kept, on_cpu);
    assert!(records.last().unwrap().loss.unwrap() < records[1].loss.unwrap());
}

#[test]
fn pretraining_on_several_volumes_is_that_of_the_cpu() {
    let mut s = settings();
    s["pretraining"]["points"] = json!(512);
    let (_, want) = pretrained(&s, &Cpu::new());
    for (name, backend) in crate::device::backends("pretraining").into_iter().take(1) {
        let (model, found) = pretrained(&s, backend);
        assert!(model.arena.params.iter().all(|p| p.is_finite()));
        for (a, b) in found.iter().zip(&want) {
            assert!((a - b).abs() < 0.02 * b, "{name}: {found:?} {want:?}");
        }
    }
}

#[test]
fn a_run_begun_on_one_backend_goes_on_on_the_other() {
    let Some((_, device)) = crate::device::backends("checkpoints").into_iter().next() else { return };
    let scan = scan();
    let whole = psnr(&settings(), &Cpu::new()).1.last().unwrap().loss.unwrap();
    let cpu = Cpu::new();
    let pairs: [[&dyn Backend; 2]; 3] = [[&cpu, device], [device, &cpu], [device, device]];
    for [first, second] in pairs {
        let mut heard = Heard::until(20);
        let run = |backend, resume, heard: &mut Heard| {
            planned(&settings(), backend).unwrap().run(&Job { seed: 7, resume, ..Job::new(&scan, backend) }, heard)
        };
        assert!(run(first, None, &mut heard).is_err());
        let resume = heard.kept.unwrap();
        assert_eq!(resume.standing.step, 20);
        let mut heard = Heard::default();
        run(second, Some(&resume), &mut heard).unwrap();
        let last = heard.records.last().unwrap();
        let loss = last.loss.unwrap();
        assert!((loss - whole).abs() < 0.03 * whole, "{} then {}: {loss}, {whole}", first.name(), second.name());
        assert_eq!(last.step, 40);
    }
}

// ---- refusals ----

/// A field whose WGSL is another's, changed.
struct Changed {
    inner: Arc<dyn Field>,
    change: fn(String) -> Option<String>,
    scope: Scope,
}

impl Stage for Changed {
    fn info(&self) -> Info {
        Info { scope: self.scope, ..self.inner.info() }
    }
    fn parameters(&self) -> Vec<Parameter> {
        self.inner.parameters()
    }
    fn init(&self, seed: u64, params: &mut [f32]) {
        self.inner.init(seed, params);
    }
    fn kernel(&self) -> &dyn Kernel<f32> {
        self.inner.kernel()
    }
    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        self.inner.reference()
    }
    fn wgsl(&self) -> Option<Fragment> {
        let source = (self.change)(self.inner.wgsl()?.source)?;
        Some(Fragment { source })
    }
    fn describe(&self) -> String {
        "changed: for a test".into()
    }
}
impl Field for Changed {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        self.inner.keep_inputs(keep)
    }
}

/// A loss without WGSL.
struct OnTheCpu;

impl Loss for OnTheCpu {
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64) {
        let d = predicted - measured;
        (d.abs().powi(3), 3.0 * d * d.abs())
    }
    fn describe(&self) -> String {
        "cubes: for a test".into()
    }
}

fn changed(change: fn(String) -> Option<String>, scope: Scope) -> Pipeline {
    let mut pipeline = pipeline(&settings());
    pipeline.field = Arc::new(Changed { inner: pipeline.field, change, scope });
    pipeline
}

#[test]
fn what_cannot_run_on_a_device_is_refused_in_words() {
    let Some((_, backend)) = crate::device::backends("refusals").into_iter().next() else { return };
    let refused = |change, scope, words: &[&str]| {
        let e = backend.compile(&changed(change, scope)).err().unwrap().to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{e:?} lacks one of {words:?}");
    };
    refused(|_| None, Scope::Row, &["field (changed)", "no WGSL", "--backend cpu"]);
    refused(Some, Scope::Ray, &["field (changed)", "along rays", "--backend cpu"]);
    let broken = |s: String| {
        Some(s.replacen("fn stage_forward", "fn stage_extra() -> f32 {\n    return nothing;\n}\nfn stage_forward", 1))
    };
    refused(broken, Scope::Row, &["field (changed)", "line", "return nothing;"]);
    let narrow = |s: String| Some(s.replacen("fn stage_backward", "fn stage_back", 1));
    refused(narrow, Scope::Row, &["backward"]);
    let helper = |s: String| Some(s + "\nfn square(x: f32) -> f32 { return x * x; }\n");
    refused(helper, Scope::Row, &["field (changed)", "declares square", "stage_"]);
    let twice = |s: String| {
        let sum = s.lines().find(|l| l.starts_with("const stage_sum_0 ")).unwrap().replace("sum_0", "sum_99");
        Some(s + &format!("\n{sum}\n"))
    };
    refused(twice, Scope::Row, &["field (changed)", "two sums for parameter"]);
    let beyond = |s: String| Some(s.replacen("array<u32, 6>(", "array<u32, 6>(99999", 1));
    refused(beyond, Scope::Row, &["field (changed)", "sums to parameter 99999", "the stage has"]);
    let unkept = |s: String| Some(s.replacen("const stage_keeps = ", "const stage_less = ", 1));
    refused(unkept, Scope::Row, &["field (changed)", "but keeps 0"]);
    let (exe, _) = backend.compile(&changed(Some, Scope::Row)).unwrap();
    let blocks: [Box<dyn Prior>; 1] = [Box::new(TotalVariation::default())];
    assert!(exe.admits(&L2 {}, &blocks).is_ok());
    let e = exe.admits(&OnTheCpu, &blocks).err().unwrap().to_string();
    assert!(["loss (cubes)", "no WGSL", "--backend cpu"].iter().all(|w| e.contains(w)), "{e}");
    let e = Wgpu::open(Some(99)).err().unwrap().to_string();
    assert!(e.contains("99") && e.contains("conefield backends"), "{e}");
}

// ---- the WGSL of stages ----

/// A constant of a shader that is slightly off is found.
#[test]
fn a_perturbed_constant_fails_the_parity_check() {
    let Some(shared) = crate::device::shared("negative controls") else { return };
    let options = Options::features();
    let check = |change: fn(String) -> Option<String>| {
        let settings = json!({"type": "mlp", "width": 5, "depth": 2, "skips": []});
        let spec: Box<dyn FieldSpec> = serde_json::from_value(settings).unwrap();
        let stage = Changed { inner: Arc::from(spec.build(3).unwrap()), change, scope: Scope::Row };
        check_wgsl(&stage, &options, &*shared)
    };
    assert!(check(Some).passed());
    let perturbed: [fn(String) -> Option<String>; 4] = [
        |s| Some(s.replace("0.23164189", "0.2318")),
        |s| Some(s.replace("1.52382103", "1.5240")),
        // The weights of the first layer, by the wrong inputs.
        |s| Some(s.replacen("(0, 3, 8, 5, 0, 3)", "(0, 3, 8, 5, 1, 3)", 1)),
        |s| Some(s.replace("stage_kept(13u) *", "1.001 * stage_kept(13u) *")),
    ];
    for (i, change) in perturbed.into_iter().enumerate() {
        assert_eq!(check(change).failed(), ["WGSL parity"], "perturbation {i}");
    }
}

/// Stages of random settings: widths that are no multiple of anything, channels left out here and there.
#[test]
fn stages_of_random_shapes_agree() {
    let Some(shared) = crate::device::shared("random shapes") else { return };
    let agrees = |what: &str, stage: &dyn Stage, options: &Options| {
        let report = check_wgsl(stage, options, &*shared);
        assert!(report.passed(), "{what}: {report}");
    };
    let mut n = 0u64;
    let mut below = |k: u64| {
        n += 1;
        mix(77, n) % k
    };
    for _ in 0..4 {
        let grid = json!({
            "type": if below(2) == 0 { "hash-grid" } else { "dense-grid" },
            "levels": 1 + below(4), "features": 1 << below(3), "base_resolution": 2 + below(5),
            "growth": 1.0 + below(10) as f64 / 10.0,
        });
        let spec: Box<dyn EncoderSpec> = serde_json::from_value(grid.clone()).unwrap();
        let whole: Box<dyn Encoder> = spec.build().unwrap();
        let keep: Vec<usize> = (0..whole.info().output).filter(|_| below(3) > 0).collect();
        let stage = if keep.is_empty() { whole } else { whole.keep_outputs(&keep).unwrap().stage };
        let options = Options { rows: 1 + below(20) as usize, single: 5e-5, ..Options::encoder() };
        agrees(&grid.to_string(), stage.as_ref(), &options);
    }
    for _ in 0..3 {
        let width = 2 + below(36) as usize;
        let spec: Box<dyn NormalizerSpec> = serde_json::from_value(json!({"type": "layer-norm"})).unwrap();
        let norm: Box<dyn Normalizer> = spec.build(width).unwrap();
        let keep: Vec<usize> = (0..width).filter(|c| *c == 0 || below(3) > 0).collect();
        let stage = norm.keep_inputs(&keep).unwrap().stage;
        let options = Options { params: Some(1.0), ..Options::features() };
        agrees(&format!("layer-norm of {width}, {keep:?}"), stage.as_ref(), &options);
    }
    for _ in 0..3 {
        let depth = 1 + below(3);
        let skips: Vec<u64> = (1..depth).filter(|_| below(2) == 0).collect();
        let activation = ["relu", "leaky-relu", "gelu", "squareplus", "softplus", "sigmoid"][below(6) as usize];
        let mlp =
            json!({"type": "mlp", "width": 1 + below(11), "depth": depth, "skips": skips, "activation": activation});
        let spec: Box<dyn FieldSpec> = serde_json::from_value(mlp.clone()).unwrap();
        let stage = spec.build(1 + below(9) as usize).unwrap();
        let options = Options { single: 5e-5, ..Options::features() };
        agrees(&mlp.to_string(), stage.as_ref(), &options);
    }
}

#[test]
fn samples_are_random_in_the_same_way() {
    let Some(shared) = crate::device::shared("samples") else { return };
    struct Off(Box<dyn Projector>);
    impl Projector for Off {
        fn max_samples(&self, ray: &UnitRay) -> usize {
            self.0.max_samples(ray)
        }
        fn sample(&self, ray: &UnitRay, seed: Option<u64>, out: &mut Samples) {
            self.0.sample(ray, seed, out);
        }
        fn describe(&self) -> String {
            self.0.describe()
        }
        fn wgsl(&self) -> Option<Fragment> {
            Some(Fragment { source: self.0.wgsl()?.source.replace("0.5", "0.49") })
        }
    }
    let spec: Box<dyn ProjectorSpec> = serde_json::from_value(json!({"type": "ray-march", "samples": 77})).unwrap();
    let run = |p: &dyn Projector| check_projector_wgsl(p, &*shared);
    assert!(run(spec.build().unwrap().as_ref()).passed());
    assert!(!run(&Off(spec.build().unwrap())).passed());
}
