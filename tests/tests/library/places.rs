//! Places: projection against double precision, all other work against the host, what moves, and classical methods against
//! the CPU.

use crate::common::{Heard, In, apart, decibels, planned, protocol, psnr, scan, solve_on, truth, voxels};
use crate::ranks::rms;
use conefield_backend_cpu::Cpu;
use conefield_core::backend::Backend;
use conefield_core::data_term::DataTermSpec;
use conefield_core::geometry::Geometry;
use conefield_core::method::Job;
use conefield_core::place::{
    Array, Host, Map, Place, ProximalStep, Reduction, StatePart, Streamed, ViewRays, Weighing,
};
use conefield_core::random::{mix, unit};
use conefield_core::regularizer::{Bounds, Dual, Kernels, Penalty, RegularizerSpec};
use conefield_core::scan::{Scan, ScanHeader, Volume};
use conefield_core::space::Space;
use conefield_core::voxel::{VoxelOperator, VoxelProjector, VoxelProjectorSpec};
use conefield_core::wgsl::Fragment;
use conefield_projectors::simulate::simulate;
use conefield_solvers::iterative::tv::descend;
use ndarray::{Array3, ArrayView3, ArrayViewMut3, s};
use serde_json::{Value, json};
use std::sync::Arc;

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

/// The same detectors in a parallel beam.
fn parallel() -> Geometry {
    let mut g = geometry();
    let volume = g.volume;
    g.views.iter_mut().for_each(|view| *view = view.parallel(view.normal().0, &volume));
    assert!((0..g.views.len()).all(|view| g.is_parallel(view)));
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
fn errors(place: &dyn Place, p: &dyn VoxelProjector, g: &Geometry) -> conefield_core::Result<[f64; 3]> {
    let views: Vec<usize> = (0..g.views.len()).rev().collect();
    let [rows, columns] = g.detector;
    let (x, y) = (numbers(g.volume.shape, 1), numbers([views.len(), rows, columns], 2));
    let (mut ax, mut aty) = (Array3::zeros(y.dim()), Array3::ones(x.dim()));
    p.reference().forward(g, &views, x.view(), ax.view_mut());
    p.reference().adjoint(g, &views, y.view(), aty.view_mut());
    let (x32, y32) = (x.mapv(|v| v as f32), y.mapv(|v| v as f32));
    // Room for more views than are asked for.
    let mut found = place.adopt(Array3::from_elem((views.len() + 3, rows, columns), 7.0))?;
    let rays = ViewRays { projector: p, geometry: g, views: &views };
    place.forward(rays, &place.adopt(x32.clone())?, &mut found)?;
    let mut back = place.adopt(Array3::ones(x.dim()))?;
    place.adjoint(rays, &place.adopt(y32.clone())?, &mut back)?;
    let found = place.take(found)?.slice_move(s![..views.len(), .., ..]);
    let back = place.take(back)?;
    let dot =
        |a: &Array3<f32>, b: &Array3<f32>| -> f64 { a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum() };
    let (lhs, rhs) = (dot(&found, &y32), dot(&x32, &back.mapv(|v| v - 1.0)));
    Ok([apart(&found, &ax), apart(&back, &aty), (lhs - rhs).abs() / lhs])
}

/// The host, and the device with several limits.
fn places(what: &str) -> Vec<(&'static str, Arc<dyn Place>)> {
    let host: (_, Arc<dyn Place>) = ("host", Arc::new(Host));
    let there = crate::device::backends(what).into_iter().map(|(name, backend)| (name, backend.place()));
    [host].into_iter().chain(there).collect()
}

#[test]
fn projectors_agree_with_double_precision_and_are_adjoint() {
    for (name, place) in places("projectors of voxels") {
        let mut around = parallel();
        around.volume.spacing = around.volume.spacing.map(|h| 3.0 * h);
        for (beam, g) in [("cone", geometry()), ("parallel", parallel()), ("parallel, a larger volume", around)] {
            for settings in all() {
                let p = projector(settings.clone());
                let [forward, adjoint, mismatch] = errors(place.as_ref(), p.as_ref(), &g).unwrap();
                let what = format!("{settings}, {beam}, {name}");
                println!("{what}: forward {forward:.1e}, adjoint {adjoint:.1e}, mismatch {mismatch:.1e}");
                assert!(forward < LIMIT && adjoint < LIMIT && mismatch < 1e-5, "{what}");
            }
        }
    }
}

/// A projector whose WGSL is another's, changed.
struct ChangedWalk(Box<dyn VoxelProjector>, fn(&str) -> Option<String>);
impl VoxelProjector for ChangedWalk {
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
    let place = backend.place();
    let changed = |change| ChangedWalk(projector(json!({"type": "joseph"})), change);
    let wrong = changed(|s| Some(s.replace("fa * fb * step", "fa * fb * 1.01 * step")));
    let [forward, adjoint, mismatch] = errors(place.as_ref(), &wrong, &geometry()).unwrap();
    assert!(forward > LIMIT && adjoint > LIMIT && mismatch < 1e-5, "{forward} {adjoint} {mismatch}");
    let e = place.admits(&changed(|_| None)).unwrap_err().to_string();
    assert!(e.contains("changed") && e.contains("no WGSL") && e.contains("--backend cpu"), "{e}");
    let e = place.admits(&changed(|s| Some(s.replace("let fb", "let fc")))).unwrap_err().to_string();
    assert!(e.contains("projector (changed") && e.contains("line"), "{e}");
}

/// Numbers of a shape that small buffers cut into parts, some 0.
fn volume(shape: [usize; 3], seed: u64) -> Array3<f32> {
    numbers(shape, seed).mapv(|v| if v < 0.1 { 0.0 } else { v as f32 - 0.5 })
}

#[test]
fn maps_masks_and_reductions_are_those_of_the_host() {
    let shape = [11, 7, 19];
    for (name, place) in places("maps and reductions") {
        let arrays = [1, 2, 3].map(|seed| volume(shape, seed));
        let inside = Array3::from_shape_fn(shape, |(x, y, z)| (x + 2 * y + z) % 5 != 0);
        let on = |place: &dyn Place| -> conefield_core::Result<(Vec<Array3<f32>>, Vec<f64>)> {
            let [o, x, y] = arrays.clone().map(|a| place.adopt(a).unwrap());
            let mask = place.mask(inside.clone())?;
            let mut found = vec![];
            for map in Map::ALL {
                let mut out = place.adopt(arrays[0].clone())?;
                place.map(map, [0.25, 0.125], &mut out, &[&x, &y][..map.inputs])?;
                found.push(place.take(out)?);
            }
            let mut out = place.adopt(arrays[0].clone())?;
            place.keep(&mut out, &mask, -3.0)?;
            place.scatter(&x, 0, &mut out, &[9, 0, 4])?;
            place.scatter(&x, 7, &mut out, &[2, 10])?;
            found.push(place.take(out)?);
            let mut out = place.zeros(shape)?;
            place.fill(&mut out, 1.5)?;
            place.load(arrays[2].slice(s![3..9, .., ..]), &mut out, 4)?;
            let mut part = Array3::zeros((5, shape[1], shape[2]));
            place.store(&out, 5, part.view_mut())?;
            found.extend([place.take(out)?, part]);
            let numbers = Reduction::ALL.iter().map(|kind| place.reduce(*kind, &o, &y)).collect::<Result<_, _>>()?;
            Ok((found, numbers))
        };
        let ((want, sums), (found, numbers)) = (on(&Host).unwrap(), on(place.as_ref()).unwrap());
        for (k, (want, found)) in want.iter().zip(&found).enumerate() {
            let off = apart(found, want);
            assert!(off < 1e-6, "{name}, {k}: {off}");
        }
        assert!(sums[1] > 100.0 && sums[3] > 1000.0);
        for (want, found) in sums.iter().zip(&numbers) {
            assert!((found / want - 1.0).abs() < 1e-6, "{name}: {found} and {want}");
        }
    }
}

#[test]
fn a_sum_of_many_numbers_is_exact_to_single_precision() {
    for (name, place) in places("long sums") {
        // In plain single precision the small ones would be lost.
        let mut x = Array3::from_elem((256, 128, 128), 1e-3f32);
        x[[0, 0, 0]] = 1e3;
        let found = match place.adopt(x.clone()).and_then(|x| place.reduce(Reduction::Squares, &x, &x)) {
            Ok(found) => found,
            Err(e) => {
                assert_eq!(name, "small buffers", "{e}");
                continue;
            }
        };
        let want: f64 = x.iter().map(|x| f64::from(*x).powi(2)).sum();
        assert!((found / want - 1.0).abs() < 1e-7, "{name}: {found} and {want}");
    }
}

#[test]
fn arrays_larger_than_all_staging_buffers_arrive_whole() {
    let shape = (83, 1024, 1024);
    let mut i = 0u32;
    let x = Array3::from_shape_simple_fn(shape, || {
        i = i.wrapping_add(0x9e37_79b9);
        (i >> 8) as f32
    });
    for (name, place) in places("large arrays") {
        let there = match place.adopt(x.clone()) {
            Ok(there) => there,
            // A plane does not fit.
            Err(e) => {
                assert_eq!(name, "small buffers", "{e}");
                continue;
            }
        };
        assert!(place.read(&there).unwrap() == x, "{name}");
        if name == "own limits" {
            return;
        }
    }
}

#[test]
fn data_terms_are_those_of_the_host() {
    let scan = scan();
    let views = [5, 2, 7];
    let [rows, columns] = scan.geometry.detector;
    let shadow = Array3::from_shape_fn(scan.projections.dim(), |(v, r, c)| (v + r + 3 * c) % 4 != 0);
    let lines = numbers([4, rows, columns], 5).mapv(|v| v as f32);
    let factors = numbers(scan.projections.dim(), 6).mapv(|v| v as f32);
    let specs = [json!({"type": "least-squares"}), json!({"type": "noise-weighted"})];
    let mut noisy = scan.projections.clone();
    noisy.iter_mut().zip(numbers(scan.projections.dim(), 9).iter()).for_each(|(p, n)| *p += 0.1 * *n as f32 * *p);
    for (name, place) in places("data terms") {
        for spec in &specs {
            let spec: Box<dyn DataTermSpec> = serde_json::from_value(spec.clone()).unwrap();
            let term = spec.build().unwrap().of(noisy.view()).unwrap();
            for [with_term, masked, weighted, resident] in (0..16).map(|k| [1, 2, 4, 8].map(|bit| k & bit != 0)) {
                let on = |place: &dyn Place| -> conefield_core::Result<(Array3<f32>, [f64; 2], Array3<f32>)> {
                    let mut held = place.views(&noisy)?;
                    held.here = held.here.filter(|_| resident);
                    let (mask, weights) = (place.mask(shadow.clone())?, place.adopt(factors.clone())?);
                    let by = Weighing {
                        views: &held,
                        shadow: masked.then_some(&mask),
                        weights: weighted.then_some(&weights),
                        term: with_term.then_some(term.as_ref()),
                    };
                    let mut images = place.adopt(lines.clone())?;
                    let sums = place.compare(&by, &views, &mut images)?;
                    let mut weighed = place.adopt(lines.clone())?;
                    let by = Weighing { term: Some(term.as_ref()), ..by };
                    place.weigh(&by, false, &views, &mut weighed)?;
                    place.weigh(&by, true, &views, &mut weighed)?;
                    Ok((place.take(images)?, sums, place.take(weighed)?))
                };
                let ((want, sums, values), (found, others, weighed)) =
                    (on(&Host).unwrap(), on(place.as_ref()).unwrap());
                let case = format!("{name}, {}, {with_term} {masked} {weighted} {resident}", term.describe());
                let off = [(&found, &want), (&weighed, &values)].map(|(a, b)| apart(a, b));
                assert!(off[0] < 1e-5 && off[1] < 1e-5, "{case}: {off:?}");
                for (want, found) in sums.iter().zip(others) {
                    assert!(*want > 0.1 && (found / want - 1.0).abs() < 1e-5, "{case}: {found} and {want}");
                }
            }
        }
    }
}

/// Three updates with gradients and masks in a place and on the host; the largest difference of each array as a share of
/// the array's largest number. `change` changes the penalty in the place.
fn updates_differ(
    place: &Arc<dyn Place>,
    prior: &Value,
    [pulled, masked, bounded]: [bool; 3],
    tau: f32,
    change: fn(Box<dyn Penalty>) -> Box<dyn Penalty>,
) -> conefield_core::Result<f64> {
    let g = geometry();
    let on = |place: &Arc<dyn Place>| {
        let space = Space::new(ScanHeader { views: 0, detector: [0; 2], volume: g.volume.shape }, place.clone());
        let spec: Box<dyn RegularizerSpec> = serde_json::from_value(prior.clone()).unwrap();
        let mut penalty = spec.build().unwrap().on(&g.volume, &space)?;
        if bounded {
            penalty.confine(Bounds { low: -0.1, high: 0.3 })?;
        }
        penalty.limited([0.6, -0.8, 0.0]);
        Ok(penalty)
    };
    let run = |place: &Arc<dyn Place>, mut penalty: Box<dyn Penalty>| -> conefield_core::Result<Vec<Array3<f32>>> {
        let adopt = |seed| place.adopt(numbers(g.volume.shape, seed).mapv(|v| v as f32));
        let (mut x, mut ahead, towards) = (adopt(1)?, adopt(2)?, adopt(3)?);
        let mut kept = Array3::from_elem(g.volume.shape, true);
        kept.iter_mut().step_by(7).for_each(|inside| *inside = false);
        let inside = place.mask(kept)?;
        let mut numbers = vec![];
        for seed in 10..13 {
            if penalty.adapts() {
                numbers.extend(place.adapt(penalty.as_mut(), &x)?);
            }
            let mut gradient = place.adopt(volume(g.volume.shape, seed))?;
            let step = ProximalStep {
                gradient: &mut gradient,
                ahead: &mut ahead,
                x: &mut x,
                towards: pulled.then_some((&towards, 0.2)),
                inside: masked.then_some(&inside),
                step: 0.3,
                momentum: 0.6,
            };
            place.update(step, tau, penalty.as_mut())?;
            numbers.push(place.penalty(penalty.as_mut(), &x)?);
        }
        let state = penalty.state();
        let state = state.iter().map(|(_, part)| Ok(part.read(place.as_ref())?.into_owned()));
        let state = state.collect::<conefield_core::Result<Vec<Vec<f32>>>>()?;
        let state = state.into_iter().map(|p| Array3::from_shape_vec(g.volume.shape, p).unwrap());
        // Each number in an array of its own.
        let numbers = numbers.into_iter().map(|x| Array3::from_elem((1, 1, 1), x as f32));
        Ok([place.take(x)?, place.take(ahead)?].into_iter().chain(state).chain(numbers).collect())
    };
    let host: Arc<dyn Place> = Arc::new(Host);
    let (want, found) = (run(&host, on(&host)?)?, run(place, change(on(place)?))?);
    assert_eq!(want.len(), found.len());
    Ok(want.iter().zip(&found).map(|(want, found)| apart(found, want)).fold(0.0, f64::max))
}

#[test]
fn updates_in_a_place_are_those_of_the_host() {
    let priors = [
        json!({"type": "none"}),
        json!({"type": "total-variation", "inner": 3}),
        json!({"type": "directional-total-variation", "edge": 0.5, "inner": 4}),
        json!({"type": "total-variation", "inner": 3, "arc": 0.3}),
        json!({"type": "directional-total-variation", "edge": 0.5, "inner": 4, "arc": 0.3}),
    ];
    for (name, place) in places("updates") {
        for prior in &priors {
            for which in (0..8).map(|k| [1, 2, 4].map(|bit| k & bit != 0)) {
                let [pulled, masked, bounded] = which;
                for tau in [0.0, 0.2] {
                    let what = format!("{prior}, pull {pulled}, mask {masked}, bounds {bounded}, weight {tau}, {name}");
                    let agrees = |change| {
                        let off = updates_differ(&place, prior, which, tau, change).unwrap();
                        println!("{what}: {off:.1e}");
                        assert!(off < LIMIT, "{what}: {off}");
                    };
                    agrees(|p| p);
                    // On the host in between, as a penalty without WGSL; the arrays of others are on the device.
                    if place.device().is_none() || prior["type"] == "none" {
                        agrees(|p| Box::new(Changed(p, |_| None)));
                    }
                }
            }
        }
    }
}

/// A penalty whose WGSL is changed, or left out.
struct Changed(Box<dyn Penalty>, fn(&str) -> Option<String>);
impl Penalty for Changed {
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        self.0.value(x)
    }
    fn adapts(&self) -> bool {
        self.0.adapts()
    }
    fn adapt(&mut self, x: ArrayView3<'_, f32>) -> Option<f64> {
        self.0.adapt(x)
    }
    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        self.0.prox(v, tau, u);
    }
    fn state(&mut self) -> Vec<(&str, StatePart<'_>)> {
        self.0.state()
    }
    fn kernels(&mut self) -> Option<Kernels<'_>> {
        match self.0.kernels()? {
            Kernels::Dual(dual) => {
                let source = self.1(&dual.fragment.source)?;
                Some(Kernels::Dual(Dual { fragment: Fragment { source }, ..dual }))
            }
            Kernels::Clip(bounds) => self.1("").map(|_| Kernels::Clip(bounds)),
        }
    }
}

