//! Tests of adjointness, of agreement between implementations, and against closed forms.

use super::backproject::backproject_in;
use super::columns;
use super::layout::{ColumnMajor, Pinhole, main_axis};
use super::rays;
use super::walk::{VoxelRay, Walk};
use super::{Joseph, Siddon, Trilinear};
use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid, cross, norm};
use conefield_core::random::{mix, unit};
use conefield_core::simd::Real;
use conefield_core::voxel::{VoxelOperator, VoxelProjector};
use ndarray::{Array3, ArrayView3, Axis, Zip, concatenate, s};
use proptest::prelude::*;
use std::ops::Range;

fn circular(angle: f64, dso: f64, dsd: f64, pixel: [f64; 2], offset: [f64; 2]) -> View {
    View::circular(Radians(angle), Millimetres(dso), Millimetres(dsd), pixel.map(Millimetres), offset.map(Millimetres))
}

/// Non-square detector and volume, anisotropic off-axis voxels, offsets, angles on and between the axes.
fn crooked(upright: bool) -> Geometry {
    let angles = [0.0, 0.3, std::f64::consts::FRAC_PI_4, 1.6, 2.9, 3.7, 1.5 * std::f64::consts::PI, 5.5];
    let mut views: Vec<View> = angles.iter().map(|&a| circular(a, 90.0, 140.0, [2.1, 1.7], [3.0, -4.5])).collect();
    views[3].v[2] *= -1.0; // rows that run upwards
    if !upright {
        for v in &mut views[1..3] {
            v.v = [0.3, -0.2, -2.0];
            v.u[2] = 0.25;
            v.source[2] += 5.0;
        }
    }
    Geometry {
        detector: [29, 37],
        views,
        volume: VoxelGrid { shape: [17, 23, 13], spacing: [1.9, 1.3, 2.4], center: [1.0, -2.0, 3.0] },
    }
}

/// The same scan with detectors rotated in their planes by some degrees and tilted by half as much.
fn turned(mut g: Geometry, degrees: f64) -> Geometry {
    let (sin, cos) = degrees.to_radians().sin_cos();
    let lean = (0.5 * degrees.to_radians()).sin();
    for v in &mut g.views {
        let (u, up) = (v.u, v.v);
        let [a, b] = [u, up].map(norm);
        let ahead = cross(u, up).map(|x| x / a);
        v.u = std::array::from_fn(|k| cos * u[k] + sin * up[k] * a / b);
        v.v = std::array::from_fn(|k| cos * up[k] - sin * u[k] * b / a + lean * ahead[k]);
    }
    g
}

fn all_views(g: &Geometry) -> Vec<usize> {
    (0..g.views.len()).collect()
}

/// Numbers in [-0.5, 0.5).
fn noise<R: Real>(shape: [usize; 3], seed: u64) -> Array3<R> {
    let mut i = 0;
    Array3::from_shape_simple_fn(shape, || {
        i += 1;
        R::of(f64::from(unit(mix(seed, i))) - 0.5)
    })
}

fn dot<R: Real>(a: &Array3<R>, b: &Array3<R>) -> f64 {
    Zip::from(a).and(b).fold(0.0, |sum, x, y| sum + x.f64() * y.f64())
}

fn forward<R: Real>(op: &dyn VoxelOperator<R>, g: &Geometry, x: ArrayView3<'_, R>) -> Array3<R> {
    let mut out = Array3::from_elem((g.views.len(), g.detector[0], g.detector[1]), R::ONE);
    op.forward(g, &all_views(g), x, out.view_mut());
    out
}

fn adjoint<R: Real>(op: &dyn VoxelOperator<R>, g: &Geometry, y: ArrayView3<'_, R>) -> Array3<R> {
    let mut out = Array3::from_elem(g.volume.shape, R::ZERO);
    op.adjoint(g, &all_views(g), y, out.view_mut());
    out
}

