//! Tables in halves: steps, runs, checkpoints and what is asked of a model, on the CPU and on devices.

use crate::common::{Heard, Stop, model, plan, psnr, scan, solve, spec, volume};
use conefield_backend_cpu::Cpu;
use conefield_backend_cpu::rows::Kernels;
use conefield_backend_cpu::step::Slots;
use conefield_core::arena::Weights;
use conefield_core::backend::{Adam, Backend, TrainRay, Work};
use conefield_core::half::{Bf16, F16, Half, Stored};
use conefield_core::method::Job;
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::precision::Tables;
use conefield_core::random::{mix, unit};
use conefield_core::scene::Scene;
use conefield_core::settings::EncoderSpec;
use conefield_core::stage::{Encoder, Info, Kernel, Parameter, Reduced, Stage};
use conefield_solvers::losses::L2;
use serde_json::{Value, json};
use std::sync::Arc;

/// Formats with the largest error of gradients of a whole step against double precision, as a share of the largest.
const FORMATS: [(Tables, f64); 2] = [(Tables::F16, 4e-4), (Tables::Bf16, 4e-3)];

fn settings(tables: Tables) -> Value {
    json!({
        "precision": {"tables": tables.to_string()},
        "encoder": {"type": "hash-grid", "levels": 3, "base_resolution": 3, "log2_table_size": 8},
        "normalizers": [{"type": "layer-norm"}],
        "field": {"type": "mlp", "width": 8, "depth": 3, "skips": [1]},
        "projector": {"type": "ray-march", "samples": 20, "sampling": "stratified"},
        "type": "neural-field", "loss": "l2", "training": {"steps": 40, "rays": 128, "report_every": 5}, "optimizer": {"lr": 0.02},
    })
}

/// The same with every other stage whose gradients are scattered.
fn several(tables: Tables) -> Vec<(&'static str, Value)> {
    let mut concat = settings(tables);
    concat["encoder"] = json!({"type": "concat", "encoders": [
        {"type": "frequency", "bands": 2, "max_frequency": 2.0},
        {"type": "dense-grid", "levels": 2, "base_resolution": 3},
    ]});
    let mut voxels = settings(tables);
    voxels["encoder"] = json!({"type": "identity"});
    voxels["normalizers"] = json!([]);
    voxels["field"] = json!({"type": "voxel-grid", "resolution": 9});
    vec![("hash grid", settings(tables)), ("concat", concat), ("voxels", voxels)]
}

fn built(settings: &Value) -> Pipeline {
    crate::common::pipeline(&spec(settings).unwrap())
}

/// A model whose parameters are of order one.
fn filled(settings: &Value) -> Model {
    let mut model = Model::random(built(settings), 3);
    for (i, p) in model.arena.params.iter_mut().enumerate() {
        *p += 0.4 * (unit(mix(5, i as u64)) - 0.5);
    }
    model
}

fn rays() -> Vec<TrainRay> {
    let scan = scan();
    let scene = Scene::new(&scan, &conefield_core::scene::SceneSettings::default()).unwrap();
    let ray = |i: usize| scene.pixel_ray(&scan.geometry, i % 8, (i * 5) % 16, (i * 7) % 16);
    (0..40).map(|i| TrainRay { ray: ray(i), target: if i % 2 == 0 { 0.5 } else { 3.0 } }).collect()
}

fn points(n: u64) -> Vec<[f32; 3]> {
    (0..n).map(|i| std::array::from_fn(|k| 0.05 + 0.9 * unit(mix(i, k as u64)))).collect()
}

