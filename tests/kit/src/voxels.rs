//! Properties of a voxel projector: a linear operator that measures lengths, and its exact adjoint.

use crate::call::{beside_others, differing, error, none, on_threads, require, settle};
use crate::{Outcome, Report};
use conefield_core::geometry::{Geometry, Millimetres, Radians, Ray, Vec3, View, VoxelGrid};
use conefield_core::random::{mix, unit};
use conefield_core::simd::Real;
use conefield_core::voxel::{VoxelOperator, VoxelProjector};
use ndarray::{Array3, Axis, Zip};
use std::f64::consts::TAU;

/// Largest mismatch of `<Ax, y>` and `<x, Aᵀy>` relative to `‖Ax‖·‖y‖`, in double and in single precision.
const ADJOINT: [f64; 2] = [1e-12, 1e-5];
/// Largest error of single against double precision, relative to the largest number.
const SINGLE: f64 = 1e-5;
/// Root mean square error of a Gaussian of about 4 voxels' standard deviation against its closed form, relative to the
/// mean.
const CLOSED_FORM: f64 = 0.08;
/// With half as many voxels per side, the error must be larger by this factor.
const REFINED: f64 = 1.5;

/// Checks all properties of a voxel projector.
pub fn check_voxel_projector(projector: &dyn VoxelProjector) -> Report {
    let mut report = Report::of(projector.describe());
    let (single, double) = (projector.operator(), projector.reference());
    report.add("adjoint: double precision", || adjoint(double, ADJOINT[0]));
    report.add("adjoint: single precision", || adjoint(single, ADJOINT[1]));
    report.add("single precision", || single_precision(projector));
    report.add("closed form", || closed_form(single));
    report.holds("linear", "sums and multiples go through", || linear(double));
    report.add("views stand alone", || views_stand_alone(projector));
    report.holds("projections overwrite", "over NaN as over 0", || {
        geometries().iter().find_map(|g| projections_overwrite(single, g))
    });
    report.holds("adjoint adds", "to what is there", || geometries().iter().find_map(|g| adjoint_adds(double, g)));
    report.holds("threads", "1 and 3 threads, several callers", || threads(single));
    report.add("rays that miss", || rays_that_miss(projector));
    report.add("finite", || finite(single));
    report
}

pub(crate) fn view(angle: f64, distances: [f64; 2], pixel: [f64; 2], offset: [f64; 2]) -> View {
    let mm = Millimetres;
    View::circular(Radians(angle), mm(distances[0]), mm(distances[1]), pixel.map(mm), offset.map(mm))
}

/// A non-square detector, non-cubic voxels off the axis, views along and between the axes; one with rows in the
/// opposite direction and, unless `upright`, two tilted ones.
fn crooked(upright: bool) -> Geometry {
    let angles = [0.0, 0.3, std::f64::consts::FRAC_PI_4, 1.6, 2.9, 3.7];
    let mut views: Vec<View> = angles.iter().map(|&a| view(a, [90.0, 140.0], [2.1, 1.7], [3.0, -4.5])).collect();
    views[3].v[2] *= -1.0;
    if !upright {
        for v in &mut views[1..3] {
            v.v = [0.3, -0.2, -2.0];
            v.u[2] = 0.25;
            v.source[2] += 5.0;
        }
    }
    Geometry {
        detector: [21, 27],
        views,
        volume: VoxelGrid { shape: [15, 19, 11], spacing: [1.9, 1.3, 2.4], center: [1.0, -2.0, 3.0] },
    }
}

/// A single pixel, voxels in one line, rows much finer and much coarser than voxels.
fn narrow() -> Vec<Geometry> {
    let of = |detector, shape, pixel: f64| Geometry {
        detector,
        views: vec![view(0.4, [80.0, 130.0], [pixel; 2], [0.3, 0.2]), view(2.0, [80.0, 130.0], [pixel; 2], [0.0; 2])],
        volume: VoxelGrid { shape, spacing: [1.5; 3], center: [0.0; 3] },
    };
    vec![
        of([1, 1], [9, 9, 9], 2.0),
        of([7, 9], [1, 12, 1], 2.0),
        of([60, 5], [9, 8, 7], 0.3),
        of([5, 6], [9, 8, 7], 9.0),
    ]
}

