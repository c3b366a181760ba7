//! Projection of voxel volumes on a device against double precision, and classical methods there against the CPU.

use crate::common::{Stop, plan, scan, solve_on, spec, truth};
use conefield_backend_cpu::Cpu;
use conefield_core::arena::Weights;
use conefield_core::backend::Backend;
use conefield_core::geometry::Geometry;
use conefield_core::method::{Job, Observer, Record};
use conefield_core::random::{mix, unit};
use conefield_core::regularizer::{RegularizerSpec, Update};
use conefield_core::resident::{Factors, Volumes};
use conefield_core::scan::ScanHeader;
use conefield_core::space::Space;
use conefield_core::voxel::{VoxelOperator, VoxelProjector, VoxelProjectorSpec};
use conefield_core::wgsl::Fragment;
use ndarray::Array3;
use serde_json::{Value, json};

/// The test scan's geometry with voxels that are no cube, and two tilted views.
fn geometry() -> Geometry {
    let mut g = scan().geometry;
    g.volume.shape = [13, 16, 9];
    g.volume.spacing = [12.0, 10.0, 15.0];
    for view in &mut g.views[..2] {
        view.v = [1.5, -2.0, -17.0];
        view.source[2] += 30.0;
    }
    g
}

fn numbers(shape: impl Into<[usize; 3]>, seed: u64) -> Array3<f64> {
    let shape = shape.into();
    let mut i = 0;
    Array3::from_shape_simple_fn(shape, || {
        i += 1;
        f64::from(unit(mix(seed, i)))
    })
}

/// Largest difference as a share of the largest number.
fn off(found: &Array3<f32>, exact: &Array3<f64>) -> f64 {
    let top = exact.iter().fold(1e-30f64, |m, v| m.max(v.abs()));
    found.iter().zip(exact).map(|(a, b)| (f64::from(*a) - b).abs() / top).fold(0.0, f64::max)
}

/// Positions along a ray are rounded to 2⁻²⁴ of the source's distance in voxels, and weights of neighbouring voxels with
/// them: some 1e-5 of a voxel. An exact length may begin at the other side of a wall, with next to no length.
const LIMIT: f64 = 5e-5;

fn projector(settings: Value) -> Box<dyn VoxelProjector> {
    serde_json::from_value::<Box<dyn VoxelProjectorSpec>>(settings).unwrap().build().unwrap()
}

fn all() -> Vec<Value> {
    vec![json!({"type": "siddon"}), json!({"type": "joseph"}), json!({"type": "trilinear"})]
}

/// Both directions against double precision; how far off they are, and the mismatch of `<Ax, y>` and `<x, Aᵀy>`.
fn errors(p: &dyn VoxelProjector) -> [f64; 3] {
    let g = geometry();
    let views: Vec<usize> = (0..g.views.len()).rev().collect();
    let [rows, columns] = g.detector;
    let (x, y) = (numbers(g.volume.shape, 1), numbers([views.len(), rows, columns], 2));
    let (mut ax, mut aty) = (Array3::zeros(y.dim()), Array3::ones(x.dim()));
    p.reference().forward(&g, &views, x.view(), ax.view_mut());
    p.reference().adjoint(&g, &views, y.view(), aty.view_mut());
    let (x32, y32) = (x.mapv(|v| v as f32), y.mapv(|v| v as f32));
    let (mut found, mut back) = (Array3::<f32>::from_elem(y.dim(), 7.0), Array3::<f32>::ones(x.dim()));
    p.operator().forward(&g, &views, x32.view(), found.view_mut());
    p.operator().adjoint(&g, &views, y32.view(), back.view_mut());
    p.operator().fault().unwrap();
    let dot =
        |a: &Array3<f32>, b: &Array3<f32>| -> f64 { a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum() };
    let (lhs, rhs) = (dot(&found, &y32), dot(&x32, &back.mapv(|v| v - 1.0)));
    [off(&found, &ax), off(&back, &aty), (lhs - rhs).abs() / lhs]
}

#[test]
fn projectors_agree_with_double_precision_and_are_adjoint() {
    for (name, backend) in crate::device::backends("projectors of voxels") {
        for settings in all() {
            let placed = backend.place(projector(settings.clone())).unwrap();
            assert!(placed.describe().contains(", on "), "{}", placed.describe());
            let [forward, adjoint, mismatch] = errors(placed.as_ref());
            println!("{settings}, {name}: forward {forward:.1e}, adjoint {adjoint:.1e}, mismatch {mismatch:.1e}");
            assert!(forward < LIMIT && adjoint < LIMIT && mismatch < 1e-5, "{settings}, {name}");
        }
    }
}