/// Largest difference as a share of the largest of `exact`.
fn apart(found: &[f32], exact: &[f64]) -> f64 {
    let top = exact.iter().fold(1e-30f64, |m, x| m.max(x.abs()));
    found.iter().zip(exact).map(|(a, b)| (f64::from(*a) - b).abs() / top).fold(0.0, f64::max)
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

// ---- steps ----

/// Gradients of a step in halves are off by what rounding the tables makes of them, on the CPU and on a device, and these
/// agree as they do in `f32`. Other limits of a device are tried with one format of one pipeline: each takes seconds to compile.
#[test]
fn gradients_of_a_step_are_off_by_the_rounding_of_tables() {
    let (rays, devices) = (rays(), crate::device::backends("steps in halves"));
    let work = Work { step: 4, seed: 9, loss: &L2 {}, rays: &rays, points: &[], priors: &[] };
    for (tables, limit) in FORMATS {
        for (name, settings) in several(tables) {
            let pipeline = built(&settings);
            let params: Vec<f64> = filled(&settings).arena.params.iter().map(|p| f64::from(*p)).collect();
            let kernels = Kernels::new(&pipeline, |s| s.reference()).unwrap();
            let mut exact = vec![0.0; params.len()];
            Slots::new(&kernels).step(&kernels, pipeline.projector.as_ref(), &params, &mut exact, &work);
            let mut single = settings.clone();
            single["precision"] = json!({});
            let on = |backend: &dyn Backend, settings: &Value| {
                let mut model = filled(settings);
                let mut exe = backend.compile(&model.pipeline).unwrap().0;
                exe.step(&mut model, &work).unwrap();
                exe.fetch(&mut model).unwrap();
                model.arena.grads.to_vec()
            };
            let (cpu, whole) = (on(&Cpu::new(), &settings), on(&Cpu::new(), &single));
            let (off, single) = (apart(&cpu, &exact), apart(&whole, &exact));
            println!("{tables}, {name}: gradients {off:.1e}, limit {limit:.0e}; f32 {single:.1e}");
            assert!(off <= limit && cpu != whole, "{tables}, {name}: {off:e}");
            let cpu: Vec<f64> = cpu.iter().map(|g| f64::from(*g)).collect();
            let tried = if tables == Tables::F16 && name == "hash grid" { devices.len() } else { 1 };
            for (device, backend) in devices.iter().take(tried) {
                let off = apart(&on(backend, &settings), &cpu);
                println!("  {device}: {off:.1e} from the CPU");
                assert!(off < 2e-5, "{tables}, {name}, {device}: {off:e}");
            }
        }
    }
}

/// A stage alone on a device, against its rounding.
#[test]
fn a_stage_in_halves_on_a_device_is_off_by_their_rounding() {
    let Some(shared) = crate::device::shared("tables in halves") else { return };
    let grid = json!({"type": "hash-grid", "levels": 3, "log2_table_size": 8, "base_resolution": 4});
    let spec: Box<dyn EncoderSpec> = serde_json::from_value(grid).unwrap();
    let stage = spec.build().unwrap();
    let n = 300;
    let params: Vec<f32> = (0..stage.info().params as u64).map(|i| 2.0 * unit(mix(8, i)) - 1.0).collect();
    let x: Vec<f32> = (0..3 * n).map(|i| unit(mix(9, i))).collect();
    let dy = vec![1.0; stage.info().output * n as usize];
    let run = |tables, params: &[f32]| shared.pass(stage.as_ref(), tables, params, &x, &dy, n as usize).unwrap();
    let [want, grads, _] = run(Tables::F32, &params);
    for (tables, bits) in [(Tables::F16, 11), (Tables::Bf16, 8)] {
        let [y, same, _] = run(tables, &params);
        let off = y.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0f32, f32::max);
        let rounding = 0.5f32.powi(bits);
        println!("{tables}: off by {off:.1e}, rounding {rounding:.1e}");
        assert!(off <= rounding && off > rounding / 30.0, "{tables}: {off}");
        let top = grads.iter().fold(0.0f32, |m, g| m.max(g.abs()));
        assert!(grads.iter().zip(&same).all(|(a, b)| (a - b).abs() <= 1e-5 * top), "gradients stay f32");
        // What the format has no number for ends at its largest.
        let huge: Vec<f32> = params.iter().map(|p| 3.3e38 * p.signum()).collect();
        let [y, ..] = run(tables, &huge);
        let most = if tables == Tables::F16 { 65_504.0 } else { Bf16(0x7f7f).value() };
        assert!(y.iter().all(|y| y.is_finite() && y.abs() <= 1.001 * most), "{tables}: {y:?}");
    }
}

// ---- runs ----

