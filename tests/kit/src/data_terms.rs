//! Properties of a data term: a convex function of residuals, its derivative and a bound of its curvature.

use crate::call::{differing, no_fault, on_threads, settle};
use crate::voxels::{above, flat, noise};
use crate::{Outcome, Report};
use conefield_core::data_term::{DataTerm, Misfit};
use conefield_core::random::{mix, unit};
use ndarray::{Array3, Axis};

/// Standard deviation of the scan's noise.
const SIGMA: f32 = 0.02;
/// Step of first and second differences.
const STEP: f32 = 0.05;
const SHORT: f32 = 1.0 / 512.0;
/// Largest difference of slopes over one and two steps, relative to the largest derivative.
const KINK: f64 = 1e-3;
/// Largest error of a derivative, relative to the largest one.
const ERROR: f64 = 2e-3;

/// Checks all properties of a data term.
pub fn check_data_term(term: &dyn DataTerm) -> Report {
    let mut report = Report::of(term.describe());
    let scan = scan();
    let of = match term.of(scan.view()) {
        Ok(of) => &On { of, measured: scan },
        Err(e) => {
            report.add("learns from a scan", || Err(e.into()));
            return report;
        }
    };
    report.add("finite differences", || differences(of));
    report.add("curvature", || curvature(of));
    report.add("least where nothing is left", || least(of));
    report.holds("views stand alone", "alone, together, turned round and repeated", || views_stand_alone(of));
    report.add("noise", || sigma(of));
    report.add("spread of noise", || spread(of));
    report.holds("finite", "nothing, a pixel, large values", || finite(term));
    report.holds("threads", "1 and 3 threads", || threads(of));
    report.add("no fault", || no_fault(of.of.fault()));
    report
}

/// A data term with its measured line integrals.
struct On {
    of: Box<dyn Misfit>,
    measured: Array3<f32>,
}

impl On {
    /// Calls `work` with each view, its measurements and its image; returns the sum of the results.
    fn each(&self, views: &[usize], images: &mut Array3<f32>, work: impl Fn(usize, &[f32], &mut [f32]) -> f64) -> f64 {
        let all = images.outer_iter_mut().zip(views);
        all.map(|(mut image, &view)| {
            let measured: Vec<f32> = self.measured.index_axis(Axis(0), view).iter().copied().collect();
            image.as_slice_mut().map_or(f64::NAN, |image| work(view, &measured, image))
        })
        .sum()
    }

    fn differentiate(&self, views: &[usize], residuals: &mut Array3<f32>) -> f64 {
        self.each(views, residuals, |view, measured, r| self.of.differentiate(view, measured, r))
    }

    /// Applies `f` to ones.
    fn of_ones(&self, f: impl Fn(usize, &[f32], &mut [f32])) -> Array3<f32> {
        let mut ones = Array3::ones(self.measured.dim());
        self.each(&ALL, &mut ones, |view, measured, image| {
            f(view, measured, image);
            0.0
        });
        ones
    }

    fn curve(&self) -> Array3<f32> {
        self.of_ones(|view, measured, image| self.of.curve(view, measured, image))
    }

    fn spread(&self) -> Array3<f32> {
        self.of_ones(|view, measured, image| self.of.spread(view, measured, image))
    }
}

/// Three views of a bump of line integrals up to 3, with noise that increases with them.
fn scan() -> Array3<f32> {
    let mut i = 0;
    Array3::from_shape_fn((3, 24, 40), |(_, _, c)| {
        let p = 3.0 * (std::f32::consts::PI * c as f32 / 39.0).sin();
        // The sum of twelve draws is approximately normal.
        let drawn: f32 = (0..12)
            .map(|_| {
                unit(mix(11, {
                    i += 1;
                    i
                })) - 0.5
            })
            .sum();
        p + SIGMA * (0.5 * p).exp() * drawn
    })
}

const ALL: [usize; 3] = [0, 1, 2];

/// Value and derivatives at residuals.
fn at(of: &On, views: &[usize], residuals: &Array3<f32>) -> (f64, Array3<f32>) {
    let mut r = residuals.clone();
    let value = of.differentiate(views, &mut r);
    (value, r)
}

/// Value at `r` after changing one pixel by `change`.
fn moved(of: &On, r: &Array3<f32>, pixel: [usize; 3], change: f32) -> f64 {
    let mut r = r.clone();
    r[pixel] += change;
    at(of, &ALL, &r).0
}

/// Some pixels of each view.
fn pixels() -> impl Iterator<Item = [usize; 3]> {
    ALL.into_iter().flat_map(|v| (0..24).step_by(7).flat_map(move |r| (0..40).step_by(6).map(move |c| [v, r, c])))
}

