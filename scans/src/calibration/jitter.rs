//! Shifts of the detector from view to view: thermal drift, a table or an arm that does not stop where it should.
//!
//! Each view is compared with its prediction from a reconstruction of other views (projection matching: Dengler,
//! Ultramicroscopy 30, 1989; reconstruction and alignment in turn: Gürsoy et al., Scientific Reports 7, 2017). If the
//! detector is shifted by `d` pixels, the view differs from the prediction `p` by about `d·∇p`; least squares give `d`.
//! The detectors move by that, and the prediction is repeated, from coarse to fine pixels. Held-out views take turns,
//! so no view is compared with itself.
//!
//! A shift of the object changes all views as shifts of the detectors do. That part of the shifts is removed: the
//! object stays in place.

use crate::calibration::criterion::Level;
use crate::calibration::search::{LONGEST, Meter, SMALL};
use crate::calibration::{FEWEST, Verdict, Watch, widths};
use crate::provenance;
use conefield_core::backend::Backend;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Vec3, View, dot, norm, sub};
use conefield_core::matrix::{inner, inverse};
use conefield_core::scan::Scan;
use ndarray::{ArrayView2, Zip};
use serde::Serialize;
use serde_json::json;
use std::sync::Mutex;

/// Rounds of prediction and comparison at each level.
const ROUNDS: usize = 6;
/// Shifts are real if their size exceeds their uncertainty by this factor, and the held-out error falls below this
/// share.
const CLEAR: f64 = 2.0;
const LOWER: f64 = 0.97;
/// A round that does not lower the held-out error to this share is undone and ends its level. Shifts that vary slowly
/// from view to view change the reconstruction more than its predictions: further rounds would follow errors of the
/// reconstruction.
const GAIN: f64 = 0.99;
/// Side of the squares of a chessboard on the detector, in pixels; its two colours give two independent estimates.
const SQUARE: usize = 4;

/// The shift of each view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Jitter {
    /// `Corrected` or `Kept`: whether [`Jitter::correct`] moves the detectors.
    pub verdict: Verdict,
    /// Shift of the detector along v and u for each view, mm.
    pub shifts: Vec<[f64; 2]>,
    /// Their root mean square along v and u, in pixels of the scan.
    pub pixels: [f64; 2],
    /// Standard deviation of the random error of a shift along v and u, in pixels of the scan. Errors of the
    /// reconstruction, which change slowly from view to view, are not part of it.
    pub uncertainty: [f64; 2],
    /// The held-out error at the finest level, before and after the correction.
    pub held_out: [f64; 2],
}

impl Jitter {
    /// Moves the detectors of `scan` unless the shifts are within their uncertainty, and records it in the provenance.
    pub fn correct(&self, scan: &mut Scan) {
        if self.verdict != Verdict::Corrected {
            return;
        }
        scan.geometry.views = shifted(&scan.geometry.views, &self.shifts);
        let [v, u] = self.pixels;
        *provenance::entry(scan, "jitter") = json!({ "rms_pixels": { "v": v, "u": u }, "held_out": self.held_out });
    }
}

/// Estimates the shift of each view on up to about `width` pixels along the longer side of the detector.
///
/// # Errors
/// Fewer than eight views.
pub fn jitter(scan: &Scan, width: usize, backend: &dyn Backend, watch: &dyn Watch) -> Result<Jitter> {
    scan.validate("scan")?;
    let n = scan.geometry.views.len();
    ensure(n >= FEWEST, "scan", "views", n, format!("at least {FEWEST}, some of which are held out"))?;
    let levels: Vec<Level> = widths(scan, width).into_iter().map(|w| Level::whole(scan, w)).collect::<Result<_>>()?;
    let total = (ROUNDS + 1) as f64 * levels.iter().map(Level::work).sum::<f64>();
    let meter = Meter { watch, total, done: Mutex::new(0.0) };
    let mut shifts = vec![[0.0; 2]; n];
    for level in &levels {
        let mut next = shifts.clone();
        let mut best = f64::INFINITY;
        for _ in 0..ROUNDS {
            let round = compare(level, &next, backend, &meter)?;
            if round.error > GAIN * best {
                break;
            }
            (best, shifts) = (round.error, next.clone());
            let mut longest = 0.0f64;
            for (i, (shift, step)) in next.iter_mut().zip(&round.steps).enumerate() {
                let pixel = pixel(&level.geometry.views[i]);
                for k in 0..2 {
                    let limited = step[k].clamp(-LONGEST * pixel[k], LONGEST * pixel[k]);
                    shift[k] += limited;
                    longest = longest.max(limited.abs() / pixel[k]);
                }
            }
            remove_motion(&level.geometry.views, level.geometry.volume.center, &mut next);
            if longest < SMALL {
                break;
            }
        }
    }
    let finest = &levels[levels.len() - 1];
    let before = compare(finest, &vec![[0.0; 2]; n], backend, &meter)?.error;
    let last = compare(finest, &shifts, backend, &meter)?;
    let pixel = pixel(&scan.geometry.views[0]);
    let rms = |of: &dyn Fn(usize) -> [f64; 2]| -> [f64; 2] {
        std::array::from_fn(|k| ((0..n).map(|i| of(i)[k].powi(2)).sum::<f64>() / n as f64).sqrt() / pixel[k])
    };
    let pixels = rms(&|i| shifts[i]);
    // The mean of two estimates deviates by half their difference.
    let uncertainty = rms(&|i| last.differences[i].map(|d| d / 2.0));
    let clear = (0..2).any(|k| pixels[k] > CLEAR * uncertainty[k]) && last.error < LOWER * before;
    let verdict = if clear { Verdict::Corrected } else { Verdict::Kept };
    Ok(Jitter { verdict, shifts, pixels, uncertainty, held_out: [before, last.error] })
}