#[test]
fn a_perturbed_prior_is_found_and_one_without_wgsl_travels() {
    let Some((_, backend)) = crate::device::backends("negative controls").into_iter().next() else { return };
    let (place, prior) = (backend.place(), json!({"type": "total-variation"}));
    let differ = |change| updates_differ(&place, &prior, [false; 3], 0.2, change);
    let wrong = differ(|p| Box::new(Changed(p, |s| Some(s.replace("p + d", "p + 1.01 * d")))));
    assert!(wrong.unwrap() > LIMIT);
    let wrong = differ(|p| Box::new(Changed(p, |s| Some(s.replace("return length(d)", "return 1.01 * length(d)")))));
    assert!(wrong.unwrap() > LIMIT);
    let e = differ(|p| Box::new(Changed(p, |s| Some(s.replace("let q", "let r"))))).unwrap_err().to_string();
    assert!(e.contains("penalty") && e.contains("line"), "{e}");
}

#[test]
fn slopes_of_total_variation_are_those_of_the_host() {
    let (shape, g) = ([11, 7, 9], [1.0, 0.7, 1.3]);
    let descended = |place: &dyn Place| {
        let (mut x, mut work) = (place.adopt(volume(shape, 4)).unwrap(), place.zeros(shape).unwrap());
        descend(place, &mut x, g, 0.5, 0.1, &mut work).unwrap();
        place.take(x).unwrap()
    };
    let want = descended(&Host);
    assert!(apart(&volume(shape, 4), &want) > 0.01);
    for (name, place) in places("slopes") {
        let off = apart(&descended(place.as_ref()), &want);
        assert!(off < 1e-5, "{name}: {off}");
    }
}