#[test]
fn a_run_in_halves_ends_near_one_in_f32() {
    let devices = crate::device::backends("a run in halves").into_iter().take(1);
    let devices: Vec<_> = devices.map(|(name, b)| (name, Box::new(b) as Box<dyn Backend>)).collect();
    let cpu: (&str, Box<dyn Backend>) = ("cpu", Box::new(Cpu::new()));
    for (name, backend) in [cpu].into_iter().chain(devices) {
        let (whole, _) = psnr(&settings(Tables::F32), backend.as_ref());
        for (tables, _) in FORMATS {
            let (halves, _) = psnr(&settings(tables), backend.as_ref());
            println!("{name}, {tables}: {halves:.3} dB, f32 {whole:.3} dB");
            assert!((halves - whole).abs() < 0.2 && halves != whole, "{name}, {tables}: {halves} dB, f32 {whole} dB");
        }
    }
}

/// The copy is made of the masters wherever it is missing: in a run that goes on, and where the volume is exported.
#[test]
fn what_goes_on_from_a_checkpoint_or_from_weights_has_the_same_bits() {
    for (tables, _) in FORMATS {
        let (scan, spec, cpu) = (scan(), spec(&settings(tables)).unwrap(), Cpu::new());
        let mut plan = plan(&spec, &cpu, &Weights::default()).unwrap();
        let (whole, _) = solve(&settings(tables), &scan, &Weights::default()).unwrap();
        let mut stop = Stop::at(20);
        assert!(plan.run(&Job { seed: 7, ..Job::new(&scan, &cpu) }, &mut stop).is_err());
        let resume = stop.kept.unwrap();
        let job = Job { seed: 7, resume: Some(&resume), ..Job::new(&scan, &cpu) };
        let gone_on = plan.run(&job, &mut Heard::default()).unwrap();
        let (a, b) = (volume(&whole), volume(&gone_on));
        assert!(a.data.iter().zip(&b.data).all(|(a, b)| a.to_bits() == b.to_bits()), "{tables}");
        let (whole, gone_on) = (model(whole), model(gone_on));
        assert!(whole.arena == gone_on.arena, "{tables}");
        // Read as they are, the same masters make another volume.
        let mut masters = Model::random(built(&settings(Tables::F32)), 0);
        masters.arena.params.copy_from_slice(&whole.arena.params);
        let at = points(200);
        let values = |model: &Model| {
            let mut values = vec![0.0; at.len()];
            cpu.compile(&model.pipeline).unwrap().0.evaluate(model, &at, &mut values).unwrap();
            values
        };
        assert!(values(&whole) != values(&masters), "{tables}: tables are not rounded");
    }
}

/// After updates an executable answers as one made of the same masters does, and after [`Executable::renew`] as one of
/// the new ones.
///
/// [`Executable::renew`]: conefield_core::backend::Executable::renew
#[test]
fn the_copy_follows_updates_and_what_else_changes_the_masters() {
    let (rays, at) = (rays(), points(300));
    for (tables, _) in FORMATS {
        let mut model = filled(&settings(tables));
        let mut exe = Cpu::new().compile(&model.pipeline).unwrap().0;
        let fresh = |model: &Model| Cpu::new().compile(&model.pipeline).unwrap().0.encode(model, &at).unwrap();
        let mut last = fresh(&model);
        for step in 1..=3 {
            let work = Work { step, seed: 9, loss: &L2 {}, rays: &rays, points: &[], priors: &[] };
            exe.step(&mut model, &work).unwrap();
            exe.update(&mut model, &Adam { lr: 1e-2, beta1: 0.9, beta2: 0.999, eps: 1e-8, step }).unwrap();
            let found = exe.encode(&model, &at).unwrap();
            assert!(bits(&found) == bits(&fresh(&model)) && found != last, "{tables}, step {step}");
            last = found;
        }
        model.arena.params.iter_mut().for_each(|p| *p *= -2.0);
        exe.renew();
        let found = exe.encode(&model, &at).unwrap();
        assert!(bits(&found) == bits(&fresh(&model)) && found != last, "{tables}");
        // An update before the copy is made again does not leave an old one.
        model.arena.params.iter_mut().for_each(|p| *p *= 0.3);
        exe.renew();
        exe.update(&mut model, &Adam { lr: 1e-2, beta1: 0.9, beta2: 0.999, eps: 1e-8, step: 4 }).unwrap();
        assert_eq!(bits(&exe.encode(&model, &at).unwrap()), bits(&fresh(&model)), "{tables}");
    }
}