/// One comparison of all views with their predictions.
struct Round {
    /// The best further shift of each view along v and u, mm.
    steps: Vec<[f64; 2]>,
    /// The difference of two independent estimates of it.
    differences: Vec<[f64; 2]>,
    error: f64,
}

fn compare(level: &Level, shifts: &[[f64; 2]], backend: &dyn Backend, meter: &Meter<'_>) -> Result<Round> {
    let g = &level.geometry;
    let views = shifted(&g.views, shifts);
    let folds = level.residuals(&views, g.volume, backend, &|| meter.watch.cancelled())?;
    meter.count(level.work())?;
    let (mut steps, mut differences) = (vec![[0.0; 2]; views.len()], vec![[0.0; 2]; views.len()]);
    for ((i, measured), residual) in level.held_out().zip(folds.iter().flat_map(|f| f.outer_iter())) {
        let pixel = pixel(&g.views[i]);
        let in_mm = |d: [f64; 2]| [d[0] * pixel[0], d[1] * pixel[1]];
        let [one, two] = normal_equations(measured, residual);
        let both = Normal(std::array::from_fn(|k| one.0[k] + two.0[k]));
        steps[i] = in_mm(both.solve());
        let [a, b] = [one, two].map(|half| in_mm(half.solve()));
        differences[i] = [a[0] - b[0], a[1] - b[1]];
    }
    Ok(Round { steps, differences, error: level.prediction(&folds).error })
}

/// Pixel along v and u, mm.
fn pixel(view: &View) -> [f64; 2] {
    [norm(view.v), norm(view.u)]
}

/// Normal equations of a shift along v and u: sums of v·v, v·u, u·u, v·r and u·r for slopes v and u of the prediction and
/// residuals r.
#[derive(Default, Clone, Copy)]
struct Normal([f64; 5]);

impl Normal {
    /// The shift in pixels; zero along a direction without structure.
    fn solve(&self) -> [f64; 2] {
        let Self([vv, vu, uu, v, u]) = *self;
        let determinant = vv * uu - vu * vu;
        if determinant > 1e-6 * vv * uu {
            return [(uu * v - vu * u) / determinant, (vv * u - vu * v) / determinant];
        }
        let along = |square: f64, product: f64| if square > 0.0 { product / square } else { 0.0 };
        if vv > uu { [along(vv, v), 0.0] } else { [0.0, along(uu, u)] }
    }
}

/// The equations of a view's shift from the squares of either colour of the chessboard. A detector shifted by `d`
/// pixels shows `p(x + d)`, so that measured minus predicted is about `d·∇p`.
fn normal_equations(measured: ArrayView2<'_, f32>, residual: ArrayView2<'_, f32>) -> [Normal; 2] {
    let (rows, columns) = measured.dim();
    let mut sums = [Normal::default(); 2];
    let predicted = |i: usize, j: usize| f64::from(measured[[i, j]]) - f64::from(residual[[i, j]]);
    Zip::indexed(residual).for_each(|(i, j), &r| {
        if i == 0 || j == 0 || i + 1 == rows || j + 1 == columns {
            return;
        }
        let v = (predicted(i + 1, j) - predicted(i - 1, j)) / 2.0;
        let u = (predicted(i, j + 1) - predicted(i, j - 1)) / 2.0;
        let r = f64::from(r);
        let sums = &mut sums[(i / SQUARE + j / SQUARE) % 2].0;
        sums.iter_mut().zip([v * v, v * u, u * u, v * r, u * r]).for_each(|(sum, x)| *sum += x);
    });
    sums
}

/// The views with their detectors shifted along v and u, mm.
fn shifted(views: &[View], shifts: &[[f64; 2]]) -> Vec<View> {
    let of = |(view, [v, u]): (&View, &[f64; 2])| {
        let [a, b] = [v / norm(view.v), u / norm(view.u)];
        let detector = std::array::from_fn(|k| view.detector[k] + a * view.v[k] + b * view.u[k]);
        View { detector, ..*view }
    };
    views.iter().zip(shifts).map(of).collect()
}