/// What a run notes, and its volume.
fn noted(method: &Value, scan: &Scan, backend: &dyn Backend) -> (Vec<String>, Array3<f32>) {
    let mut heard = Heard::default();
    let job = Job { seed: 7, ..Job::new(scan, backend) };
    let solution = planned(method, backend).unwrap().run(&job, &mut heard).unwrap();
    (heard.notes, solution.result.volume(backend).unwrap().data)
}

#[test]
fn volumes_stay_on_the_device_also_across_a_checkpoint() {
    let method = json!({
        "type": "fista", "basis": {"type": "cubic", "spacing": 1.5}, "stop": {"passes": 6}, "subsets": 4,
        "prior": {"type": "directional-total-variation"}, "scene": {"support": "carve"},
    });
    for (name, backend) in crate::device::backends("checkpoints of volumes") {
        let scan = scan();
        let (said, whole) = noted(&method, &scan, backend);
        assert!(said.iter().any(|n| n.contains(", on ")), "{name}: {said:?}");
        assert!(!said.iter().any(|n| n.contains("runs on the CPU")), "{name}: {said:?}");
        let mut plan = planned(&method, backend).unwrap();
        let job = Job { seed: 7, ..Job::new(&scan, backend) };
        let mut stopped = Heard::until(3);
        let _ = plan.run(&job, &mut stopped);
        let kept = stopped.kept.expect("a checkpoint");
        assert_eq!(kept.standing.step, 3);
        let resumed = Job { resume: Some(&kept), ..job };
        let resumed = plan.run(&resumed, &mut Heard::default()).unwrap().result.volume(backend).unwrap().data;
        let error = apart(&resumed, &whole);
        println!("{name}: {error:.1e}");
        assert!(error < 1e-4, "{name}: {error}");
        // A run that forgets its momentum ends elsewhere.
        let mut half = method.clone();
        half["stop"]["passes"] = json!(3);
        let fresh = voxels(backend, &json!({"type": "chain", "methods": [half, half]}), &scan).unwrap();
        assert!(apart(&fresh, &whole) > 1e-3, "{name}");
    }
}

