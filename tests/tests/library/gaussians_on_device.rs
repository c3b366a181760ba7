//! Gaussians on a device agree with the CPU's: gradients, updates, values, line integrals, whole runs.

use crate::common::{protocol, psnr};
use crate::device::backends;
use crate::gaussians::{ON_CPU, longer};
use conefield_backend_cpu::Cpu;
use conefield_backend_wgpu::{Limits, Wgpu};
use conefield_core::backend::{Adam, Backend, BlockWork, Executable, Work};
use conefield_core::device::{Device, Launch, Program, Source};
use conefield_core::error::Result;
use conefield_core::loss::Loss;
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::prior::Prior;
use conefield_core::scan::Scan;
use conefield_core::scene::{Scene, SceneSettings};
use conefield_core::settings::{LossSpec, PriorSpec};
use conefield_core::stage::UnitGrid;
use conefield_projectors::simulate::simulate;
use conefield_solvers::gaussians::control::Pulls;
use conefield_solvers::gaussians::device::training::DeviceTraining;
use conefield_solvers::gaussians::shape::{FREE, NUMBERS};
use conefield_solvers::gaussians::stage::Mixture;
use conefield_solvers::gaussians::views::{Rule, ViewTraining, Views};
use conefield_solvers::losses::L1;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use serde_json::json;
use std::sync::{Arc, Mutex};

/// An odd number of slots: buffers are rounded up to whole vectors.
const MOST: usize = 151;

/// Five views of 37 × 45 pixels; from a cone, or from a source so far away that its rays are parallel.
fn views(source: f64) -> Scan {
    let protocol = protocol(json!({
        "dso": source, "dsd": source + 250.0, "detector": [37, 45], "extent": {"side": [200.0, 240.0]},
        "angles": {"even": {"views": 5}},
    }));
    simulate(&crate::common::truth(), &protocol).unwrap()
}

/// Gaussians of all shapes, with widths from this one to 12 times it; every seventh slot is free.
fn mixture(least: f32) -> Model {
    let mut model = Model::random(Pipeline::alone(Box::new(Mixture { most: MOST })).unwrap(), 0);
    let mut rng = StdRng::seed_from_u64(3);
    for (i, p) in model.arena.params.chunks_mut(NUMBERS).enumerate() {
        for (k, x) in p.iter_mut().enumerate() {
            let r: f32 = rng.random();
            *x = match k {
                0..3 => 0.1 + 0.8 * r,
                3..6 => least.ln() + r * 2.5,
                6..10 => 2.0 * r - 1.0,
                _ => -4.0 + 4.0 * r,
            };
        }
        if i % 7 == 3 {
            p[10] = FREE;
        }
    }
    model
}

/// Devices whose buffers are large enough.
fn on_devices() -> Vec<(&'static str, &'static Wgpu)> {
    backends("Gaussians").into_iter().filter(|(limits, _)| *limits != "small buffers").collect()
}

/// Where the blocks of a prior begin.
const CORNERS: [[f32; 3]; 2] = [[0.2, 0.3, 0.25], [0.45, 0.1, 0.5]];

const ADAM: Adam = Adam { lr: 1e-4, beta1: 0.9, beta2: 0.999, eps: 1e-8, step: 1 };

fn no_pulls() -> Arc<Mutex<Pulls>> {
    Arc::new(Mutex::new(Pulls::new(MOST)))
}

struct Both {
    scan: Scan,
    scene: Scene,
    rule: Rule,
    loss: Box<dyn Loss>,
    priors: Vec<Box<dyn Prior>>,
}

impl Both {
    fn new(source: f64, ssim: f64, prior: bool) -> Self {
        let scan = views(source);
        let scene = Scene::with_attenuation(scan.geometry.volume, &SceneSettings::default(), 0.02).unwrap();
        let rule = Rule { views: 2, ssim, rates: [0.02, 2.0, 0.2], widths: [0.005, 0.25] };
        let tv = json!({"type": "total-variation", "weight": 0.3, "blocks": 2, "edge": 9});
        let tv: Box<dyn PriorSpec> = serde_json::from_value(tv).unwrap();
        let priors = if prior { vec![tv.build().unwrap()] } else { vec![] };
        Self { scan, scene, rule, loss: LossSpec::build(&L1 {}).unwrap(), priors }
    }

