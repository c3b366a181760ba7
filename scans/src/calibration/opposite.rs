//! Rays that two views measure from both sides. They do not depend on a reconstruction, so they show whether a shift that
//! predicts held-out views better belongs to the geometry, or to an object that the views do not determine.
//!
//! Two views of a circular scan share the ray through both sources. On a full turn every view shares one with each view
//! nearly opposite to it; on an arc below 180 degrees no two views do, and a half-fan scan has such rays near the axis
//! only.

use crate::calibration::parameters::{Correction, Parameter};
use conefield_core::geometry::{Geometry, View, dot, sub};
use conefield_core::parallel;
use conefield_core::scan::Scan;
use ndarray::ArrayView2;

/// Fewest shared rays that say something.
const FEWEST: usize = 16;
/// Step of differences, in pixels.
const STEP: f64 = 0.5;

/// The views and the pairs of them that may share a ray.
pub(crate) struct Opposite {
    scan: Scan,
    pairs: Vec<[usize; 2]>,
}

/// What shared rays say of a parameter.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Opinion {
    /// The change that they prefer, from the corrected value, as in a [`Correction`].
    pub change: f64,
    /// Its standard deviation.
    pub deviation: f64,
    /// Whether they agree better with the corrected value than with the original one, by more than chance.
    pub better: bool,
}

impl Opposite {
    /// The pairs of views of `scan`, whose sources are on a circle.
    pub fn of(scan: Scan) -> Self {
        let views = &scan.geometry.views;
        let n = views.len();
        let both = |a: usize, b: usize| near(&scan.geometry, a, b) && near(&scan.geometry, b, a);
        let pairs = parallel::map(0..n, |_, a| (a + 1..n).filter(|b| both(a, *b)).map(|b| [a, b]).collect::<Vec<_>>());
        let pairs = pairs.concat();
        Self { scan, pairs }
    }

    /// The differences of the pairs' values at the shared ray in the corrected geometry; `None` where a detector does not
    /// reach it.
    fn differences(&self, correction: &Correction) -> Vec<Option<f64>> {
        let views = correction.views(&self.scan.geometry.views);
        let value = |a: usize, b: usize| self.value(a, &views[a], &views[b]);
        parallel::map(&self.pairs, |_, &[a, b]| Some(value(a, b)? - value(b, a)?))
    }

    /// The measured value of `view` (number `i`) on its ray through the source of `other`, interpolated.
    fn value(&self, i: usize, view: &View, other: &View) -> Option<f64> {
        let [row, column] = met(self.scan.geometry.detector, view, other)?;
        let image: ArrayView2<'_, f32> = self.scan.view(i);
        let (rows, columns) = image.dim();
        if !(column >= 0.0 && column <= columns as f64 - 1.0 && row >= -0.5 && row <= rows as f64 - 0.5) {
            return None;
        }
        let row = row.clamp(0.0, rows as f64 - 1.0);
        let [(r, y), (c, x)] = [row, column].map(|at| (at as usize, at - at.floor()));
        let [below, beside] = [(r + 1).min(rows - 1), (c + 1).min(columns - 1)];
        let at = |r: usize, c: usize| f64::from(image[[r, c]]);
        Some(
            (1.0 - y) * ((1.0 - x) * at(r, c) + x * at(r, beside))
                + y * ((1.0 - x) * at(below, c) + x * at(below, beside)),
        )
    }

    /// Whether the views share enough rays to determine a shift along u.
    pub fn enough(&self) -> bool {
        self.differences(&Correction::default()).iter().flatten().count() >= FEWEST
    }

    /// What the shared rays say of `parameter` in `correction`; `None` if there are too few, or none depends on it.
    pub fn opinion(&self, correction: &Correction, parameter: Parameter) -> Option<Opinion> {
        let pixel = parameter.pixel(&self.scan.geometry);
        let at = correction.get(parameter);
        let moved = |by: f64| self.differences(&correction.with(parameter, at + by * pixel));
        let [here, up, down] = [0.0, STEP, -STEP].map(moved);
        let none = self.differences(&correction.with(parameter, 0.0));
        // A step of Gauss-Newton, with the contributions of each view for its scatter.
        let views = self.scan.geometry.views.len();
        let (mut steep, mut count) = (0.0, 0usize);
        let mut all = vec![];
        for (p, pair) in self.pairs.iter().enumerate() {
            let (Some(r), Some(u), Some(d), Some(n)) = (here[p], up[p], down[p], none[p]) else { continue };
            let slope = (u - d) / (2.0 * STEP);
            steep += slope * slope;
            count += 1;
            all.push((pair, r, slope, n));
        }
        if count < FEWEST || steep <= 0.0 {
            return None;
        }
        let change = -all.iter().map(|(_, r, slope, _)| r * slope).sum::<f64>() / steep;
        let (mut scores, mut gains) = (vec![0.0; views], vec![0.0; views]);
        for (pair, r, slope, n) in all {
            for &v in pair {
                scores[v] += slope * (r + change * slope);
                gains[v] += n * n - r * r;
            }
        }
        // Every pair belongs to two views, so a view's part counts half.
        let scatter = |x: &[f64]| {
            let mean = x.iter().sum::<f64>() / x.len() as f64;
            x.iter().map(|x| (x - mean).powi(2)).sum::<f64>().sqrt() / 2f64.sqrt()
        };
        let gain = gains.iter().sum::<f64>() / 2.0;
        let deviation = scatter(&scores) / steep;
        Some(Opinion {
            change: change * pixel,
            deviation: deviation * pixel,
            better: gain > crate::calibration::CLEAR * scatter(&gains),
        })
    }
}

