//! Methods against independent solutions of the same problem: a dense matrix, double precision, other algorithms.

use crate::kit::{Case, Heard, view};
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::method::Limits;
use conefield_core::scan::{Scan, Volume};
use conefield_core::voxel::VoxelProjectorSpec;
use conefield_projectors::simulate::{Ellipsoid, scan_ellipsoids};
use conefield_projectors::voxel::Joseph;
use ndarray::{Array1, Array2, Array3};

const SIDE: usize = 6;
const VOXELS: usize = SIDE * SIDE * SIDE;

/// A few views of 6³ voxels of 1 mm, with noise.
fn scan() -> Scan {
    let angles = [0.2, 0.9, 1.7, 2.6, 3.9, 5.1];
    let geometry = Geometry {
        detector: [8, 8],
        views: angles.map(|a| view(a, [40.0, 60.0], [1.5, 1.5], [0.0, 0.0])).to_vec(),
        volume: VoxelGrid { shape: [SIDE; 3], spacing: [1.0; 3], center: [0.0; 3] },
    };
    let body = [
        Ellipsoid { center: [0.2, 0.1, -0.1], axes: [2.6, 2.3, 2.5], value: 0.3 },
        Ellipsoid { center: [-0.8, 0.4, 0.3], axes: [0.9, 0.8, 1.0], value: 0.4 },
    ];
    let mut scan = scan_ellipsoids(&body, geometry);
    let noise = |i: usize| 0.03 * ((i * 7919 % 1009) as f32 / 504.5 - 1.0);
    scan.projections.iter_mut().enumerate().for_each(|(i, p)| *p += noise(i));
    scan
}

/// The system matrix, pixel by voxel, from the projector's double precision.
fn matrix(scan: &Scan) -> Array2<f64> {
    let (joseph, views) = (Joseph {}.build().unwrap(), (0..scan.geometry.views.len()).collect::<Vec<_>>());
    let mut matrix = Array2::zeros((scan.projections.len(), VOXELS));
    for (j, mut column) in matrix.columns_mut().into_iter().enumerate() {
        let mut unit = Array1::zeros(VOXELS);
        unit[j] = 1.0;
        let unit: Array3<f64> = unit.into_shape_with_order([SIDE; 3]).unwrap();
        let mut images = Array3::zeros(scan.projections.raw_dim());
        joseph.reference().forward(&scan.geometry, &views, unit.view(), images.view_mut());
        column.iter_mut().zip(&images).for_each(|(a, x)| *a = *x);
    }
    matrix
}

fn measured(scan: &Scan) -> Array1<f64> {
    scan.projections.iter().map(|p| f64::from(*p)).collect()
}

fn numbers(volume: &Volume) -> Array1<f64> {
    volume.data.iter().map(|x| f64::from(*x)).collect()
}

/// The voxel of difference `i`, the next one along its axis, and the axis; `None` at the far faces.
fn beside(i: usize) -> Option<(usize, usize, usize)> {
    let (j, k) = (i / 3, i % 3);
    let stride = [SIDE * SIDE, SIDE, 1][k];
    (j / stride % SIDE + 1 < SIDE).then_some((j, j + stride, k))
}

/// Forward differences of `x` times `weights`, three per voxel.
fn differences(weights: [f64; 3], x: &Array1<f64>) -> Array1<f64> {
    Array1::from_shape_fn(3 * VOXELS, |i| beside(i).map_or(0.0, |(j, next, k)| weights[k] * (x[next] - x[j])))
}

/// Adds the adjoint of [`differences`] to `x`.
fn add_adjoint(weights: [f64; 3], y: &Array1<f64>, x: &mut Array1<f64>) {
    for ((j, next, k), y) in y.iter().enumerate().filter_map(|(i, y)| Some((beside(i)?, y))) {
        x[next] += weights[k] * y;
        x[j] -= weights[k] * y;
    }
}

fn lengths(d: &Array1<f64>) -> f64 {
    d.exact_chunks(3).into_iter().map(|g| g.dot(&g).sqrt()).sum()
}

/// The priors of these tests: factors along x, y, z, and λ.
const PRIORS: [([f64; 3], f64); 2] = [([1.0, 0.0, 0.0], 0.08), ([0.5, 1.0, 1.0], 0.04)];