/// A projector whose WGSL is another's, changed.
struct Changed(Box<dyn VoxelProjector>, fn(&str) -> Option<String>);
impl VoxelProjector for Changed {
    fn operator(&self) -> &dyn VoxelOperator<f32> {
        self.0.operator()
    }
    fn reference(&self) -> &dyn VoxelOperator<f64> {
        self.0.reference()
    }
    fn describe(&self) -> String {
        "changed: for a test".into()
    }
    fn wgsl(&self) -> Option<Fragment> {
        Some(Fragment { source: self.1(&self.0.wgsl()?.source)? })
    }
}

#[test]
fn a_perturbed_walk_is_found_and_what_cannot_run_is_refused() {
    let Some((_, backend)) = crate::device::backends("negative controls").into_iter().next() else { return };
    let placed = |change| backend.place(Box::new(Changed(projector(json!({"type": "joseph"})), change)));
    let wrong = placed(|s| Some(s.replace("fa * fb * step", "fa * fb * 1.01 * step"))).unwrap();
    let [forward, adjoint, mismatch] = errors(wrong.as_ref());
    assert!(forward > LIMIT && adjoint > LIMIT && mismatch < 1e-5, "{forward} {adjoint} {mismatch}");
    let e = placed(|_| None).err().unwrap().to_string();
    assert!(e.contains("changed") && e.contains("no WGSL") && e.contains("--backend cpu"), "{e}");
    let e = placed(|s| Some(s.replace("let fb", "let fc"))).err().unwrap().to_string();
    assert!(e.contains("projector (changed") && e.contains("line"), "{e}");
}

/// Three updates with gradients and masks on the device and on the host; the largest difference of each array, and of the
/// line integrals, as a share of the array's largest number. `change` changes the WGSL.
fn updates_differ(
    backend: &dyn Backend,
    prior: &Value,
    [pulled, masked]: [bool; 2],
    tau: f32,
    change: fn(String) -> String,
) -> conefield_core::Result<f64> {
    let g = geometry();
    let joseph = projector(json!({"type": "joseph"}));
    let placed = backend.place(projector(json!({"type": "joseph"})))?;
    let space = Space::new(ScanHeader { views: 0, detector: [0; 2], volume: g.volume.shape });
    let on = || {
        let spec: Box<dyn RegularizerSpec> = serde_json::from_value(prior.clone()).unwrap();
        spec.build().unwrap().on(&g.volume, &space).unwrap()
    };
    let (mut here, mut there) = (on(), on());
    let volume = |seed| numbers(g.volume.shape, seed).mapv(|v| v as f32);
    let (mut x, mut ahead, towards) = (volume(1), volume(2), volume(3));
    // Edges of the coefficients.
    assert_eq!(here.adapt(x.view()), there.adapt(x.view()));
    let inside: Vec<bool> = (0..x.len()).map(|i| i % 7 != 0).collect();
    let (towards, inside) = (pulled.then(|| towards.as_slice().unwrap()), masked.then_some(&inside[..]));
    let mut dual = there.dual().unwrap();
    dual.fragment.source = change(dual.fragment.source);
    let (all, shape) = (x.len(), g.volume.shape);
    let volumes = Volumes {
        shape,
        x: x.as_slice().unwrap(),
        ahead: ahead.as_slice().unwrap(),
        towards,
        inside,
        dual: Some(dual),
    };
    let mut device = placed.resident(volumes).expect("a device")?;
    let views: Vec<usize> = (0..g.views.len()).rev().collect();
    let [rows, columns] = g.detector;
    let mut worst = 0.0f64;
    let mut compare = |found: &[f32], want: &[f32]| {
        let top = want.iter().fold(1e-30f32, |m, v| m.max(v.abs()));
        let off = found.iter().zip(want).map(|(a, b)| f64::from((a - b).abs() / top)).fold(0.0, f64::max);
        worst = worst.max(off);
    };
    for seed in 10..13 {
        let (mut want, mut found) =
            (Array3::zeros((views.len(), rows, columns)), Array3::zeros((views.len(), rows, columns)));
        joseph.operator().forward(&g, &views, ahead.view(), want.view_mut());
        device.forward(&g, &views, found.view_mut())?;
        compare(found.as_slice().unwrap(), want.as_slice().unwrap());
        let images = numbers(want.dim(), seed).mapv(|v| (v - 0.5) as f32);
        let mut gradient = Array3::zeros(shape);
        joseph.operator().adjoint(&g, &views, images.view(), gradient.view_mut());
        device.adjoint(&g, &views, images.view())?;
        let factors = Factors { step: 0.01, momentum: 0.6, pull: 0.2, tau };
        here.update(
            Update {
                gradient: gradient.as_slice_mut().unwrap(),
                ahead: ahead.as_slice_mut().unwrap(),
                x: x.as_slice_mut().unwrap(),
                step: factors.step,
                momentum: factors.momentum,
                towards: towards.map(|towards| (towards, factors.pull)),
                inside,
            },
            tau,
        );
        device.update(factors)?;
        if let (Some(_), Some(dual)) = (here.adapt(x.view()), here.dual()) {
            device.guide(dual.guide.unwrap())?;
        }
    }
    let mut arrays: [Vec<f32>; 5] = std::array::from_fn(|_| vec![f32::NAN; all]);
    let [found, before, p, q, r] = &mut arrays;
    device.coefficients(found)?;
    device.rest(before, [p, q, r])?;
    let [p, q, r] = here.dual().unwrap().p;
    let want = [x.as_slice().unwrap(), ahead.as_slice().unwrap(), p, q, r];
    arrays.iter().zip(want).for_each(|(found, want)| compare(found, want));
    Ok(worst)
}