#[test]
fn classical_methods_end_where_the_cpu_does() {
    let methods = [
        json!({"type": "fdk"}),
        json!({"type": "fdk", "window": "hann", "cutoff": 0.8, "nonnegative": true}),
        json!({"type": "sart", "stop": {"passes": 3}}),
        json!({"type": "sart", "subsets": 3, "stop": {"passes": 3}, "scene": {"support": "carve"}}),
        json!({"type": "mlem", "stop": {"passes": 3}}),
        json!({"type": "cgls", "stop": {"passes": 5}}),
        json!({"type": "lsqr", "pull": 0.01, "stop": {"passes": 5}}),
        json!({"type": "asd-pocs", "stop": {"passes": 5}}),
        json!({"type": "fista", "prior": {"type": "total-variation"}, "stop": {"passes": 5}}),
        json!({"type": "fista", "stop": {"passes": 5},
            "prior": {"type": "sum", "priors": ["total-variation", "directional-total-variation"]}}),
        json!({"type": "fista", "prior": {"type": "directional-total-variation"}, "stop": {"passes": 5},
            "basis": {"type": "cubic", "spacing": 1.5}, "scene": {"support": "carve"}}),
    ];
    // On the CPU, wherever this runs: a method that makes next to nothing would agree with anything.
    let empty = decibels(&Array3::zeros(truth().data.dim()), 1.0);
    let on_cpu: Vec<f64> = methods.iter().map(|m| psnr(m, &Cpu::new()).0).collect();
    for (method, cpu) in methods.iter().zip(&on_cpu) {
        println!("{}: {cpu:.4} dB, an empty volume {empty:.4} dB", method["type"]);
        assert!(*cpu > empty + 3.0, "{method}: {cpu} dB, an empty volume {empty} dB");
    }
    for (name, backend) in crate::device::backends("classical methods") {
        for (method, cpu) in methods.iter().zip(&on_cpu) {
            let (found, _) = psnr(method, backend);
            println!("{}, {name}: {found:.4} dB, CPU {cpu:.4} dB", method["type"]);
            assert!((cpu - found).abs() < 0.01, "{method}, {name}: {found} dB, CPU {cpu} dB");
        }
    }
}