/// `½‖p − A·x‖² + Σ λ·TV(x)`.
fn objective(a: &Array2<f64>, p: &Array1<f64>, x: &Array1<f64>) -> f64 {
    let r = p - &a.dot(x);
    0.5 * r.dot(&r) + PRIORS.iter().map(|(weights, l)| l * lengths(&differences(*weights, x))).sum::<f64>()
}

/// The minimum over `x ≥ 0` by a primal-dual method (Chambolle and Pock, J. Math. Imaging Vis. 40, 2011), which has
/// nothing in common with a proximal gradient method.
fn primal_dual(a: &Array2<f64>, p: &Array1<f64>) -> Array1<f64> {
    let mut v = Array1::from_elem(VOXELS, 1.0);
    let mut norm = 0.0;
    for _ in 0..100 {
        let mut next = a.t().dot(&a.dot(&v));
        PRIORS.iter().for_each(|(weights, _)| add_adjoint(*weights, &differences(*weights, &v), &mut next));
        norm = next.dot(&next).sqrt();
        v = next / norm;
    }
    let step = 0.99 / norm.sqrt();
    let (mut x, mut q) = (Array1::<f64>::zeros(VOXELS), Array1::<f64>::zeros(p.len()));
    let mut ahead = x.clone();
    let mut duals = PRIORS.map(|_| Array1::<f64>::zeros(3 * VOXELS));
    for _ in 0..6000 {
        q = (q + step * (a.dot(&ahead) - p)) / (1.0 + step);
        let mut slope = a.t().dot(&q);
        for ((weights, l), y) in PRIORS.iter().zip(&mut duals) {
            *y += &(step * differences(*weights, &ahead));
            for mut g in y.exact_chunks_mut(3) {
                let length = g.dot(&g).sqrt();
                g.mapv_inplace(|c| c / (length / l).max(1.0));
            }
            add_adjoint(*weights, y, &mut slope);
        }
        let next = (&x - &(step * slope)).mapv(|c| c.max(0.0));
        ahead = 2.0 * &next - &x;
        x = next;
    }
    x
}

/// FISTA with two priors reaches the least objective that another algorithm finds, whatever the number of turns; and one
/// prior alone, or the two at half their weights, does not.
#[test]
fn two_priors_reach_the_minimum_of_their_sum() {
    let scan = scan();
    let (a, p) = (matrix(&scan), measured(&scan));
    let reference = primal_dual(&a, &p);
    let least = objective(&a, &p, &reference);
    let prior = |(weights, l): &([f64; 3], f64), factor: f64| {
        format!(
            "{{ type = \"total-variation\", weight = {{ fixed = {} }}, weights = {weights:?}, inner = 10 }}",
            factor * l
        )
    };
    let of = |prior: String, passes: u64| {
        let text = format!(
            "type = \"fista\"\nsubsets = 1\nair = false\ndata.type = \"least-squares\"\nprior = {prior}\n\
             stop = {{ passes = {passes} }}"
        );
        numbers(&Case::of(&scan).volume(&text).0)
    };
    let sum = |turns: usize, factor: f64| {
        let [first, second] = PRIORS.each_ref().map(|p| prior(p, factor));
        format!("{{ type = \"sum\", turns = {turns}, priors = [{first}, {second}] }}")
    };
    for turns in [1, 3] {
        let volumes = [30, 100, 300].map(|passes| of(sum(turns, 1.0), passes));
        let found = volumes.each_ref().map(|x| objective(&a, &p, x) / least - 1.0);
        println!("{turns} turns: {found:?} above the least objective {least:.6} after 30, 100, 300 passes");
        assert!(found[2] < 1e-4 && found[2] > -1e-4, "{turns} turns: {found:?}");
        let apart = (&volumes[2] - &reference).mapv(f64::abs).fold(0.0f64, |m, x| m.max(*x));
        assert!(apart < 0.01 * reference.fold(0.0f64, |m, x| m.max(*x)), "{turns} turns: {apart}");
    }
    for (what, other) in [("the first", prior(&PRIORS[0], 1.0)), ("half", sum(1, 0.5))] {
        let above = objective(&a, &p, &of(other, 300)) / least - 1.0;
        assert!(above > 1e-3, "{what}: {above:.2e}");
    }
}