fn geometries() -> Vec<Geometry> {
    [vec![crooked(true), crooked(false)], narrow()].concat()
}

fn all_views(g: &Geometry) -> Vec<usize> {
    (0..g.views.len()).collect()
}

/// Random numbers in [-0.5, 0.5).
pub(crate) fn noise<R: Real>(shape: [usize; 3], seed: u64) -> Array3<R> {
    let mut i = 0;
    Array3::from_shape_simple_fn(shape, || {
        i += 1;
        R::of(f64::from(unit(mix(seed, i))) - 0.5)
    })
}

fn pixels(g: &Geometry, views: usize) -> [usize; 3] {
    [views, g.detector[0], g.detector[1]]
}

fn forward<R: Real>(op: &dyn VoxelOperator<R>, g: &Geometry, views: &[usize], x: &Array3<R>) -> Array3<R> {
    let mut out = Array3::from_elem(pixels(g, views.len()), R::ZERO);
    op.forward(g, views, x.view(), out.view_mut());
    out
}

fn back<R: Real>(op: &dyn VoxelOperator<R>, g: &Geometry, views: &[usize], y: &Array3<R>) -> Array3<R> {
    let mut out = Array3::from_elem(g.volume.shape, R::ZERO);
    op.adjoint(g, views, y.view(), out.view_mut());
    out
}

fn dot<R: Real>(a: &Array3<R>, b: &Array3<R>) -> f64 {
    Zip::from(a).and(b).fold(0.0, |sum, x, y| sum + x.f64() * y.f64())
}

/// The difference of `<Ax, y>` and `<x, Aᵀy>` relative to `‖Ax‖·‖y‖`.
pub(crate) fn mismatch<R: Real>([x, aty]: [&Array3<R>; 2], [ax, y]: [&Array3<R>; 2]) -> f64 {
    (dot(ax, y) - dot(x, aty)).abs() / (dot(ax, ax) * dot(y, y)).sqrt()
}

pub(crate) fn flat<R: Real>(x: &Array3<R>) -> Vec<R> {
    x.iter().copied().collect()
}

/// Whether `x` is above `most` or NaN.
pub(crate) fn above(x: f64, most: f64) -> bool {
    x.is_nan() || x > most
}

/// A complaint if the relative error of `a` against `b` is above `most` or NaN.
pub(crate) fn apart<A: Real, B: Real>(what: &str, a: &Array3<A>, b: &Array3<B>, most: f64) -> Option<String> {
    let e = error(&flat(a), &flat(b));
    above(e, most).then(|| format!("{what}: off by {e:.1e}, at most {most:.0e}"))
}

fn adjoint<R: Real>(op: &dyn VoxelOperator<R>, most: f64) -> Outcome {
    let mut worst = 0.0f64;
    for (i, g) in geometries().iter().enumerate() {
        let views = all_views(g);
        for seed in [7, 8] {
            let (x, y) = (noise::<R>(g.volume.shape, seed), noise::<R>(pixels(g, views.len()), seed + 100));
            let (ax, aty) = (forward(op, g, &views, &x), back(op, g, &views, &y));
            let off = mismatch([&x, &aty], [&ax, &y]);
            require(off <= most, || format!("geometry {i}: <Ax, y> and <x, Aᵀy> differ by {off:.1e}"))?;
            worst = worst.max(off);
        }
    }
    Ok(format!("off by {worst:.1e} at most"))
}