#[test]
fn updates_on_the_device_are_those_of_the_host() {
    let priors = [
        json!({"type": "total-variation", "inner": 3}),
        json!({"type": "directional-total-variation", "edge": 0.5, "inner": 4}),
    ];
    for (name, backend) in crate::device::backends("updates") {
        for prior in &priors {
            for [pulled, masked] in [[false, false], [true, false], [false, true], [true, true]] {
                for tau in [0.0, 0.2] {
                    let found = updates_differ(&backend, prior, [pulled, masked], tau, |s| s);
                    if name == "small buffers" {
                        let e = found.unwrap_err().to_string();
                        assert!(e.contains("a volume takes 7488 bytes, a buffer holds 2048"), "{e}");
                        continue;
                    }
                    let off = found.unwrap();
                    println!("{}, pull {pulled}, mask {masked}, weight {tau}, {name}: {off:.1e}", prior["type"]);
                    assert!(off < LIMIT, "{prior}, pull {pulled}, mask {masked}, weight {tau}, {name}: {off}");
                }
            }
        }
    }
}

#[test]
fn a_perturbed_prior_is_found_and_one_without_wgsl_travels() {
    let Some((_, backend)) = crate::device::backends("negative controls").into_iter().next() else { return };
    let prior = json!({"type": "total-variation"});
    let wrong = |s: String| s.replace("p + d", "p + 1.01 * d");
    assert!(updates_differ(&backend, &prior, [false; 2], 0.2, wrong).unwrap() > LIMIT);
    let invalid = |s: String| s.replace("let q", "let r");
    let e = updates_differ(&backend, &prior, [false; 2], 0.2, invalid).unwrap_err().to_string();
    assert!(e.contains("penalty") && e.contains("line"), "{e}");
    let method = json!({"type": "fista", "prior": {"type": "none"}, "stop": {"passes": 1}});
    let said = notes(&method, &backend);
    assert!(said.iter().any(|n| n.contains("the volumes are copied") && n.contains("no WGSL")), "{said:?}");
}

/// Keeps what a run notes.
struct Notes(Vec<String>);
impl Observer for Notes {
    fn progress(&mut self, _: u64, _: f64, _: f64) {}
    fn record(&mut self, _: &Record) {}
    fn note(&mut self, line: &str) {
        self.0.push(line.into());
    }
}

fn notes(method: &Value, backend: &dyn Backend) -> Vec<String> {
    let (scan, mut notes) = (scan(), Notes(vec![]));
    let mut plan = plan(&spec(method).unwrap(), backend, &Weights::default()).unwrap();
    plan.run(&Job { seed: 7, ..Job::new(&scan, backend) }, &mut notes).unwrap();
    notes.0
}