/// LSQR solves the normal equations `(AᵀA + λ²)·x = Aᵀp + λ²·x₀`, with λ from the first residual.
#[test]
fn lsqr_solves_the_normal_equations() {
    let scan = scan();
    let (a, p) = (matrix(&scan), measured(&scan));
    let start = Volume { grid: scan.geometry.volume, data: Array3::from_elem([SIDE; 3], 0.1), affine: None };
    for file in [None, Some(&start)] {
        let x0 = file.map_or(Array1::zeros(VOXELS), numbers);
        let first = &p - &a.dot(&x0);
        let slope = a.t().dot(&first);
        let square = 0.05 * slope.dot(&slope) / first.dot(&first);
        let text = format!(
            "type = \"lsqr\"\npull = 0.05\nnonnegative = false\nstop = {{ passes = 60 }}\n{}",
            file.map_or("", |_| "start = \"x.nii\"")
        );
        let (volume, heard) = Case { file, ..Case::of(&scan) }.volume(&text);
        let x = numbers(&volume);
        let r = &p - &a.dot(&x);
        let rest = a.t().dot(&r) - square * (&x - &x0);
        let left = rest.dot(&rest).sqrt() / slope.dot(&slope).sqrt();
        println!("{left:.1e} of the first slope is left");
        assert!(left < 1e-5, "{left}");
        // What it reports is the residual and the pull.
        let last = heard.records.last().unwrap();
        let prior = square * (&x - &x0).mapv(|d| d * d).sum();
        let found = last.prior.unwrap();
        assert!((found / prior - 1.0).abs() < 1e-3, "{found} and {prior}");
    }
    // Without a pull both are the same method but for rounding.
    let of = |kind: &str| {
        let text = format!("type = \"{kind}\"\nnonnegative = false\nstop = {{ passes = 12 }}");
        numbers(&Case::of(&scan).volume(&text).0)
    };
    let (lsqr, cgls) = (of("lsqr"), of("cgls"));
    let apart = (&lsqr - &cgls).mapv(|d| d * d).sum().sqrt() / cgls.dot(&cgls).sqrt();
    println!("{apart:.1e} between LSQR and conjugate gradients");
    assert!(apart < 1e-4, "{apart}");
}

/// Each pass of MLEM increases the likelihood, and its line integrals add up to the measured ones: what defines it. An
/// algebraic method does neither.
#[test]
fn mlem_increases_the_likelihood_and_keeps_the_sum() {
    let mut scan = scan();
    scan.projections.mapv_inplace(|p| p.max(0.0));
    let (a, p) = (matrix(&scan), measured(&scan));
    // Rays that miss the volume measure nothing of it.
    let met: Vec<bool> = a.rows().into_iter().map(|row| row.sum() > 0.0).collect();
    let each = |x: &Array1<f64>| {
        let line = a.dot(x);
        let met = p.iter().zip(line).zip(&met).filter(|(_, met)| **met).map(|(both, _)| both);
        let (mut likelihood, mut sums) = (0.0, [0.0; 2]);
        for (p, a) in met {
            likelihood += if *p > 0.0 { p * a.max(1e-30).ln() } else { 0.0 } - a;
            sums = [sums[0] + p, sums[1] + a];
        }
        (likelihood, sums[1] / sums[0])
    };
    let after = |text: &str, passes: u64| {
        let case = Case { limits: Limits { steps: Some(passes), ..Limits::default() }, ..Case::of(&scan) };
        each(&numbers(&case.volume(text).0))
    };
    let found: Vec<_> = [1, 2, 4, 8, 16, 32].map(|n| after("type = \"mlem\"\nsubsets = 1", n)).to_vec();
    println!("{found:.5?}");
    assert!(found.windows(2).all(|w| w[1].0 > w[0].0), "{found:?}");
    assert!(found.iter().all(|(_, sum)| (sum - 1.0).abs() < 1e-5), "{found:?}");
    let sirt = after("type = \"sart\"\nsubsets = 1", 4);
    assert!((sirt.1 - 1.0).abs() > 1e-4 && sirt.0 < found[5].0, "{sirt:?}");
}

/// A start of zeros is raised: nothing grows from 0.
#[test]
fn mlem_leaves_zeros_of_a_start() {
    let scan = scan();
    let zeros = Volume { grid: scan.geometry.volume, data: Array3::zeros([SIDE; 3]), affine: None };
    let case = Case { file: Some(&zeros), ..Case::of(&scan) };
    let mut heard = Heard::default();
    case.run("type = \"mlem\"\nsubsets = 1\nstart = \"x.nii\"", &mut heard).unwrap();
    let losses = heard.losses();
    assert!(losses[losses.len() - 1] < 0.1 * losses[0], "{losses:?}");
}