/// `|<Ax, y> − <x, Aᵀy>| / (‖Ax‖·‖y‖)`.
fn mismatch<R: Real>(op: &dyn VoxelOperator<R>, g: &Geometry, seed: u64) -> f64 {
    let x = noise::<R>(g.volume.shape, seed);
    let y = noise::<R>([g.views.len(), g.detector[0], g.detector[1]], seed + 1);
    let ax = forward(op, g, x.view());
    let aty = adjoint(op, g, y.view());
    // Every ray may miss the volume.
    let norm = (dot(&ax, &ax) * dot(&y, &y)).sqrt() + 1e-9;
    (dot(&ax, &y) - dot(&x, &aty)).abs() / norm
}

fn projectors() -> Vec<Box<dyn VoxelProjector>> {
    vec![Box::new(Siddon {}), Box::new(Joseph {}), Box::new(Trilinear::default())]
}

/// Bilinear interpolation in the planes of voxel centres across the ray's main direction, plane by plane (Joseph, IEEE
/// Trans. Med. Imaging 1(3), 1982), voxel by voxel: the reference for the fast implementations. Outside the volume
/// there is nothing.
#[derive(Debug, Clone, Copy)]
struct JosephWalk;

impl Walk for JosephWalk {
    fn walk(&self, ray: &VoxelRay, grid: &VoxelGrid, slab: &Range<usize>, mut visit: impl FnMut([usize; 3], f64)) {
        let n = grid.shape;
        let main = main_axis(ray.ahead);
        let [a, b] = [(main + 1) % 3, (main + 2) % 3];
        let mut lower = [-1.0; 3];
        let mut upper = n.map(|n| n as f64);
        (lower[0], upper[0]) = (slab.start as f64 - 1.0, slab.end as f64);
        (lower[main], upper[main]) = (lower[main].max(0.0), upper[main].min(n[main] as f64 - 1.0));
        if main == 0 {
            (lower[0], upper[0]) = (slab.start as f64, slab.end as f64 - 1.0);
        }
        // One more plane on both sides: each voxel is checked for positions on the edge.
        let (lo, hi) = (lower[main], upper[main]);
        (lower[main], upper[main]) = (lo - 1.0, hi + 1.0);
        let Some([near, far]) = ray.clip(lower, upper) else { return };
        let ends = [ray.at(main, near), ray.at(main, far)];
        let first = (ends[0].min(ends[1]) - 1.0).ceil().max(lo);
        let last = (ends[0].max(ends[1]) + 1.0).floor().min(hi);
        let step = ray.length / ray.ahead[main].abs();
        let mut plane = first;
        while plane <= last {
            let t = (plane - ray.source[main]) / ray.ahead[main];
            if t > 0.0 {
                let (pa, pb) = (ray.at(a, t), ray.at(b, t));
                let (ca, cb) = (pa.floor(), pb.floor());
                let (fa, fb) = (pa - ca, pb - cb);
                for (da, wa) in [(0.0, 1.0 - fa), (1.0, fa)] {
                    for (db, wb) in [(0.0, 1.0 - fb), (1.0, fb)] {
                        let mut at = [0.0; 3];
                        (at[main], at[a], at[b]) = (plane, ca + da, cb + db);
                        let inside = (0..3).all(|k| at[k] >= 0.0 && at[k] < n[k] as f64);
                        let voxel = at.map(|x| x as usize);
                        if inside && slab.contains(&voxel[0]) {
                            visit(voxel, wa * wb * step);
                        }
                    }
                }
            }
            plane += 1.0;
        }
    }
}

