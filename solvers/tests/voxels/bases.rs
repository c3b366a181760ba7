//! FISTA with a basis other than voxels: blocks of 2 × 2 × 2 voxels.

use crate::kit::{Case, Heard, geometry, method};
use conefield_core::Error;
use conefield_core::Result;
use conefield_core::basis::{Basis, BasisOperator, BasisSpec, Expansion};
use conefield_core::geometry::VoxelGrid;
use conefield_core::random::{mix, unit};
use conefield_core::scan::{Scan, Volume};
use conefield_core::simd::Real;
use conefield_core::voxel::VoxelOperator;
use conefield_projectors::simulate::scan_ellipsoids;
use conefield_projectors::voxel::Joseph;
use ndarray::{Array3, ArrayView3, ArrayViewMut3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Blocks of 2 × 2 × 2 voxels with one value each, smaller at the end of odd sides.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
struct Blocks {}

conefield_core::stage_type!(BasisSpec, "test-blocks", Blocks, "for tests");

impl BasisSpec for Blocks {
    fn build(&self) -> Result<Box<dyn Basis>> {
        Ok(Box::new(*self))
    }
}

impl Basis for Blocks {
    fn on(&self, grid: &VoxelGrid) -> Result<Box<dyn Expansion>> {
        Ok(Box::new(On { grid: *grid }))
    }
    fn describe(&self) -> String {
        "test-blocks: of 2 x 2 x 2 voxels".into()
    }
}

struct On {
    grid: VoxelGrid,
}

impl Expansion for On {
    fn coefficients(&self) -> VoxelGrid {
        let VoxelGrid { shape, spacing, center } = self.grid;
        let shape = shape.map(|n| n.div_ceil(2));
        let spacing = spacing.map(|s| 2.0 * s);
        // An odd side has half a block beyond its end.
        let beyond = |k: usize| 0.5 * (shape[k] as f64 * spacing[k] - self.grid.size()[k]);
        VoxelGrid { shape, spacing, center: std::array::from_fn(|k| center[k] + beyond(k)) }
    }
    fn operator(&self) -> &dyn BasisOperator<f32> {
        self
    }
    fn reference(&self) -> Option<&dyn BasisOperator<f64>> {
        Some(self)
    }
}

impl<R: Real> BasisOperator<R> for On {
    fn expand(&self, coefficients: ArrayView3<'_, R>, mut voxels: ArrayViewMut3<'_, R>) {
        voxels.indexed_iter_mut().for_each(|((x, y, z), v)| *v = coefficients[[x / 2, y / 2, z / 2]]);
    }
    fn adjoint(&self, voxels: ArrayView3<'_, R>, mut coefficients: ArrayViewMut3<'_, R>) {
        coefficients.fill(R::ZERO);
        voxels.indexed_iter().for_each(|((x, y, z), v)| coefficients[[x / 2, y / 2, z / 2]] += *v);
    }
}

#[test]
fn the_blocks_keep_to_the_contract() {
    let report = conefield_conformance::check_basis(&Blocks {});
    assert!(report.passed(), "{report}");
}

/// Few voxels and many rays, so that least squares has one solution; z has an odd number of voxels.
fn scan() -> (Scan, Volume) {
    let mut g = geometry(16);
    g.volume = VoxelGrid { shape: [12, 12, 11], spacing: [4.0; 3], ..g.volume };
    let on = On { grid: g.volume };
    let mut i = 0;
    let coefficients = Array3::from_shape_simple_fn(on.coefficients().shape, || {
        i += 1;
        0.02 + 0.02 * unit(mix(4, i))
    });
    let mut truth = Volume::centered(Array3::zeros(g.volume.shape), g.volume.spacing);
    on.expand(coefficients.view(), truth.data.view_mut());
    let mut scan = scan_ellipsoids(&[], g);
    let views: Vec<usize> = (0..16).collect();
    let out = scan.projections.view_mut();
    VoxelOperator::<f32>::forward(&Joseph {}, &scan.geometry, &views, truth.data.view(), out);
    // Noise, so that the solution differs from the scanned volume.
    scan.projections.mapv_inplace(|p| {
        i += 1;
        p + 0.04 * (unit(mix(7, i)) - 0.5)
    });
    (scan, truth)
}

/// The least-squares volume in the basis, by conjugate gradients in double precision.
fn least_squares(scan: &Scan) -> Array3<f64> {
    let g = &scan.geometry;
    let on = On { grid: g.volume };
    let views: Vec<usize> = (0..g.views.len()).collect();
    let forward = |c: &Array3<f64>| {
        let (mut voxels, mut lines) = (Array3::zeros(g.volume.shape), Array3::zeros(scan.projections.dim()));
        on.expand(c.view(), voxels.view_mut());
        VoxelOperator::<f64>::forward(&Joseph {}, g, &views, voxels.view(), lines.view_mut());
        lines
    };
    let back = |y: &Array3<f64>| {
        let (mut voxels, mut c) = (Array3::zeros(g.volume.shape), Array3::zeros(on.coefficients().shape));
        VoxelOperator::<f64>::adjoint(&Joseph {}, g, &views, y.view(), voxels.view_mut());
        on.adjoint(voxels.view(), c.view_mut());
        c
    };
    let square = |x: &Array3<f64>| x.iter().map(|x| x * x).sum::<f64>();
    let mut residual = scan.projections.mapv(f64::from);
    let mut c = Array3::zeros(on.coefficients().shape);
    let mut direction = back(&residual);
    let mut gamma = square(&direction);
    let start = gamma;
    for _ in 0..2000 {
        if gamma <= 1e-24 * start {
            break;
        }
        let ahead = forward(&direction);
        let alpha = gamma / square(&ahead);
        c.scaled_add(alpha, &direction);
        residual.scaled_add(-alpha, &ahead);
        let gradient = back(&residual);
        let last = std::mem::replace(&mut gamma, square(&gradient));
        direction = gradient + gamma / last * direction;
    }
    let mut voxels = Array3::zeros(g.volume.shape);
    on.expand(c.view(), voxels.view_mut());
    voxels
}

fn off(found: &Array3<f32>, exact: &Array3<f64>) -> f64 {
    let square: f64 = found.iter().zip(exact).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum();
    (square / exact.iter().map(|x| x * x).sum::<f64>()).sqrt()
}

const BLOCKS: &str = "basis.type = \"test-blocks\"\ndata.type = \"least-squares\"\nair = false\nsubsets = 1\n";

#[test]
fn fista_finds_the_least_squares_of_the_basis() {
    let (scan, truth) = scan();
    let exact = least_squares(&scan);
    assert!(exact.iter().all(|x| *x > 0.0), "no bound is met");
    let (found, _) = Case::of(&scan).volume(&method("fista", &format!("{BLOCKS}stop = {{ passes = 300 }}")));
    let apart = off(&found.data, &truth.data.mapv(f64::from));
    println!("{:.1e} off the least squares, {apart:.1e} off what was scanned", off(&found.data, &exact));
    assert!(off(&found.data, &exact) < 1e-3 && apart > 3e-3, "{apart}");
    assert_eq!(found.data.dim(), (12, 12, 11));
    // Voxels fit the noise better.
    let voxels = BLOCKS.replace("test-blocks", "voxels");
    let (voxels, _) = Case::of(&scan).volume(&method("fista", &format!("{voxels}stop = {{ passes = 300 }}")));
    assert!(off(&voxels.data, &exact) > 1e-2);
}

/// A volume outside the basis is replaced by the nearest one in it as the start.
#[test]
fn a_start_is_fitted_and_held_to() {
    let (scan, truth) = scan();
    let none = conefield_core::method::Limits { steps: Some(0), ..Default::default() };
    let text = method("fista", &format!("{BLOCKS}start = \"x\"\npull = 1e4\nstop = {{ passes = 3 }}"));
    let case = Case { file: Some(&truth), ..Case::of(&scan) };
    let exact = truth.data.mapv(f64::from);
    let begun = Case { limits: none, ..case }.run(&text, &mut Heard::default()).unwrap();
    assert!(off(&crate::kit::volume(begun).data, &exact) < 1e-5);
    assert!(off(&case.volume(&text).0.data, &exact) < 1e-3, "it is held to the start");
    let mut rough = truth.clone();
    rough.data.indexed_iter_mut().for_each(|((x, _, _), v)| *v += if x % 2 == 0 { 0.01 } else { -0.01 });
    let fitted = Case { limits: none, file: Some(&rough), ..case }.run(&text, &mut Heard::default()).unwrap();
    assert!(off(&crate::kit::volume(fitted).data, &exact) < 1e-5, "what blocks cannot say is left out");
}

/// All options together: a prior on the blocks, subsets, a support, held-out views, and an interruption.
#[test]
fn an_interrupted_run_with_a_basis_goes_on_to_the_same_bits() {
    let (scan, held) = scan().0.split(&[3, 9]).unwrap();
    let text = method(
        "fista",
        "basis = \"test-blocks\"\nprior = \"total-variation\"\nscene.support = \"carve\"\nsubsets = 4\nstop = { passes = 6, patience = 3 }",
    );
    let case = Case { held_out: Some(&held), ..Case::of(&scan) };
    let (whole, _) = case.volume(&text);
    let mut first = Heard::interrupting_after(2);
    let e = case.run(&text, &mut first).err().unwrap();
    assert!(matches!(e, Error::Interrupted { step: 2 }), "{e}");
    let kept = first.kept.take().unwrap();
    assert_eq!(kept.weights.tensors["x"].1.len(), 6 * 6 * 6);
    assert_eq!(kept.weights.tensors["prior.dual.x"].1.len(), 6 * 6 * 6);
    let (again, _) = Case { resume: Some(&kept), ..case }.volume(&text);
    assert!(whole.data == again.data);
}