/// A scan large enough for its arrays to stand out among what else is moved.
pub fn larger() -> Scan {
    let data = Array3::from_shape_fn((40, 44, 48), |(x, y, z)| {
        let d = [x as f32 - 19.5, y as f32 - 21.5, z as f32 - 23.5];
        f32::from(u8::from(d.iter().map(|v| v * v).sum::<f32>() < 300.0)) * 0.01
    });
    let protocol = protocol(json!({"detector": [56, 64], "angles": {"even": {"views": 24}}}));
    simulate(&Volume::centered(data, [4.0; 3]), &protocol).unwrap()
}

/// Bytes that a run moves to the device and from it.
fn moved(method: &Value, scan: &Scan, backend: &dyn Backend) -> [f64; 2] {
    let before = backend.moved();
    solve_on(backend, method, scan).unwrap();
    let after = backend.moved();
    [after.to_device - before.to_device, after.from_device - before.from_device].map(|bytes| bytes as f64)
}

#[test]
fn a_pass_moves_scalars_and_a_run_its_views_and_its_volume() {
    let scan = larger();
    let (views, volume) =
        (4.0 * scan.projections.len() as f64, 4.0 * scan.geometry.volume.shape.iter().product::<usize>() as f64);
    let tv = json!({"type": "total-variation"});
    let methods = [
        json!({"type": "sart", "subsets": 4}),
        json!({"type": "sart", "subsets": 1}),
        json!({"type": "mlem", "subsets": 4}),
        json!({"type": "cgls"}),
        json!({"type": "lsqr", "pull": 0.01}),
        json!({"type": "asd-pocs", "subsets": 4, "descents": 5}),
        json!({"type": "fista", "subsets": 4, "prior": tv, "scene": {"support": "carve"}}),
        json!({"type": "fista", "subsets": 4, "prior": {"type": "directional-total-variation"},
            "basis": {"type": "cubic", "spacing": 1.5}}),
    ];
    for (name, backend) in crate::device::alone("moved bytes") {
        if name == "small buffers" {
            continue;
        }
        let [up, down] = moved(&json!({"type": "fdk"}), &scan, &backend);
        println!("fdk, {name}: {:.3} of the views up, {:.3} of the volume down", up / views, down / volume);
        assert!(up > views && up < 1.05 * views && down == volume, "{name}: {up} and {down} bytes");
        for method in &methods {
            let after = |passes: u64| {
                let mut method = method.clone();
                method["stop"] = json!({"passes": passes});
                moved(&method, &scan, &backend)
            };
            let (two, four) = (after(2), after(4));
            let pass: [f64; 2] = std::array::from_fn(|k| 0.5 * (four[k] - two[k]));
            println!(
                "{method}, {name}: {:.3} of the views up, {:.3} of the volume down; a pass {:.3} and {:.3}",
                two[0] / views,
                two[1] / volume,
                pass[0] / views,
                pass[1] / volume
            );
            assert!(pass[0] < 0.1 * views && pass[1] < 0.05 * volume, "{method}, {name}: {pass:?} bytes in a pass");
            // FISTA estimates its noise on one subset. A coarser basis is expanded on the host at the end.
            let expanded = if method["basis"].is_object() { volume } else { 0.0 };
            assert!(two[0] > views && two[0] < 1.6 * views + expanded, "{method}, {name}: {} bytes up", two[0]);
            assert!(two[1] < 1.15 * volume + 0.4 * expanded, "{method}, {name}: {} bytes down", two[1]);
        }
        // The test sees what travels.
        let start = json!({"type": "sart", "subsets": 4, "stop": {"passes": 2, "patience": 1}});
        let before = backend.moved();
        let job = Job { held_out: Some(&scan), ..Job::new(&scan, &backend) };
        planned(&start, &backend).unwrap().run(&job, &mut Heard::default()).unwrap();
        let down = (backend.moved().from_device - before.from_device) as f64;
        assert!(down > volume + 1.9 * views, "{name}: records of held-out views bring them down: {down}");
    }
}