/// Differences between `g`'s projections and those ray by ray: in double precision, and in single precision relative to
/// the largest value.
fn off_the_rays(g: &Geometry) -> [f64; 2] {
    let x = noise::<f64>(g.volume.shape, 3);
    let mut slow = Array3::zeros((g.views.len(), g.detector[0], g.detector[1]));
    rays::forward(&JosephWalk, g, &all_views(g), x.view(), slow.view_mut());
    let largest = slow.iter().fold(0.0f64, |m, x| m.max(x.abs()));
    assert!(largest > 0.0);
    let fast = forward::<f64>(&Joseph {}, g, x.view());
    let double = Zip::from(&fast).and(&slow).fold(0.0f64, |w, a, b| w.max((a - b).abs()));
    let single = forward::<f32>(&Joseph {}, g, x.mapv(|v| v as f32).view());
    let single = Zip::from(&single).and(&slow).fold(0.0f64, |w, a, b| w.max((f64::from(*a) - b).abs()));
    [double, single / largest]
}

/// Joseph's projections are those ray by ray, and its adjoint is exact.
fn agrees_with_rays(g: &Geometry, what: &str) {
    let [double, single] = off_the_rays(g);
    assert!(double < 1e-10 && single < 1e-5, "{what}: {double:e} and {single:e} from rays");
    let [double, single] = [mismatch::<f64>(&Joseph {}, g, 7), mismatch::<f32>(&Joseph {}, g, 7)];
    assert!(double < 1e-12 && single < 1e-5, "{what}: {double:e} and {single:e} between adjoints");
}

#[test]
fn columns_and_bundles_agree_with_rays() {
    // Two of these views are tilted; from above, rays run along z; a detector narrower than a bundle.
    let (upright, tilted) = (crooked(true), crooked(false));
    assert!(all_views(&upright).iter().all(|&v| columns::of(&upright, v).is_some()));
    assert!(all_views(&tilted).iter().all(|&v| columns::of(&tilted, v).is_some()));
    let mut above = crooked(true);
    above.detector = [31, 5];
    for v in &mut above.views {
        for end in [&mut v.source, &mut v.detector, &mut v.u, &mut v.v] {
            *end = [end[2], end[1], end[0]];
        }
    }
    assert!(all_views(&above).iter().any(|&v| columns::of(&above, v).is_none()));
    for g in [upright, tilted, above] {
        let [double, single] = off_the_rays(&g);
        assert!(double < 1e-11, "{double:e}");
        assert!(single < 5e-6, "{single:e}");
    }
}

/// Detectors with small and large rotation and tilt; tiny, flat and long voxels; volumes of one voxel and of lines
/// longer than vectors; a source so close that rays of one column have different main axes.
#[test]
fn tilted_columns_agree_with_rays_and_are_adjoint() {
    let grids = [
        ([17, 23, 13], [1.9, 1.3, 2.4]),
        ([1, 1, 1], [20.0; 3]),
        ([2, 3, 50], [4.0, 3.0, 2.4]),
        ([12, 9, 1], [3.0, 4.0, 5.0]),
        ([31, 30, 33], [0.7, 1.1, 0.9]),
    ];
    for degrees in [1e-7, 0.4, -3.0, 12.0] {
        for (shape, spacing) in grids {
            let mut g = turned(crooked(true), degrees);
            g.volume = VoxelGrid { shape, spacing, center: [1.0, -2.0, 3.0] };
            g.detector = [41, 21];
            assert!(degrees > 4.0 || all_views(&g).iter().all(|&v| columns::of(&g, v).is_some()), "{degrees}");
            agrees_with_rays(&g, &format!("{degrees}° {shape:?}"));
        }
    }
}

/// Rays of one column with x and y as their main axes form two runs of rows.
#[test]
fn a_column_across_the_diagonal_is_split() {
    let mut g = turned(crooked(true), 8.0);
    g.views = vec![g.views[2]];
    let columns = columns::of(&g, 0).unwrap();
    assert!(columns.len() > g.detector[1], "{} of {}", columns.len(), g.detector[1]);
    agrees_with_rays(&g, "across the diagonal");
}

