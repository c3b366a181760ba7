//! What a data term must keep to: a convex function of residuals, its derivative and a bound of its curvature.

use crate::call::{differing, settle};
use crate::voxels::{noise, view};
use crate::{Outcome, Report};
use conefield_core::data_term::{DataTerm, Misfit};
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::random::{mix, unit};
use conefield_core::scan::{Scan, Unit};
use ndarray::{Array3, Axis};
use rayon::ThreadPoolBuilder;

/// Standard deviation of the scan's noise.
const SIGMA: f32 = 0.02;
/// Step of differences.
const STEP: f32 = 0.05;
/// Largest error of a derivative, as a share of the largest.
const ERROR: f64 = 2e-3;

/// Runs every property that a data term must have.
pub fn check_data_term(term: &dyn DataTerm) -> Report {
    let mut report = Report { stage: term.describe(), entries: vec![] };
    let scan = scan();
    let of = term.of(&scan);
    let of = of.as_ref();
    report.add("finite differences", || differences(of));
    report.add("curvature", || curvature(of));
    report.add("least where nothing is left", || least(of));
    report.add("views stand alone", || views_stand_alone(of));
    report.add("noise", || sigma(of));
    report.add("spread of noise", || spread(of));
    report.add("finite", || finite(term));
    report.add("threads", || threads(of));
    report
}

/// Three views of a hill of line integrals up to 3, with noise that grows with them.
fn scan() -> Scan {
    let geometry = Geometry {
        detector: [24, 40],
        views: [0.1, 1.2, 2.5].map(|a| view(a, [300.0, 400.0], [1.0; 2], [0.0; 2])).to_vec(),
        volume: VoxelGrid { shape: [8; 3], spacing: [1.0; 3], center: [0.0; 3] },
    };
    let mut i = 0;
    let projections = Array3::from_shape_fn((3, 24, 40), |(_, _, c)| {
        let p = 3.0 * (std::f32::consts::PI * c as f32 / 39.0).sin();
        // Twelve draws together are about normal.
        let drawn: f32 = (0..12)
            .map(|_| {
                unit(mix(11, {
                    i += 1;
                    i
                })) - 0.5
            })
            .sum();
        p + SIGMA * (0.5 * p).exp() * drawn
    });
    Scan { geometry, projections, unit: Unit::default(), provenance: Default::default() }
}

const ALL: [usize; 3] = [0, 1, 2];

/// Value and derivatives at residuals.
fn at(of: &dyn Misfit, views: &[usize], residuals: &Array3<f32>) -> (f64, Array3<f32>) {
    let mut r = residuals.clone();
    let value = of.differentiate(views, r.view_mut());
    (value, r)
}

/// Value at `r` with a pixel `change` away.
fn moved(of: &dyn Misfit, r: &Array3<f32>, pixel: [usize; 3], change: f32) -> f64 {
    let mut r = r.clone();
    r[pixel] += change;
    at(of, &ALL, &r).0
}

/// Some pixels of each view.
fn pixels() -> impl Iterator<Item = [usize; 3]> {
    ALL.into_iter().flat_map(|v| (0..24).step_by(7).flat_map(move |r| (0..40).step_by(6).map(move |c| [v, r, c])))
}

fn differences(of: &dyn Misfit) -> Outcome {
    let r = noise::<f32>([3, 24, 40], 3);
    let (_, derivative) = at(of, &ALL, &r);
    let top = derivative.iter().fold(0.0f64, |m, d| m.max(f64::from(d.abs())));
    let mut worst = 0.0f64;
    for pixel in pixels() {
        // The step as single precision has it.
        let step = f64::from(r[pixel] + STEP) - f64::from(r[pixel] - STEP);
        let want = (moved(of, &r, pixel, STEP) - moved(of, &r, pixel, -STEP)) / step;
        let off = (f64::from(derivative[pixel]) - want).abs() / top;
        worst = if off.is_nan() { f64::INFINITY } else { worst.max(off) };
    }
    settle((worst > ERROR).then(|| format!("off by {worst:.1e}")), &format!("off by {worst:.1e} at most"))
}

/// Second differences lie between 0 and what [`Misfit::curve`] says.
fn curvature(of: &dyn Misfit) -> Outcome {
    let r = noise::<f32>([3, 24, 40], 4);
    let mut bound = Array3::ones([3, 24, 40]);
    of.curve(&ALL, bound.view_mut());
    let here = at(of, &ALL, &r).0;
    let top = bound.iter().fold(0.0f32, |m, b| m.max(*b));
    let complaint = pixels().find_map(|pixel| {
        let second = (moved(of, &r, pixel, STEP) + moved(of, &r, pixel, -STEP) - 2.0 * here) / f64::from(STEP).powi(2);
        let (most, slack) = (f64::from(bound[pixel]), 1e-3 * f64::from(top));
        let fine = second > -slack && second < most + slack;
        (!fine).then(|| format!("pixel {pixel:?}: second difference {second:.4}, bound {most:.4}"))
    });
    let flat = (top <= 0.0 || !top.is_finite()).then(|| format!("a bound of {top}"));
    settle(flat.or(complaint), "between 0 and its bound")
}