/// A place that holds no array of more bytes.
pub struct Little(pub u64);

impl Place for Little {
    fn zeros(&self, shape: [usize; 3]) -> conefield_core::Result<Array> {
        let bytes = 4 * shape.iter().product::<usize>() as u64;
        if bytes > self.0 {
            return Err(conefield_core::Error::unsupported("the place", format!("{bytes} bytes, it has {}", self.0)));
        }
        Host.zeros(shape)
    }
    fn load(&self, from: ArrayView3<'_, f32>, to: &mut Array, first: usize) -> conefield_core::Result<()> {
        Host.load(from, to, first)
    }
    fn store(&self, from: &Array, first: usize, to: ArrayViewMut3<'_, f32>) -> conefield_core::Result<()> {
        Host.store(from, first, to)
    }
}

/// FDK makes its slabs as small as a place needs them, and gives the same bits; a place without room for the smallest
/// one is told.
#[test]
fn a_volume_larger_than_its_place_is_computed_in_slabs() {
    // Few views, whose images take less than the volume.
    let aside: Vec<usize> = (0..24).filter(|v| v % 3 > 0).collect();
    let (scan, _) = larger().split(&aside).unwrap();
    let run = |backend: &dyn Backend| voxels(backend, &json!({"type": "fdk"}), &scan);
    let whole = run(&Cpu::new()).unwrap();
    let views = 4 * scan.projections.len() as u64;
    let volume = 4 * whole.len() as u64;
    assert!(whole.iter().any(|x| *x > 0.0) && views < volume, "{views} {volume}");
    for bytes in [views, volume - 1] {
        assert!(run(&In(Arc::new(Little(bytes)))).unwrap() == whole, "{bytes} bytes");
    }
    let e = run(&In(Arc::new(Little(volume / 40)))).unwrap_err().to_string();
    assert!(e.contains("the place"), "{e}");
}