#[test]
fn rows_finer_than_voxels_and_coarser_agree_too() {
    for rows in [3.0, 0.5, 0.3, 0.1] {
        let mut g = crooked(true);
        g.detector = [(40.0 / rows) as usize, 9];
        for v in &mut g.views {
            v.v[2] *= rows;
            v.u = v.u.map(|x| 3.0 * x);
        }
        for g in [turned(g.clone(), 1.5), g] {
            agrees_with_rays(&g, &format!("rows of {rows}"));
        }
    }
}

/// Sums of 512 planes in single precision: the rounding error stays below 1e-6 of the sum.
#[test]
fn long_sums_keep_their_accuracy() {
    let g = Geometry {
        detector: [8, 40],
        views: vec![circular(0.4, 1000.0, 1500.0, [2.0, 20.0], [0.0; 2])],
        volume: VoxelGrid { shape: [512, 512, 12], spacing: [1.0; 3], center: [0.0; 3] },
    };
    let x = noise::<f32>(g.volume.shape, 11).mapv(|v| v + 0.6);
    let single = forward::<f32>(&Joseph {}, &g, x.view());
    let double = forward::<f64>(&Joseph {}, &g, x.mapv(f64::from).view());
    for (a, b) in single.iter().zip(&double) {
        assert!((f64::from(*a) - b).abs() <= 1e-6 * b.abs() + 1e-9, "{a} against {b}");
    }
}

/// The plain formula, voxel by voxel: the reference for FDK's back-projection.
fn backprojected(g: &Geometry, y: &Array3<f64>, scales: &[f64]) -> Array3<f64> {
    let [rows, columns] = g.detector;
    Array3::from_shape_fn(g.volume.shape, |(i, j, k)| {
        let of_view = |v: usize| {
            let ([row, column], depth) = Pinhole::of(g, v).project(g.volume.voxel([i, j, k]));
            if depth <= 0.0 {
                return 0.0;
            }
            let mut sum = 0.0;
            for (r, c) in [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)] {
                let (r, c) = (row.floor() + r, column.floor() + c);
                if r >= 0.0 && c >= 0.0 && r < rows as f64 && c < columns as f64 {
                    sum += (1.0 - (row - r).abs()) * (1.0 - (column - c).abs()) * y[[v, r as usize, c as usize]];
                }
            }
            scales[v] / (depth * depth) * sum
        };
        (0..g.views.len()).map(of_view).sum()
    })
}

/// Upright, tilted, on its side; a volume larger than the detector; lines shorter and longer than a vector; steps of
/// many rows from voxel to voxel.
#[test]
fn backprojection_by_lines_agrees_with_voxels() {
    let mut lying = crooked(true);
    for v in &mut lying.views {
        (v.u, v.v) = (v.v, v.u);
    }
    let mut long = turned(crooked(true), 2.0);
    long.volume.shape = [5, 4, 70];
    long.volume.spacing[2] = 0.9;
    let mut coarse = turned(crooked(true), -1.0);
    coarse.volume = VoxelGrid { shape: [3, 5, 40], spacing: [4.0, 4.0, 7.0], ..coarse.volume };
    coarse.detector = [250, 30];
    for g in [crooked(true), crooked(false), lying, long, coarse] {
        agrees_with_voxels(&g);
    }
}

/// Rows per voxel that need windows of every size, and more than any holds.
#[test]
fn backprojection_by_upright_lines_agrees_with_voxels() {
    for (rows, count) in [(0.3, 67), (1.2, 40), (2.4, 33), (3.3, 9), (3.9, 13), (9.0, 7)] {
        let mut g = crooked(true);
        g.volume = VoxelGrid { shape: [4, 11, count], spacing: [5.0, 3.0, rows * 1.7 * 90.0 / 140.0], ..g.volume };
        // The volume is larger, or lies wholly on the detector.
        for share in [0.6, 2.5] {
            g.detector = [(share * rows * count as f64) as usize + 1, 21];
            agrees_with_voxels(&g);
        }
    }
}

fn scales(g: &Geometry) -> Vec<f64> {
    (0..g.views.len()).map(|v| 1e4 * (1.0 + v as f64)).collect()
}