    /// The work on a device, or on the CPU without one. Views stay on the device if they are `resident`.
    fn on(&self, device: Option<Box<dyn Device>>, resident: bool, pulls: &Arc<Mutex<Pulls>>) -> Box<dyn Executable> {
        let Some(device) = device else {
            let views = Views::new(&self.scan, &self.scene, ViewTraining::PADDING);
            return Box::new(ViewTraining::new(self.rule, views, pulls.clone()));
        };
        let views = (Views::new(&self.scan, &self.scene, 0), resident);
        let parts = (self.loss.as_ref(), &self.priors[..]);
        Box::new(DeviceTraining::new(device, MOST, self.rule, views, parts, pulls.clone()).unwrap())
    }

    fn blocks(&self) -> Vec<BlockWork<'_>> {
        let spacing = [0.03, 0.035, 0.04];
        self.priors.iter().map(|p| BlockWork { prior: p.as_ref(), corners: &CORNERS, spacing }).collect()
    }

    fn work<'a>(&'a self, step: u64, priors: &'a [BlockWork<'a>]) -> Work<'a> {
        Work { step, seed: 5, loss: self.loss.as_ref(), rays: &[], points: &[], priors }
    }
}

/// The first number of an array that differs from another's by more than `share` of the largest of its kind, of 11.
fn stray(found: &[f32], wanted: &[f32], share: f32) -> Option<String> {
    for kind in 0..NUMBERS {
        let of = |x: &[f32]| x.iter().skip(kind).step_by(NUMBERS).copied().collect::<Vec<f32>>();
        let (found, wanted) = (of(found), of(wanted));
        let largest = wanted.iter().fold(0.0f32, |m, x| m.max(x.abs()));
        let away = |(i, (a, b)): (usize, (&f32, &f32))| {
            let far = (a - b).abs() > share * largest || a.is_nan();
            far.then(|| format!("number {kind} of Gaussian {i}: {a} for {b} of {largest}"))
        };
        if let Some(away) = found.iter().zip(&wanted).enumerate().find_map(away) {
            return Some(away);
        }
    }
    None
}

fn close(found: &[f32], wanted: &[f32], share: f32, what: &str) {
    assert_eq!(stray(found, wanted, share), None, "{what}");
}

#[test]
fn gradients_and_updates_are_those_of_the_cpu() {
    for (limits, backend) in on_devices() {
        for (source, ssim, prior, resident) in
            [(500.0, 0.0, false, true), (500.0, 0.5, false, false), (500.0, 0.5, true, true), (1e8, 0.5, true, true)]
        {
            let what = format!("{limits}, source at {source}, ssim {ssim}, prior {prior}");
            let both = Both::new(source, ssim, prior);
            let priors = both.blocks();
            let backends: [&dyn Backend; 2] = [&Cpu::new(), backend];
            let [host, device] = backends.map(|backend| {
                let pulls = no_pulls();
                let (mut model, mut exe) = (mixture(0.01), both.on(backend.device(), resident, &pulls));
                let mut stats = vec![];
                for step in 0..2 {
                    stats.push(exe.step(&mut model, &both.work(step, &priors)).unwrap());
                    if step == 0 {
                        exe.update(&mut model, &ADAM).unwrap();
                    }
                }
                exe.fetch(&mut model).unwrap();
                let pulls = pulls.lock().unwrap().clone();
                (model, stats, pulls)
            });
            for (a, b) in host.1.iter().zip(&device.1) {
                let near = |a: f64, b: f64| (a - b).abs() <= 2e-5 * a.abs();
                assert!(near(a.loss, b.loss) && near(a.prior, b.prior), "{what}: {a:?} {b:?}");
                assert!(a.samples == b.samples && a.loss > 0.0, "{what}: {a:?} {b:?}");
            }
            let (a, b) = (&host.0.arena, &device.0.arena);
            close(&b.grads, &a.grads, 2e-3, &format!("{what}: gradients"));
            close(&b.first, &a.first, 2e-3, &format!("{what}: first moments"));
            close(&b.params, &a.params, 1e-4, &format!("{what}: parameters"));
            let pulls = |p: &Pulls| p.sums.iter().sum::<f32>();
            assert!((pulls(&host.2) - pulls(&device.2)).abs() < 1e-3 * pulls(&host.2), "{what}");
            assert_eq!(host.2.counts, device.2.counts, "{what}");
            assert!(a.grads.iter().any(|g| *g != 0.0));
        }
    }
}