/// Slabs of a volume, and some images at a time, have the line integrals of the whole.
#[test]
fn line_integrals_in_slabs_agree_with_double_precision_and_are_adjoint() {
    let g = geometry();
    let plane = 4 * (g.volume.shape[1] * g.volume.shape[2]) as u64;
    let image = 4 * g.detector.iter().product::<usize>() as u64;
    // 1, 2, 4 and all 13 planes, in slabs of which the last reaches beyond the volume.
    for planes in [1, 2, 4, 13] {
        let place = Streamed::new(Arc::new(Little((planes * plane).max(image))));
        for settings in all() {
            let p = projector(settings.clone());
            if let Err(e) = place.admits(p.as_ref()) {
                assert!(settings["type"] == "trilinear" && e.to_string().contains("slabs"), "{settings}: {e}");
                continue;
            }
            let [forward, adjoint, mismatch] = errors(&place, p.as_ref(), &g).unwrap();
            assert!(forward < LIMIT && adjoint < LIMIT && mismatch < 1e-5, "{settings}, {planes} planes");
        }
    }
    let e = errors(&Streamed::new(Arc::new(Little(plane - 1))), projector(json!({"type": "joseph"})).as_ref(), &g);
    assert!(e.unwrap_err().to_string().contains("the place"));
}