fn single_precision(p: &dyn VoxelProjector) -> Outcome {
    let complaint = geometries().iter().enumerate().find_map(|(i, g)| {
        let views = all_views(g);
        let (x, y) = (noise::<f32>(g.volume.shape, 3), noise::<f32>(pixels(g, views.len()), 4));
        let wide = |a: &Array3<f32>| a.mapv(f64::from);
        let lines =
            [forward(p.operator(), g, &views, &x).mapv(f64::from), forward(p.reference(), g, &views, &wide(&x))];
        let voxels = [back(p.operator(), g, &views, &y).mapv(f64::from), back(p.reference(), g, &views, &wide(&y))];
        apart(&format!("geometry {i}: line integrals"), &lines[0], &lines[1], SINGLE)
            .or_else(|| apart(&format!("geometry {i}: voxels"), &voxels[0], &voxels[1], SINGLE))
    });
    settle(complaint, &format!("within {SINGLE:.0e} of double precision"))
}

/// A Gaussian of this centre and these standard deviations, in mm.
const GAUSSIAN: [Vec3; 2] = [[2.0, -1.0, 1.5], [5.0, 3.5, 4.5]];

/// The Gaussian's values at the centres of voxels.
fn gaussian(g: &VoxelGrid) -> Array3<f32> {
    let [centre, width] = GAUSSIAN;
    Array3::from_shape_fn(g.shape, |(x, y, z)| {
        let off = |k: usize, i: usize| {
            let at = g.center[k] + (i as f64 - 0.5 * (g.shape[k] - 1) as f64) * g.spacing[k];
            ((at - centre[k]) / width[k]).powi(2)
        };
        (-0.5 * (off(0, x) + off(1, y) + off(2, z))).exp() as f32
    })
}

/// Its integral along a ray that begins far outside. With both in units of the standard deviations, `e` is the square
/// of their distance and `1 / √a` a unit's length in mm.
fn gaussian_line(ray: &Ray) -> f64 {
    let [centre, width] = GAUSSIAN;
    let dot = |a: Vec3, b: Vec3| (0..3).map(|k| a[k] * b[k]).sum::<f64>();
    let from: Vec3 = std::array::from_fn(|k| (ray.origin[k] - centre[k]) / width[k]);
    let along: Vec3 = std::array::from_fn(|k| ray.direction[k] / width[k]);
    let a = dot(along, along);
    let e = dot(from, from) - dot(from, along).powi(2) / a;
    (TAU / a).sqrt() * (-0.5 * e).exp()
}

/// Lengths are in mm: a Gaussian's projections converge to their closed form for finer voxels, and their sum is right.
fn closed_form(op: &dyn VoxelOperator<f32>) -> Outcome {
    let of = |n: usize| {
        let g = Geometry {
            detector: [24, 24],
            views: [0.1, 1.2, 2.5].map(|a| view(a, [100.0, 150.0], [2.6; 2], [0.7, -1.1])).to_vec(),
            volume: VoxelGrid { shape: [n; 3], spacing: [40.0 / n as f64; 3], center: [0.0; 3] },
        };
        let found = forward(op, &g, &all_views(&g), &gaussian(&g.volume));
        let exact = Array3::from_shape_fn(pixels(&g, g.views.len()), |(v, r, c)| gaussian_line(&g.ray(v, r, c)) as f32);
        let square = found.iter().zip(&exact).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
        let sum = |x: &Array3<f32>| x.iter().map(|&v| f64::from(v)).sum::<f64>();
        ((square * exact.len() as f64).sqrt() / sum(&exact), sum(&found) / sum(&exact))
    };
    let [(coarse, _), (fine, sum)] = [of(20), of(40)];
    require(fine <= CLOSED_FORM, || format!("off by {fine:.3} of the mean, at most {CLOSED_FORM}"))?;
    let whole = (sum - 1.0).abs() <= 0.01;
    require(whole, || format!("all line integrals together are {sum:.4} of what they should be"))?;
    let still = || format!("off by {coarse:.3} on coarse voxels and still by {fine:.3} on voxels of half the size");
    require(fine * REFINED <= coarse, still)?;
    Ok(format!("off by {coarse:.3} and {fine:.3} of the mean, in sum {sum:.4}"))
}