// ---- extremes ----

/// Tables beyond the largest number of a format count as that; the masters stay what they are.
#[test]
fn tables_beyond_a_format_end_at_its_largest_number() {
    let at = points(100);
    for (tables, largest) in [(Tables::F16, F16::nearest(f32::MAX).value()), (Tables::Bf16, Bf16(0x7f7f).value())] {
        let mut model = filled(&settings(tables));
        let encoder = model.pipeline.ranges()[0].clone();
        for size in [1e5, 1e30, 3.4e38] {
            model.arena.params[encoder.clone()].fill(size);
            let features = Cpu::new().compile(&model.pipeline).unwrap().0.encode(&model, &at).unwrap();
            let want = size.min(largest);
            let near = |f: &f32| f.is_finite() && (f / want - 1.0).abs() < 4e-3;
            assert!(features.iter().all(near), "{tables} of {size:e}: {features:?}");
            assert!(model.arena.params[encoder.clone()].iter().all(|p| *p == size));
        }
        // What is no number is not made one.
        model.arena.params[encoder.clone()].fill(f32::NAN);
        let features = Cpu::new().compile(&model.pipeline).unwrap().0.encode(&model, &at).unwrap();
        assert!(features.iter().all(|f| f.is_nan()), "{tables}: {features:?}");
    }
}

// ---- refusals ----

/// An encoder that reads its parameters as they are, as a plugin's does.
struct Plain(Arc<dyn Encoder>);

impl Stage for Plain {
    fn info(&self) -> Info {
        self.0.info()
    }
    fn parameters(&self) -> Vec<Parameter> {
        self.0.parameters()
    }
    fn init(&self, seed: u64, params: &mut [f32]) {
        self.0.init(seed, params);
    }
    fn kernel(&self) -> &dyn Kernel<f32> {
        self.0.kernel()
    }
    fn describe(&self) -> String {
        "plain: for a test".into()
    }
}
impl Encoder for Plain {
    fn keep_outputs(&self, keep: &[usize]) -> conefield_core::Result<Reduced<dyn Encoder>> {
        self.0.keep_outputs(keep)
    }
}

#[test]
fn a_stage_that_cannot_read_halves_is_refused_in_words() {
    let pipeline = |tables| {
        let mut pipeline = built(&settings(tables));
        pipeline.encoder = Arc::new(Plain(pipeline.encoder));
        pipeline
    };
    assert!(Cpu::new().compile(&pipeline(Tables::F32)).is_ok());
    for (tables, name) in [(Tables::F16, "f16"), (Tables::Bf16, "bf16")] {
        let e = Cpu::new().compile(&pipeline(tables)).err().unwrap().to_string();
        for word in ["encoder (plain)", "CPU backend", name, "precision.tables = \"f32\""] {
            assert!(e.contains(word), "{word:?} is not in: {e}");
        }
    }
}

/// Where no stage has tables there is no copy; where one has, it is counted.
#[test]
fn the_copy_is_reported_and_counted() {
    let explained = |settings: &Value| Cpu::new().compile(&built(settings)).unwrap().1;
    let whole = explained(&settings(Tables::F32));
    let halves = explained(&settings(Tables::F16));
    let params = built(&settings(Tables::F16)).layout().len();
    assert_eq!(halves.scratch_bytes, whole.scratch_bytes + 2 * params);
    assert!(halves.notes.iter().any(|n| n.contains("copy in f16")), "{:?}", halves.notes);
    let mut s = settings(Tables::F16);
    s["encoder"] = json!({"type": "frequency", "bands": 3, "max_frequency": 4.0});
    let dense = explained(&s);
    s["precision"] = json!({});
    assert_eq!(dense, explained(&s));
}