/// Central differences over one and two steps. If they disagree, there is a kink nearby, and the pixel is ignored.
fn differences(of: &On) -> Outcome {
    let r = noise::<f32>([3, 24, 40], 3);
    let (_, derivative) = at(of, &ALL, &r);
    let top = derivative.iter().fold(0.0f64, |m, d| m.max(f64::from(d.abs())));
    let (mut worst, mut smooth, mut all) = (0.0f64, 0, 0);
    for pixel in pixels() {
        let slope = |step: f32| {
            // The step as represented in single precision.
            let length = f64::from(r[pixel] + step) - f64::from(r[pixel] - step);
            (moved(of, &r, pixel, step) - moved(of, &r, pixel, -step)) / length
        };
        let (near, far) = (slope(SHORT), slope(2.0 * SHORT));
        all += 1;
        if (near - far).abs() <= KINK * top {
            smooth += 1;
            let e = (f64::from(derivative[pixel]) - near).abs() / top;
            worst = if e.is_nan() { f64::INFINITY } else { worst.max(e) };
        }
    }
    let few = (2 * smooth < all).then(|| format!("smooth at {smooth} of {all} pixels"));
    let off = above(worst, ERROR).then(|| format!("off by {worst:.1e}"));
    settle(few.or(off), &format!("off by {worst:.1e} at most"))
}

/// Second differences lie between 0 and [`Misfit::curve`].
fn curvature(of: &On) -> Outcome {
    let r = noise::<f32>([3, 24, 40], 4);
    let bound = of.curve();
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

fn least(of: &On) -> Outcome {
    let zero = at(of, &ALL, &Array3::zeros([3, 24, 40]));
    let steep = zero.1.iter().find(|d| **d != 0.0).map(|d| format!("a derivative of {d:e} where nothing is left"));
    let complaint = (0..5).find_map(|seed| {
        let value = at(of, &ALL, &noise([3, 24, 40], seed)).0;
        (value.is_nan() || value <= zero.0).then(|| format!("{value} with residuals, {} without", zero.0))
    });
    settle(steep.or(complaint), "no residuals, least value")
}

fn views_stand_alone(of: &On) -> Option<String> {
    let r = noise::<f32>([3, 24, 40], 5);
    [vec![2, 0], vec![1], vec![0, 1, 2], vec![1, 1]].into_iter().find_map(|views| {
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
    })
}

/// The noise is found, either of line integrals near 0 or on average over all of them.
fn sigma(of: &On) -> Outcome {
    let found = of.of.noise() / f64::from(SIGMA);
    let complaint = (!(0.7..5.0).contains(&found)).then(|| format!("{found:.2} times what it is"));
    settle(complaint, &format!("{found:.2} times what it is near 0"))
}

/// Weighted noise has at most the standard deviation of noise whose variance is the inverse of the curvature.
fn spread(of: &On) -> Outcome {
    let spread = of.spread();
    let bad = spread.iter().find(|s| !s.is_finite() || **s < 0.0).map(|s| format!("a standard deviation of {s}"));
    let curve = of.curve();
    let complaint = pixels().find_map(|pixel| {
        let (found, most) = (f64::from(spread[pixel]), f64::from(curve[pixel]).sqrt());
        (found > 1.001 * most).then(|| format!("pixel {pixel:?}: {found:.4}, at most {most:.4}"))
    });
    settle(bad.or(complaint), "at most the root of the curvature")
}

/// Scans without noise, empty scans, and scans of a single pixel.
fn finite(term: &dyn DataTerm) -> Option<String> {
    [0.0f32, 1e-30, 1.0, 1e4].into_iter().find_map(|value| {
        [[24, 40], [1, 1], [1, 7], [7, 1]].into_iter().find_map(|[rows, columns]| {
            let measured = Array3::from_elem((3, rows, columns), value);
            let of = match term.of(measured.view()) {
                Ok(of) => On { of, measured },
                Err(e) => return Some(e.to_string()),
            };
            let mut r = noise([3, rows, columns], 1);
            let found = of.differentiate(&ALL, &mut r);
            let numbers = [r, of.curve(), of.spread()];
            let fine =
                found.is_finite() && of.of.noise().is_finite() && numbers.iter().flatten().all(|x| x.is_finite());
            (!fine).then(|| format!("{rows} x {columns} pixels of {value:e}"))
        })
    })
}

fn threads(of: &On) -> Option<String> {
    let run = || at(of, &ALL, &noise([3, 24, 40], 6));
    on_threads(run, |n, (value, found), (want, wanted)| {
        let other = (value != want).then(|| format!("{n}: {value} instead of {want}"));
        other.or_else(|| differing(&format!("{n}, pixel"), &flat(found), &flat(wanted)))
    })
}