/// A complaint about a map of arrays of `shape`, called `what`, that is not linear.
pub(crate) fn nonlinear(
    what: &str,
    of: impl Fn(&Array3<f64>) -> Array3<f64>,
    shape: [usize; 3],
    seeds: [u64; 2],
    most: f64,
) -> Option<String> {
    let mixed = |a: &Array3<f64>, b: &Array3<f64>| 2.5 * a - 0.75 * b;
    let [x, y] = seeds.map(|seed| noise::<f64>(shape, seed));
    let [a, b, both] = [&x, &y, &mixed(&x, &y)].map(of);
    apart(what, &both, &mixed(&a, &b), most)
}

fn linear(op: &dyn VoxelOperator<f64>) -> Option<String> {
    let g = crooked(false);
    let views = all_views(&g);
    let lines = |x: &_| forward(op, &g, &views, x);
    let voxels = |y: &_| back(op, &g, &views, y);
    nonlinear("line integrals of a sum", lines, g.volume.shape, [1, 2], 1e-12)
        .or_else(|| nonlinear("voxels from a sum", voxels, pixels(&g, views.len()), [3, 4], 1e-12))
}

/// A view's line integrals are bit-identical whatever other views are requested, in any order and number; and the
/// adjoint of several views is the sum of their adjoints.
fn views_stand_alone(p: &dyn VoxelProjector) -> Outcome {
    let g = crooked(false);
    let x = noise::<f32>(g.volume.shape, 5);
    let alone: Vec<Array3<f32>> = all_views(&g).iter().map(|&v| forward(p.operator(), &g, &[v], &x)).collect();
    for views in [vec![0, 1, 2, 3, 4, 5], vec![5, 2, 0], vec![1, 1, 4, 1], vec![3, 4]] {
        let all = forward(p.operator(), &g, &views, &x);
        for (i, &v) in views.iter().enumerate() {
            let found: Vec<f32> = all.index_axis(Axis(0), i).iter().copied().collect();
            none(differing(&format!("view {v} among {views:?}, pixel"), &found, &flat(&alone[v])))?;
        }
        let y = noise::<f64>(pixels(&g, views.len()), 6);
        let mut sum = Array3::zeros(g.volume.shape);
        for (&v, image) in views.iter().zip(y.axis_iter(Axis(0))) {
            sum += &back(p.reference(), &g, &[v], &image.insert_axis(Axis(0)).to_owned());
        }
        let together = back(p.reference(), &g, &views, &y);
        none(apart(&format!("voxels from views {views:?}"), &together, &sum, 1e-12))?;
    }
    let nothing = forward(p.operator(), &g, &[], &x).is_empty();
    require(nothing, || "no views gave something".into())?;
    Ok("alone, together, turned round and repeated".into())
}

fn projections_overwrite(op: &dyn VoxelOperator<f32>, g: &Geometry) -> Option<String> {
    let views = all_views(g);
    let x = noise::<f32>(g.volume.shape, 5);
    let clean = forward(op, g, &views, &x);
    let mut over = Array3::from_elem(clean.dim(), f32::NAN);
    op.forward(g, &views, x.view(), over.view_mut());
    differing("pixel", &flat(&over), &flat(&clean))
}

fn adjoint_adds(op: &dyn VoxelOperator<f64>, g: &Geometry) -> Option<String> {
    let views = all_views(g);
    let (before, y) = (noise::<f64>(g.volume.shape, 5), noise::<f64>(pixels(g, views.len()), 6));
    let mut after = before.clone();
    op.adjoint(g, &views, y.view(), after.view_mut());
    apart("what was there is not kept", &after, &(&before + &back(op, g, &views, &y)), 1e-12)
}

/// Results are bit-identical on pools of one and three threads, and from concurrent callers.
fn threads(op: &dyn VoxelOperator<f32>) -> Option<String> {
    let g = crooked(false);
    let views = all_views(&g);
    let both = |i: usize| {
        let seed = 2 * i as u64;
        let (x, y) = (noise::<f32>(g.volume.shape, seed + 1), noise::<f32>(pixels(&g, views.len()), seed + 2));
        [flat(&forward(op, &g, &views, &x)), flat(&back(op, &g, &views, &y))].concat()
    };
    on_threads(|| both(0), |n, a, b| differing(&format!("{n}, number"), a, b))
        .or_else(|| beside_others(both, |a, b| differing("several callers, number", a, b)))
}

