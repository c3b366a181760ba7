//! Projection of voxel volumes on a device against double precision, and classical methods there against the CPU.

use crate::common::{scan, solve_on, truth};
use conefield_backend_cpu::Cpu;
use conefield_core::arena::Weights;
use conefield_core::backend::Backend;
use conefield_core::geometry::Geometry;
use conefield_core::random::{mix, unit};
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