#[test]
fn values_and_line_integrals_are_those_of_the_cpu() {
    let (model, scan) = (mixture(0.04), views(500.0));
    let scene = Scene::with_attenuation(scan.geometry.volume, &SceneSettings::default(), 0.02).unwrap();
    let grid = UnitGrid { first: [0.1, 0.2, 0.05], spacing: [0.021, 0.03, 0.017], shape: [19, 21, 23] };
    let mut rng = StdRng::seed_from_u64(4);
    let points: Vec<[f32; 3]> = (0..333).map(|_| std::array::from_fn(|_| rng.random())).collect();
    let rays: Vec<_> = (0..37 * 45).map(|i| scene.pixel_ray(&scan.geometry, i % 5, i / 45, i % 45)).collect();
    let all = |backend: &dyn Backend| {
        let mut exe = backend.compile(&model.pipeline).unwrap().0;
        let mut found = [vec![0.0; 19 * 21 * 23], vec![0.0; points.len()], vec![0.0; rays.len()]];
        exe.values(&model, &grid, &mut found[0]).unwrap();
        exe.evaluate(&model, &points, &mut found[1]).unwrap();
        exe.render(&model, &rays, &mut found[2]).unwrap();
        found
    };
    let wanted = all(&Cpu::new());
    // Lists larger than a buffer: a grid in pieces, fewer cells.
    let little = Limits { binding_bytes: Some(40_000), ..Limits::default() };
    let mut backends = on_devices();
    let little = (!backends.is_empty()).then(|| Wgpu::with_limits(None, little).unwrap());
    backends.extend(little.iter().map(|little| ("small lists", little)));
    for (limits, backend) in backends {
        for (name, (found, wanted)) in ["grid", "points", "rays"].iter().zip(all(backend).iter().zip(&wanted)) {
            let largest = wanted.iter().fold(0.0f32, |m, x| m.max(x.abs()));
            assert!(largest > 0.0);
            for (i, (a, b)) in found.iter().zip(wanted).enumerate() {
                assert!((a - b).abs() < 1e-3 * largest, "{limits}, {name} {i}: {a} for {b} of {largest}");
            }
        }
    }
}

#[test]
fn a_run_ends_where_the_cpu_does() {
    let (wanted, _) = &*ON_CPU;
    for (limits, backend) in on_devices() {
        let (found, records) = psnr(&longer(), backend);
        println!("{limits}: {found:.3} dB, the CPU {wanted:.3} dB");
        assert!((found - wanted).abs() < 0.3, "{found} {wanted}");
        assert!(records.iter().any(|r| r.events.iter().any(|e| e.contains("cloned"))), "no density control");
    }
}

/// A program with `to` in place of `from`.
fn edited(program: &Program, from: &str, to: &str) -> Program {
    let (bound, rest): (Vec<&str>, Vec<&str>) =
        program.source.text().lines().partition(|line| line.starts_with("@group(0) @binding"));
    let mut source = Source::default();
    for (binding, line) in program.source.bindings().iter().zip(bound) {
        let kind = line.split_once(": ").unwrap().1.trim_end_matches(';');
        source.bind(&binding.name, binding.access, kind);
    }
    let rest = rest.join("\n");
    assert!(rest.contains(from), "{}: {from}", program.label);
    source.add("edited", &rest.replace(from, to));
    Program { label: program.label.clone(), source }
}