fn by_lines<R: Real>(g: &Geometry, y: &Array3<f64>) -> Array3<R> {
    let views = all_views(g);
    let pixels = ColumnMajor::new(g, &views, y.mapv(R::of).view());
    let mut out = Array3::from_elem(g.volume.shape, R::ZERO);
    backproject_in(g, &views, &pixels, &scales(g), out.view_mut(), 0);
    out
}

fn agrees_with_voxels(g: &Geometry) {
    let y = noise::<f64>([g.views.len(), g.detector[0], g.detector[1]], 4);
    let want = backprojected(g, &y, &scales(g));
    let largest = want.iter().fold(0.0f64, |m, x| m.max(x.abs()));
    assert!(largest > 0.0);
    fn error<R: Real>(found: &Array3<R>, want: &Array3<f64>) -> f64 {
        Zip::from(found).and(want).fold(0.0, |w, a, b| w.max((a.f64() - b).abs()))
    }
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| by_lines::<f32>(g, &y))
    };
    let single = on(1);
    assert!(single == on(3), "the number of threads changes {:?} of {:?}", g.volume, g.detector);
    let double = error(&by_lines::<f64>(g, &y), &want) / largest;
    let single = error(&single, &want) / largest;
    assert!(double < 1e-11, "{double:e} in {:?} of {:?}", g.volume, g.detector);
    assert!(single < 2e-5, "{single:e} in {:?} of {:?}", g.volume, g.detector);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn any_orbit_has_an_exact_adjoint(
        angle in 0.0..6.3f64,
        dso in 60.0..300.0f64,
        ratio in 1.05..3.0f64,
        pixel in 0.3..6.0f64,
        offset in -8.0..8.0f64,
        shape in prop::array::uniform3(1usize..14),
        spacing in prop::array::uniform3(0.4..3.0f64),
        detector in prop::array::uniform2(1usize..20),
        seed in 0u64..1000,
    ) {
        let g = Geometry {
            detector,
            views: vec![circular(angle, dso, dso * ratio, [pixel, pixel], [offset, -offset])],
            volume: VoxelGrid { shape, spacing, center: [0.5, -0.3, 0.2] },
        };
        for p in projectors() {
            let off = mismatch(p.reference(), &g, seed);
            prop_assert!(off < 1e-11, "{}: {off:e}", p.describe());
        }
    }
}

/// The line integrals of slabs add up to those of the whole, and each slab gets its part of the adjoint, if the
/// operator says so.
#[test]
fn slabs_of_an_additive_operator_add_up() {
    for g in [crooked(true), crooked(false), turned(crooked(true), 4.0)] {
        let (x, y) = (noise::<f64>(g.volume.shape, 3), noise::<f64>([g.views.len(), 29, 37], 5));
        for projector in projectors() {
            let op = projector.reference();
            let (whole, back) = (forward(op, &g, x.view()), adjoint(op, &g, y.view()));
            let (mut sum, mut parts) = (Array3::zeros(whole.raw_dim()), vec![]);
            for first in (0..g.volume.shape[0]).step_by(5) {
                let planes = first..(first + 5).min(g.volume.shape[0]);
                let part = Geometry { volume: g.volume.slab(planes.clone()), ..g.clone() };
                sum += &forward(op, &part, x.slice(s![planes, .., ..]));
                parts.push(adjoint(op, &part, y.view()));
            }
            let parts: Vec<_> = parts.iter().map(|p| p.view()).collect();
            let parts = concatenate(Axis(0), &parts).unwrap();
            let off = [(&sum, &whole), (&parts, &back)]
                .map(|(a, b)| Zip::from(a).and(b).fold(0.0f64, |worst, a, b| worst.max((a - b).abs())));
            assert_eq!(off.iter().all(|off| *off < 1e-11), op.is_additive(), "{}: {off:?}", projector.describe());
        }
    }
}