fn least(of: &dyn Misfit) -> Outcome {
    let zero = at(of, &ALL, &Array3::zeros([3, 24, 40]));
    let steep = zero.1.iter().find(|d| **d != 0.0).map(|d| format!("a derivative of {d:e} where nothing is left"));
    let complaint = (0..5).find_map(|seed| {
        let value = at(of, &ALL, &noise([3, 24, 40], seed)).0;
        (value.is_nan() || value <= zero.0).then(|| format!("{value} with residuals, {} without", zero.0))
    });
    settle(steep.or(complaint), "no residuals, least value")
}

fn views_stand_alone(of: &dyn Misfit) -> Outcome {
    let r = noise::<f32>([3, 24, 40], 5);
    let complaint = [vec![2, 0], vec![1], vec![0, 1, 2], vec![1, 1]].into_iter().find_map(|views| {
        let (value, all) = at(of, &views, &r.select(Axis(0), &views));
        let mut sum = 0.0;
        let wrong = views.iter().enumerate().find_map(|(i, &v)| {
            let (part, alone) = at(of, &[v], &r.select(Axis(0), &[v]));
            sum += part;
            let found: Vec<f32> = all.index_axis(Axis(0), i).iter().copied().collect();
            let alone: Vec<f32> = alone.iter().copied().collect();
            differing(&format!("view {v} among {views:?}, pixel"), &found, &alone)
        });
        let apart = (value - sum).abs() > 1e-9 * sum.abs();
        wrong.or_else(|| apart.then(|| format!("views {views:?}: {value} together, {sum} one by one")))
    });
    settle(complaint, "alone, together, turned round and repeated")
}

/// The noise of line integrals near 0 is found, or of all of them in the mean.
fn sigma(of: &dyn Misfit) -> Outcome {
    let found = of.noise() / f64::from(SIGMA);
    let complaint = (!(0.7..5.0).contains(&found)).then(|| format!("{found:.2} times what it is"));
    settle(complaint, &format!("{found:.2} times what it is near 0"))
}

/// With residuals that are the noise, derivatives have the standard deviation that [`Misfit::spread`] says.
fn spread(of: &dyn Misfit) -> Outcome {
    let mut spread = Array3::ones([3, 24, 40]);
    of.spread(&ALL, spread.view_mut());
    let bad = spread.iter().find(|s| !s.is_finite() || **s < 0.0).map(|s| format!("a standard deviation of {s}"));
    let mut curve = Array3::ones([3, 24, 40]);
    of.curve(&ALL, curve.view_mut());
    // Noise of the deviation 1/√w, weighted by w.
    let complaint = pixels().find_map(|pixel| {
        let (found, want) = (f64::from(spread[pixel]), f64::from(curve[pixel]).sqrt());
        ((found - want).abs() > 1e-3 * want).then(|| format!("pixel {pixel:?}: {found:.4} instead of {want:.4}"))
    });
    settle(bad.or(complaint), "the root of the curvature")
}

/// Scans without noise, of nothing, and of a single pixel.
fn finite(term: &dyn DataTerm) -> Outcome {
    let complaint = [0.0f32, 1e-30, 1.0, 1e4].into_iter().find_map(|value| {
        [[24, 40], [1, 1], [1, 7], [7, 1]].into_iter().find_map(|[rows, columns]| {
            let mut scan = scan();
            scan.geometry.detector = [rows, columns];
            scan.projections = Array3::from_elem((3, rows, columns), value);
            let of = term.of(&scan);
            let mut all =
                [noise([3, rows, columns], 1), Array3::ones([3, rows, columns]), Array3::ones([3, rows, columns])];
            let [r, curve, spread] = &mut all;
            let found = of.differentiate(&ALL, r.view_mut());
            of.curve(&ALL, curve.view_mut());
            of.spread(&ALL, spread.view_mut());
            let fine = found.is_finite() && of.noise().is_finite() && all.iter().flatten().all(|x| x.is_finite());
            (!fine).then(|| format!("{rows} x {columns} pixels of {value:e}"))
        })
    });
    settle(complaint, "nothing, a pixel, large values")
}

fn threads(of: &dyn Misfit) -> Outcome {
    let run = || {
        let (value, r) = at(of, &ALL, &noise([3, 24, 40], 6));
        (value, r.iter().copied().collect::<Vec<f32>>())
    };
    let want = run();
    let complaint = [1, 3].into_iter().find_map(|n| {
        let pool = ThreadPoolBuilder::new().num_threads(n).build().ok()?;
        let (value, found) = pool.install(run);
        let other = (value != want.0).then(|| format!("{n} threads: {value} instead of {}", want.0));
        other.or_else(|| differing(&format!("{n} threads, pixel"), &found, &want.1))
    });
    settle(complaint, "1 and 3 threads")
}