/// Row and column at which the ray of `view` through the source of `other` meets its detector.
fn met(detector: [usize; 2], view: &View, other: &View) -> Option<[f64; 2]> {
    let (normal, depth) = view.normal();
    let to = sub(other.source, view.source);
    let along = dot(normal, to);
    if along <= 0.0 {
        return None;
    }
    let on: [f64; 3] = std::array::from_fn(|k| view.source[k] + depth / along * to[k] - view.detector[k]);
    let place = |axis: [f64; 3], n: usize| dot(on, axis) / dot(axis, axis) + (n as f64 - 1.0) / 2.0;
    Some([place(view.v, detector[0]), place(view.u, detector[1])])
}

/// Whether view `a` meets the source of view `b` within a detector of twice the width: shifts do not leave it.
fn near(g: &Geometry, a: usize, b: usize) -> bool {
    let columns = g.detector[1] as f64;
    met(g.detector, &g.views[a], &g.views[b]).is_some_and(|[_, c]| (-0.5 * columns..1.5 * columns).contains(&c))
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::geometry::{Millimetres, Radians, VoxelGrid};
    use conefield_projectors::simulate::{Ellipsoid, scan_ellipsoids};

    /// A scan over `arc` degrees whose detector is shifted by `shift` mm and said to be at `said`.
    fn scan(arc: f64, shift: f64, said: f64) -> Scan {
        let body = |center, axes, value| Ellipsoid { center, axes, value };
        let bodies = [
            body([2.0, -3.0, 0.0], [20.0, 15.0, 18.0], 0.02),
            body([-9.0, 4.0, 1.0], [4.0, 5.0, 6.0], 0.02),
            body([8.0, 6.0, -2.0], [3.0, 3.0, 5.0], -0.015),
        ];
        let mm = Millimetres;
        let views = |x: f64| {
            let angle = |i: usize| Radians(0.2 + (arc * i as f64 / 60.0).to_radians());
            (0..60).map(|i| View::circular(angle(i), mm(100.0), mm(150.0), [mm(1.5); 2], [mm(0.0), mm(x)])).collect()
        };
        let volume = VoxelGrid { shape: [40; 3], spacing: [1.2; 3], center: [0.0; 3] };
        let mut scan = scan_ellipsoids(&bodies, Geometry { detector: [24, 56], views: views(shift), volume });
        scan.geometry.views = views(said);
        scan
    }

    #[test]
    fn shared_rays_find_a_shift_without_a_reconstruction() {
        for (shift, said) in [(0.0, 0.0), (1.2, 0.0), (-0.5, 0.3), (18.0, 18.0), (18.0, 17.0)] {
            let opposite = Opposite::of(scan(360.0, shift, said));
            assert!(opposite.enough());
            let (u, truth) = (Parameter::OffsetU, shift - said);
            let opinion = |change: f64| opposite.opinion(&Correction::default().with(u, change), u).unwrap();
            let [none, right, wrong] = [0.0, truth, truth - 3.0].map(opinion);
            assert!((none.change - truth).abs() < 3.0 * none.deviation + 0.1, "{shift}, {said}: {none:?}");
            assert!(right.change.abs() < 3.0 * right.deviation + 0.03, "{shift}, {said}: {right:?}");
            assert_eq!(right.better, truth != 0.0, "{shift}, {said}: {right:?}");
            assert!(!wrong.better, "{shift}, {said}: {wrong:?}");
        }
    }

    #[test]
    fn arcs_below_half_a_turn_share_no_rays() {
        for arc in [30.0, 90.0, 140.0] {
            assert!(!Opposite::of(scan(arc, 0.0, 0.0)).enough(), "{arc}");
        }
        assert!(!Opposite::of(scan(360.0, 60.0, 60.0)).enough(), "a detector beside the axis");
    }
}