/// A device that counts launches and submissions, and may run a program with one piece of its text replaced.
struct Watched {
    inner: Box<dyn Device>,
    counts: Arc<Mutex<[usize; 2]>>,
    fault: Option<[&'static str; 3]>,
}

impl Device for Watched {
    fn name(&self) -> String {
        self.inner.name()
    }
    fn is_software(&self) -> bool {
        self.inner.is_software()
    }
    fn most_bytes(&self) -> u64 {
        self.inner.most_bytes()
    }
    fn admits(&self, program: &Program) -> Result<()> {
        self.inner.admits(program)
    }
    fn reserve(&mut self, name: &str, bytes: u64) -> Result<()> {
        self.inner.reserve(name, bytes)
    }
    fn write(&mut self, name: &str, data: &[u8]) -> Result<()> {
        self.inner.write(name, data)
    }
    fn read(&mut self, name: &str, at: u64, out: &mut [u8]) -> Result<()> {
        self.inner.read(name, at, out)
    }
    fn copy(&mut self, from: &str, at: u64, to: &str, bytes: u64) -> Result<()> {
        self.inner.copy(from, at, to, bytes)
    }
    fn run(&mut self, launches: &[Launch<'_>]) -> Result<()> {
        let mut counts = self.counts.lock().unwrap();
        *counts = [counts[0] + launches.len(), counts[1] + 1];
        let Some([label, from, to]) = self.fault else { return self.inner.run(launches) };
        let program = |p: &Program| if p.label == label { edited(p, from, to) } else { p.clone() };
        let edited: Vec<(Program, usize)> = launches.iter().map(|(p, groups)| (program(p), *groups)).collect();
        self.inner.run(&edited.iter().map(|(program, groups)| (program, *groups)).collect::<Vec<_>>())
    }
}

/// Two bins with 2^31 Gaussians each: their lists have no room, and the sum of their lengths does not wrap.
#[test]
fn lists_beyond_32_bits_are_refused() {
    let add = "atomicAdd(&counts[bin], 1u);";
    let many = "atomicOr(&counts[0], 0x80000000u); atomicOr(&counts[1], 0x80000000u);";
    for (limits, backend) in on_devices() {
        let (inner, counts) = (backend.device().unwrap(), Arc::new(Mutex::new([0; 2])));
        let device = Watched { inner, counts, fault: Some(["gaussians: count", add, many]) };
        let model = mixture(0.01);
        let mut field = model.pipeline.field.lines().unwrap().on_device(Box::new(device)).unwrap();
        field.load(&model.arena.params).unwrap();
        let grid = UnitGrid { first: [0.1; 3], spacing: [0.1; 3], shape: [1, 8, 8] };
        let e = field.values(&grid, &mut [0.0; 64]).unwrap_err().to_string();
        assert!(e.contains("entries"), "{limits}: {e}");
    }
}

/// A step moves numbers: views stay on the device, and so do Gaussians with their gradients and moments.
#[test]
fn a_step_moves_numbers_and_launches_few_kernels() {
    let devices = crate::device::alone("bytes of Gaussians");
    for (limits, backend) in devices.iter().filter(|(limits, _)| *limits != "small buffers") {
        // Bytes of a view that is not resident: 37 × 45 pixels, of which two are taken.
        for (resident, ssim, prior, bytes, launches) in [
            (true, 0.5, false, 0, 26),
            (false, 0.5, false, 2 * 4 * 37 * 45, 26),
            (true, 0.0, false, 0, 18),
            (true, 0.5, true, 160, 44),
        ] {
            let both = Both::new(500.0, ssim, prior);
            let priors = both.blocks();
            let counts = Arc::new(Mutex::new([0; 2]));
            let device = Box::new(Watched { inner: backend.device().unwrap(), counts: counts.clone(), fault: None });
            let (mut model, mut exe) = (mixture(0.01), both.on(Some(device), resident, &no_pulls()));
            let mut step = |step| {
                exe.step(&mut model, &both.work(step, &priors)).unwrap();
                exe.update(&mut model, &ADAM).unwrap();
            };
            // The first one loads the Gaussians, and makes the buffers.
            step(0);
            let (before, first) = (backend.moved(), *counts.lock().unwrap());
            step(1);
            let (after, second) = (backend.moved(), *counts.lock().unwrap());
            let what = format!("{limits}, resident {resident}, ssim {ssim}, prior {prior}");
            // Bins and view of two views, the rule; bins and grid of each block.
            assert_eq!(after.to_device - before.to_device, 2 * (32 + 128) + 48 + bytes, "{what}");
            assert_eq!(after.from_device - before.from_device, 16, "{what}");
            assert_eq!(second[0] - first[0], launches, "{what}");
        }
    }
}

/// What a device cannot hold is an error that says so.
#[test]
fn too_small_buffers_are_refused() {
    for (limits, backend) in backends("Gaussians") {
        let Err(e) =
            backend.compile(&mixture(0.01).pipeline).unwrap().0.evaluate(&mixture(0.01), &[[0.5; 3]], &mut [0.0])
        else {
            assert_ne!(limits, "small buffers");
            continue;
        };
        assert_eq!(limits, "small buffers", "{e}");
        assert!(e.to_string().contains("2048 that a kernel may read"), "{e}");
    }
}

/// The comparison with the CPU finds a small fault in each kernel of a step.
#[test]
fn a_faulty_kernel_is_found() {
    let faults = [
        ["gaussians: decode", "log(1.0 + e)", "log(1.02 + e)"],
        ["gaussians: look", "1.0 - m1 * m1 - m2 * m2", "1.1 - m1 * m1 - m2 * m2"],
        ["gaussians: fill", "if at < bins.room", "if at < bins.room && i % 50u != 1u"],
        ["gaussians: project", "exp(-0.5 * x)", "exp(-0.51 * x)"],
        ["gaussians: blur", "column + k >= 5u", "column + k > 5u"],
        ["gaussians: similarity", "view.c2", "1.01 * view.c2"],
        ["gaussians: blur slopes", "sums[m] += tap", "sums[m] += 1.01 * tap"],
        ["gaussians: dissimilar", "2.0 * found[i]", "2.02 * found[i]"],
        ["gaussians: gather", "w * (1.0 - x)", "w * (1.01 - x)"],
        ["gaussians: learn view", "let across = p[3]", "let across = 1.02 * p[3]"],
        ["gaussians: reach", "sqrt(CUT", "sqrt(0.5 * CUT"],
        ["gaussians: paint", "exp(-0.5 * e)", "exp(-0.52 * e)"],
        ["gaussians: penalty 0", "grid.scale * v.y", "1.01 * grid.scale * v.y"],
        ["gaussians: collect", "d.y * d.z, d.z * d.z", "d.y * d.z, 1.05 * d.z * d.z"],
        ["gaussians: learn block", "let d = -s.density", "let d = -1.02 * s.density"],
    ];
    let Some((_, backend)) = on_devices().into_iter().next() else { return };
    let both = Both::new(500.0, 0.5, true);
    let gradients = |device: Option<Box<dyn Device>>| {
        let (mut model, mut exe) = (mixture(0.01), both.on(device, true, &no_pulls()));
        exe.step(&mut model, &both.work(0, &both.blocks())).unwrap();
        exe.fetch(&mut model).unwrap();
        model.arena.grads
    };
    let wanted = gradients(None);
    let on = |fault| {
        let watched = Watched { inner: backend.device().unwrap(), counts: Arc::default(), fault };
        stray(&gradients(Some(Box::new(watched))), &wanted, 2e-3)
    };
    assert_eq!(on(None), None);
    for fault in faults {
        assert!(on(Some(fault)).is_some(), "{fault:?} was not found");
    }
}