/// Removes the part of the shifts that a motion of the object at `center` explains, by least squares.
fn remove_motion(views: &[View], center: Vec3, shifts: &mut [[f64; 2]]) {
    let moved: Vec<[[f64; 2]; 3]> = views.iter().map(|view| motion(view, center)).collect();
    let mut matrix = vec![vec![0.0; 3]; 3];
    let mut right = [0.0; 3];
    for (rows, shift) in moved.iter().zip(shifts.iter()) {
        for (a, k) in (0..6).map(|i| (i / 2, i % 2)) {
            right[a] += rows[a][k] * shift[k];
            (0..3).for_each(|b| matrix[a][b] += rows[a][k] * rows[b][k]);
        }
    }
    let Some(inverse) = inverse(matrix) else { return };
    let by: [f64; 3] = std::array::from_fn(|a| inner(&inverse[a], &right));
    for (rows, shift) in moved.iter().zip(shifts) {
        for k in 0..2 {
            shift[k] -= (0..3).map(|a| rows[a][k] * by[a]).sum::<f64>();
        }
    }
}

/// How the shadow of a point moves along v and u per motion of the point along x, y and z.
fn motion(view: &View, center: Vec3) -> [[f64; 2]; 3] {
    let (normal, depth) = view.normal();
    let shadow = |point: Vec3| {
        let ray = sub(point, view.source);
        let far = depth / dot(ray, normal);
        let hit: Vec3 = std::array::from_fn(|k| view.source[k] + far * ray[k] - view.detector[k]);
        [dot(hit, view.v) / norm(view.v), dot(hit, view.u) / norm(view.u)]
    };
    let step = 1e-3 * depth;
    std::array::from_fn(|axis| {
        let at = |sign: f64| {
            let mut point = center;
            point[axis] += sign * step;
            shadow(point)
        };
        let (a, b) = (at(1.0), at(-1.0));
        std::array::from_fn(|k| (a[k] - b[k]) / (2.0 * step))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::consistency::tests::{Silent, scan};
    use conefield_backend_cpu::Cpu;

    /// Shifts along v and u for each view, mm, without the part that is a motion of the object.
    fn irregular(scan: &Scan, size: f64) -> Vec<[f64; 2]> {
        let wave = |i: usize, rate: f64| size * (rate * i as f64 + (i * i % 7) as f64).sin();
        let mut shifts: Vec<[f64; 2]> = (0..scan.geometry.views.len()).map(|i| [wave(i, 2.3), wave(i, 1.7)]).collect();
        remove_motion(&scan.geometry.views, scan.geometry.volume.center, &mut shifts);
        shifts
    }

    #[test]
    fn shifts_are_found_to_a_fraction_of_a_pixel() {
        let mut scan = scan(40, 0.01);
        let pixel = 2.5;
        let wanted = irregular(&scan, 2.0 * pixel);
        scan.geometry.views = shifted(&scan.geometry.views, &wanted);
        let found = jitter(&scan, 48, &Cpu::new(), &Silent).unwrap();
        assert_eq!(found.verdict, Verdict::Corrected);
        let mut corrected = scan.clone();
        found.correct(&mut corrected);
        let left: f64 =
            found.shifts.iter().zip(&wanted).flat_map(|(f, w)| [f[0] + w[0], f[1] + w[1]]).map(|x| x * x).sum();
        let left = (left / (2 * wanted.len()) as f64).sqrt() / pixel;
        assert!(left < 0.2, "{left} pixels, {found:?}");
        assert!(found.held_out[1] < 0.6 * found.held_out[0], "{:?}", found.held_out);
        assert!(corrected.provenance["jitter"]["rms_pixels"]["u"].as_f64().unwrap() > 0.5);
    }

    #[test]
    fn steady_views_stay() {
        for noise in [0.0, 0.03] {
            let scan = scan(40, noise);
            let found = jitter(&scan, 48, &Cpu::new(), &Silent).unwrap();
            assert_eq!(found.verdict, Verdict::Kept, "{found:?}");
            let mut same = scan.clone();
            found.correct(&mut same);
            assert_eq!(same.geometry, scan.geometry);
        }
    }

    /// A moved object does not count as jitter.
    #[test]
    fn a_motion_of_the_object_is_removed() {
        let scan = scan(20, 0.0);
        let views = &scan.geometry.views;
        let moved = |view: &View| {
            let [x, _, z] = motion(view, [0.0; 3]);
            [0.7 * x[0] - 0.2 * z[0], 0.7 * x[1] - 0.2 * z[1]]
        };
        let mut shifts: Vec<[f64; 2]> = views.iter().map(moved).collect();
        assert!(shifts.iter().any(|s| s[1].abs() > 0.3));
        remove_motion(views, [0.0; 3], &mut shifts);
        assert!(shifts.iter().flatten().all(|s| s.abs() < 1e-9), "{shifts:?}");
    }
}