/// A device without room for a method's arrays computes line integrals slab by slab: a pass moves the volume once each
/// way, and the images once for each slab.
#[test]
fn a_device_without_room_for_the_arrays_ends_where_the_cpu_does() {
    let (scan, passes) = (larger(), json!({"passes": 3}));
    let [views, volume] = [scan.projections.len(), scan.geometry.volume.len().unwrap()].map(|n| 4 * n as u64);
    let methods = [
        json!({"type": "sart", "subsets": 1, "stop": passes}),
        json!({"type": "cgls", "stop": passes}),
        json!({"type": "sart", "subsets": 4, "stop": passes}),
        json!({"type": "fista", "subsets": 4, "prior": {"type": "directional-total-variation"}, "stop": passes,
            "basis": {"type": "cubic", "spacing": 1.5}, "scene": {"support": "carve"}}),
    ];
    // Half the volume, images, and twice half the volume for transfers.
    let Some(little) = crate::device::little(volume * 5 / 3) else { return };
    let (said, _) = noted(&json!({"type": "sart", "stop": passes}), &crate::common::scan(), &little);
    assert!(!said.iter().any(|n| n.contains("no room")), "small arrays fit: {said:?}");
    for method in &methods {
        let (said, found) = noted(method, &scan, &little);
        assert!(said.iter().any(|n| n.contains("no room for 0.0 GiB")), "{method}: {said:?}");
        // Slabs add up in another order, and devices in no fixed one. Single voxels magnify that, where slopes of total
        // variation are next to 0; `asd-pocs` more than others, so that it is not among these methods.
        let error = rms(&found, &voxels(&Cpu::new(), method, &scan).unwrap());
        println!("{}: {error:.1e}", method["type"]);
        assert!(error < 1e-5, "{method}: {error}");
    }
    let after = |passes: u64| moved(&json!({"type": "sart", "subsets": 1, "stop": {"passes": passes}}), &scan, &little);
    let (two, four) = (after(2), after(4));
    let [up, down] = std::array::from_fn(|k| 0.5 * (four[k] - two[k]));
    let slabs = 2.0;
    let want = volume as f64 + slabs * views as f64;
    println!("{:.3} and {:.3} of {want} bytes up and down", up / want, down / want);
    assert!((up / want - 1.0).abs() < 0.05 && (down / want - 1.0).abs() < 0.05, "{up} and {down} of {want} bytes");
}