/// Rays that miss the voxels give exactly 0 and contribute nothing to the adjoint; empty input gives empty output.
fn rays_that_miss(p: &dyn VoxelProjector) -> Outcome {
    let mut g = crooked(false);
    // Twice as far out as the voxels.
    g.detector = [61, 67];
    let views = all_views(&g);
    let [low, high] = g.volume.bounds();
    // Interpolation may reach one voxel beyond the box.
    let around = [0, 1].map(|s| {
        let side = if s == 0 { low } else { high };
        std::array::from_fn(|k| side[k] + g.volume.spacing[k] * if s == 0 { -1.0 } else { 1.0 })
    });
    let hit = Array3::from_shape_fn(pixels(&g, views.len()), |(v, r, c)| g.ray(v, r, c).clip(around).is_some());
    let misses = hit.iter().filter(|h| !**h).count();
    let lines = forward(p.operator(), &g, &views, &Array3::ones(g.volume.shape));
    require(misses != 0 && misses != hit.len(), || "no ray misses".into())?;
    let wrong = lines.iter().zip(&hit).find(|(found, hit)| !**hit && **found != 0.0);
    none(wrong.map(|(found, _)| format!("a ray that misses gives {found:e}")))?;
    require(lines.iter().any(|x| *x != 0.0), || "rays that meet voxels give 0".into())?;
    let outside = hit.mapv(|h| if h { 0.0 } else { 1.0 });
    let zero =
        |what: &str, x: Array3<f64>| none(x.iter().find(|v| **v != 0.0).map(|v| format!("{what}: {v:e} instead of 0")));
    let op = p.reference();
    zero("voxels from rays that miss", back(op, &g, &views, &outside))?;
    zero("line integrals of nothing", forward(op, &g, &views, &Array3::zeros(g.volume.shape)))?;
    zero("voxels from nothing", back(op, &g, &views, &Array3::zeros(pixels(&g, views.len()))))?;
    Ok(format!("{misses} of {} rays miss", hit.len()))
}

/// Rays along axes, on faces between voxels and through corners, large and tiny numbers: never NaN or infinity.
fn finite(op: &dyn VoxelOperator<f32>) -> Outcome {
    // The middle ray runs along x through the faces between voxels, others through their edges.
    let along = |shape: [usize; 3], detector| Geometry {
        detector,
        views: [0.0, 0.5, 1.0, 1.5, 0.25]
            .map(|turn| view(turn * std::f64::consts::PI, [40.0, 80.0], [2.0; 2], [0.0; 2]))
            .to_vec(),
        volume: VoxelGrid { shape, spacing: [1.0; 3], center: [0.0; 3] },
    };
    let mut all =
        vec![along([8, 8, 8], [9, 9]), along([8, 8, 8], [8, 8]), along([1, 1, 1], [3, 3]), along([7, 2, 1], [1, 1])];
    // A source that nearly touches the voxels.
    let mut near = along([8, 8, 8], [9, 9]);
    near.views.iter_mut().for_each(|v| v.source = v.source.map(|x| x * 6.0 / 40.0));
    all.push(near);
    all.extend(geometries());
    for (i, g) in all.iter().enumerate() {
        let views = all_views(g);
        for value in [1.0f32, -1e30, 1e-40, f32::MIN_POSITIVE] {
            let lines = forward(op, g, &views, &Array3::from_elem(g.volume.shape, value));
            let voxels = back(op, g, &views, &Array3::from_elem(pixels(g, views.len()), value));
            let bad = lines.iter().chain(&voxels).find(|x| !x.is_finite());
            none(bad.map(|x| format!("geometry {i} of {value:e}: {x}")))?;
        }
    }
    Ok(format!("{} geometries", all.len()))
}