#[test]
fn volumes_stay_on_the_device_also_across_a_checkpoint() {
    let method = json!({
        "type": "fista", "basis": {"type": "cubic", "spacing": 1.5}, "stop": {"passes": 6}, "subsets": 4,
        "prior": {"type": "directional-total-variation"}, "scene": {"support": "carve"},
    });
    for (name, backend) in crate::device::backends("checkpoints of volumes") {
        let said = notes(&method, &backend);
        let stay = if name == "small buffers" { "the volumes are copied" } else { "the volumes stay on the device" };
        assert!(said.iter().any(|n| n.contains(stay)), "{name}: {said:?}");
        let scan = scan();
        let mut plan = plan(&spec(&method).unwrap(), &backend, &Weights::default()).unwrap();
        let job = Job { seed: 7, ..Job::new(&scan, &backend) };
        let whole = plan.run(&job, &mut Notes(vec![])).unwrap().result.volume(&backend).unwrap().data;
        let mut stop = Stop::at(3);
        let _ = plan.run(&job, &mut stop);
        let kept = stop.kept.expect("a checkpoint");
        assert_eq!(kept.standing.step, 3);
        let resumed = Job { resume: Some(&kept), ..job };
        let resumed = plan.run(&resumed, &mut Notes(vec![])).unwrap().result.volume(&backend).unwrap().data;
        let error = off(&resumed, &whole.mapv(f64::from));
        println!("{name}: {error:.1e}");
        assert!(error < 1e-4, "{name}: {error}");
        // A run that forgets its momentum ends elsewhere.
        let (fresh, _) = solve_on(&backend, &json!({"type": "chain", "methods": [
            {"type": "fista", "basis": method["basis"], "stop": {"passes": 3}, "subsets": 4, "prior": method["prior"], "scene": method["scene"]},
            {"type": "fista", "basis": method["basis"], "stop": {"passes": 3}, "subsets": 4, "prior": method["prior"], "scene": method["scene"]},
        ]}), &scan, &Weights::default()).unwrap();
        let fresh = fresh.result.volume(&backend).unwrap().data;
        assert!(off(&fresh, &whole.mapv(f64::from)) > 1e-3, "{name}");
    }
}

fn psnr(spec: &Value, backend: &dyn Backend) -> f64 {
    let (solution, _) = solve_on(backend, spec, &scan(), &Weights::default()).unwrap();
    let (found, truth) = (solution.result.volume(backend).unwrap(), truth());
    let square = |(a, b): (&f32, &f32)| (f64::from(*a) - f64::from(*b)).powi(2);
    let mse = found.data.iter().zip(&truth.data).map(square).sum::<f64>() / truth.data.len() as f64;
    decibels(mse)
}

fn decibels(mse: f64) -> f64 {
    10.0 * (0.02f64.powi(2) / mse).log10()
}

#[test]
fn classical_methods_end_where_the_cpu_does() {
    let methods = [
        json!({"type": "fdk"}),
        json!({"type": "sart", "stop": {"passes": 3}}),
        json!({"type": "cgls", "stop": {"passes": 5}}),
        json!({"type": "fista", "prior": {"type": "total-variation"}, "stop": {"passes": 5}}),
        json!({"type": "fista", "prior": {"type": "directional-total-variation"}, "stop": {"passes": 5},
            "basis": {"type": "cubic", "spacing": 1.5}, "scene": {"support": "carve"}}),
    ];
    // On the CPU, wherever this runs: a method that makes next to nothing would agree with anything.
    let empty = decibels(truth().data.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / truth().data.len() as f64);
    let on_cpu: Vec<f64> = methods.iter().map(|m| psnr(m, &Cpu::new())).collect();
    for (method, cpu) in methods.iter().zip(&on_cpu) {
        println!("{}: {cpu:.4} dB, an empty volume {empty:.4} dB", method["type"]);
        assert!(*cpu > empty + 3.0, "{method}: {cpu} dB, an empty volume {empty} dB");
    }
    for (name, backend) in crate::device::backends("classical methods") {
        for (method, cpu) in methods.iter().zip(&on_cpu) {
            let found = psnr(method, &backend);
            println!("{}, {name}: {found:.4} dB, CPU {cpu:.4} dB", method["type"]);
            assert!((cpu - found).abs() < 0.01, "{method}, {name}: {found} dB, CPU {cpu} dB");
        }
    }
}
