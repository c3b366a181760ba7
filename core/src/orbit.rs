//! Circular orbits of source and detector, described by a few numbers, and the arcs that views cover.

use crate::error::{Result, ensure};
use crate::geometry::{FAR, Millimetres, PARALLEL, Radians, View, VoxelGrid, dot, norm, sub};
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// How the rays of a view run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Beam {
    /// From one source.
    #[default]
    Cone,
    /// In one direction; see [`CircularOrbit::parallel`].
    Parallel,
}

impl Beam {
    /// Whether it is a cone.
    pub fn is_cone(&self) -> bool {
        *self == Self::Cone
    }
}

/// Views on one circle about z, all with the same distances and detector.
#[derive(Debug, Clone, PartialEq)]
pub struct CircularOrbit {
    /// Source to rotation axis, in mm.
    pub dso: f64,
    /// Source to detector plane, in mm.
    pub dsd: f64,
    /// Pixel size along v (rows) and u (columns), in mm.
    pub pixel: [f64; 2],
    /// Shift of the detector along v and u, in mm.
    pub offset: [f64; 2],
    /// Angle of each view in radians.
    pub angles: Vec<f64>,
}

/// Distances from the source to the axis and to the detector, mm. Refuses a missing one, one that is no length, and a
/// detector that is no farther than the axis. Errors name `place` and fields that begin with `prefix`; `or` is valid, too.
pub fn distances(place: &str, prefix: &str, given: [Option<f64>; 2], or: &str) -> Result<[f64; 2]> {
    for (name, x) in ["dso", "dsd"].into_iter().zip(given) {
        let found = x.map_or("nothing".into(), |x| x.to_string());
        let expected = format!("{LENGTH}, or {or}");
        ensure(x.is_some_and(|x| x.is_finite() && x > 0.0), place, &format!("{prefix}{name}"), found, expected)?;
    }
    let found @ [dso, dsd] = given.map(Option::unwrap_or_default);
    let expected = format!("more than the {dso} of dso: the detector lies behind the axis (are they swapped?)");
    ensure(dsd > dso, place, &format!("{prefix}dsd"), dsd, expected)?;
    Ok(found)
}

/// Refuses a pixel, along v and u, that has no size; see [`distances`].
pub fn check_pixel(place: &str, prefix: &str, [v, u]: [f64; 2]) -> Result<()> {
    for (name, x) in [("v", v), ("u", u)] {
        ensure(x.is_finite() && x > 0.0, place, &format!("{prefix}pixel.{name}"), x, LENGTH)?;
    }
    Ok(())
}

const LENGTH: &str = "a positive finite length in mm";

/// Tolerance of a view's deviation from the circle, relative to the source-detector distance.
const TOLERANCE: f64 = 1e-9;

impl CircularOrbit {
    /// A parallel beam of rays from the directions `angles` (radians) through a volume: pixels of `pixel` mm, shifted by
    /// `offset`, both at the axis. Its source is [`FAR`] diagonals of the volume away.
    pub fn parallel(volume: &VoxelGrid, pixel: [f64; 2], offset: [f64; 2], angles: Vec<f64>) -> Self {
        let diagonal = norm(volume.size()) + norm(volume.center);
        let (dso, dsd) = (FAR * diagonal, (FAR + 1.0) * diagonal);
        let [pixel, offset] = [pixel, offset].map(|x| x.map(|x| x * dsd / dso));
        Self { dso, dsd, pixel, offset, angles }
    }

    /// Itself, or the parallel beam through `volume` with its pixels, shift and angles.
    pub fn with_beam(self, beam: Beam, volume: &VoxelGrid) -> Self {
        match beam {
            Beam::Cone => self,
            Beam::Parallel => Self::parallel(volume, self.pixel, self.offset, self.angles),
        }
    }

    /// How its rays run across `volume`.
    pub fn beam(&self, volume: &VoxelGrid) -> Beam {
        if volume.diagonals_to([self.dso, 0.0, 0.0]) > PARALLEL { Beam::Parallel } else { Beam::Cone }
    }

    /// Pixel size and shift of the detector along v and u, projected to the axis, mm.
    pub fn at_axis(&self) -> ([f64; 2], [f64; 2]) {
        let scaled = |x: [f64; 2]| x.map(|x| x * self.dso / self.dsd);
        (scaled(self.pixel), scaled(self.offset))
    }

    /// The view at `angle` (radians).
    pub fn view(&self, angle: f64) -> View {
        let mm = |x: [f64; 2]| x.map(Millimetres);
        let (dso, dsd) = (Millimetres(self.dso), Millimetres(self.dsd));
        View::circular(Radians(angle), dso, dsd, mm(self.pixel), mm(self.offset))
    }

    /// All views.
    pub fn views(&self) -> Vec<View> {
        self.angles.iter().map(|&a| self.view(a)).collect()
    }

    /// The orbit of `views`, or `None` if they do not lie on one circle to a relative 1e-9, and their detectors to at
    /// most 1e-5 of a pixel.
    ///
    /// Angles increase or decrease monotonically, without jumps of more than half a turn.
    pub fn fit(views: &[View]) -> Option<Self> {
        let first = views.first()?;
        let mut angles = Vec::with_capacity(views.len());
        let mut last = 0.0f64;
        for v in views {
            let mut a = v.source[1].atan2(v.source[0]);
            a += ((last - a) / std::f64::consts::TAU).round() * std::f64::consts::TAU;
            angles.push(a);
            last = a;
        }
        let dso = first.source[0].hypot(first.source[1]);
        let (s, c) = angles[0].sin_cos();
        // Along the circle's own axes the first view gives all lengths.
        let reach = sub(first.detector, first.source);
        // Rounding errors do not count as a shift.
        let shift = |x: f64| if x.abs() < 1e-12 * norm(reach) { 0.0 } else { x };
        let orbit = Self {
            dso,
            dsd: -dot(reach, [c, s, 0.0]),
            pixel: [norm(first.v), norm(first.u)],
            offset: [shift(-first.detector[2]), shift(dot(first.detector, [-s, c, 0.0]))],
            angles,
        };
        let scale = dso.abs().max(orbit.dsd.abs());
        let pixel = orbit.pixel[0].max(orbit.pixel[1]);
        // The source of parallel rays is so far away that its share of rounding would hide a pixel's shift.
        let fine = scale.min(1e4 * pixel);
        let near = |a: [f64; 3], b: [f64; 3], scale: f64| norm(sub(a, b)) <= TOLERANCE * scale;
        let fits = dso > 0.0
            && orbit.dsd > 0.0
            && views.iter().zip(&orbit.angles).all(|(v, &a)| {
                let w = orbit.view(a);
                near(v.source, w.source, scale)
                    && near(v.detector, w.detector, fine)
                    && near(v.u, w.u, pixel)
                    && near(v.v, w.v, pixel)
            });
        fits.then_some(orbit)
    }
}

/// Angular positions of views on a circle: the step that each view stands for, and the arcs that the views cover. Whole
/// turns do not count: a second turn makes the first one denser.
#[derive(Debug, Clone, PartialEq)]
pub struct Arcs {
    /// Each view's angle in [0, 2π), rad.
    pub angles: Vec<f64>,
    /// Each view's angular step, rad. Views at one angle share the step equally. The sum is the arc covered.
    pub steps: Vec<f64>,
    /// Views in the order of their angles.
    pub order: Vec<usize>,
    /// Start and length of each arc, rad; empty if no gap interrupts the whole turn.
    pub arcs: Vec<[f64; 2]>,
    /// Views that are no further apart than this are at one angle, rad.
    pub same: f64,
}

/// Gaps end arcs if they exceed the mean of the others by this factor: one gap, and several. The mean is weighted by
/// the width, so that repeated angles do not change it.
const ENDS: [f64; 2] = [2.5, 5.0];
/// Most gaps that end arcs.
const MOST: usize = 8;
/// Views closer than this share of such a mean are at one angle.
const SAME: f64 = 0.1;

impl Arcs {
    /// The arcs of views at `angles` (rad).
    pub fn of(angles: &[f64]) -> Self {
        let angles: Vec<f64> = angles.iter().map(|a| a.rem_euclid(TAU)).collect();
        let mut order: Vec<usize> = (0..angles.len()).collect();
        order.sort_unstable_by(|&a, &b| angles[a].total_cmp(&angles[b]).then(a.cmp(&b)));
        let n = order.len();
        // The gap after each view, in the order of angles.
        let mut gaps: Vec<f64> =
            (0..n).map(|i| (angles[order[(i + 1) % n]] - angles[order[i]]).rem_euclid(TAU)).collect();
        // Views at one angle stand for the whole turn.
        if gaps.iter().all(|g| *g == 0.0)
            && let Some(last) = gaps.last_mut()
        {
            *last = TAU;
        }
        let ends = ends(&gaps);
        let within = |g: &usize| !ends.contains(g);
        let [sum, squares] = (0..n).filter(within).fold([0.0, 0.0], |[s, q], g| [s + gaps[g], q + gaps[g] * gaps[g]]);
        let same = if sum > 0.0 { SAME * squares / sum } else { 0.0 };
        let apart = |g: usize| ends.contains(&g) || gaps[g] > same;
        let rest = sum / (0..n).filter(|g| within(g) && apart(*g)).count().max(1) as f64;
        let side = |g: usize| if ends.contains(&g) { rest } else { gaps[g] };
        let mut steps = vec![0.0; n];
        // Runs of views at one angle, from one that a gap precedes.
        let first = (0..n).find(|&i| apart((i + n - 1) % n)).unwrap_or(0);
        let mut i = 0;
        while i < n {
            let start = (first + i) % n;
            let mut run = 1;
            while i + run < n && !apart((start + run - 1) % n) {
                run += 1;
            }
            let before = side((start + n - 1) % n);
            let inner: f64 = (0..run - 1).map(|k| gaps[(start + k) % n]).sum();
            let step = 0.5 * (before + side((start + run - 1) % n)) + inner;
            (0..run).for_each(|k| steps[order[(start + k) % n]] = step / run as f64);
            i += run;
        }
        let arcs = ends.iter().map(|&end| {
            let start = angles[order[(end + 1) % n]];
            let last = ends.iter().map(|&e| (angles[order[e]] - start).rem_euclid(TAU)).fold(TAU, f64::min);
            [start - 0.5 * rest, last + rest]
        });
        let mut arcs: Vec<[f64; 2]> = arcs.collect();
        arcs.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]));
        Self { angles, steps, order, arcs, same }
    }

    /// Whether the views cover the whole turn.
    pub fn whole(&self) -> bool {
        self.arcs.is_empty()
    }

    /// The angle covered, rad.
    pub fn covered(&self) -> f64 {
        if self.whole() { TAU } else { self.arcs.iter().map(|a| a[1]).sum() }
    }

    /// The view whose angle is nearest to `angle` (rad).
    pub fn nearest(&self, angle: f64) -> usize {
        let angle = angle.rem_euclid(TAU);
        let n = self.order.len();
        let after = self.order.partition_point(|&v| self.angles[v] < angle);
        let far = |v: usize| {
            let d = (self.angles[v] - angle).abs();
            d.min(TAU - d)
        };
        let [a, b] = [self.order[(after + n - 1) % n], self.order[after % n]];
        if far(a) < far(b) { a } else { b }
    }
}

/// Indices of the gaps that end an arc, ascending: as many of the widest as exceed all others clearly.
fn ends(gaps: &[f64]) -> Vec<usize> {
    let mut wide: Vec<usize> = (0..gaps.len()).collect();
    wide.sort_unstable_by(|&a, &b| gaps[b].total_cmp(&gaps[a]).then(a.cmp(&b)));
    let clear = |k: &usize| {
        let [sum, squares] = wide[*k..].iter().fold([0.0, 0.0], |[s, q], &g| [s + gaps[g], q + gaps[g] * gaps[g]]);
        gaps[wide[k - 1]] * sum > ENDS[usize::from(*k > 1)] * squares
    };
    let k = (1..=MOST.min(gaps.len() / 3)).rev().find(clear).unwrap_or(0);
    let mut found = wide[..k].to_vec();
    found.sort_unstable();
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A circle with an offset detector.
    fn circle() -> Vec<View> {
        let mm = Millimetres;
        let view = |i: i32| {
            let angle = Radians(0.3 + f64::from(i) * std::f64::consts::TAU / 7.0);
            View::circular(angle, mm(500.0), mm(800.0), [mm(2.0), mm(1.5)], [mm(-1.0), mm(30.0)])
        };
        (0..7).map(view).collect()
    }

    #[test]
    fn an_orbit_is_found_again() {
        let views = circle();
        let o = CircularOrbit::fit(&views).unwrap();
        assert!((o.dso - 500.0).abs() < 1e-9 && (o.dsd - 800.0).abs() < 1e-9, "{o:?}");
        assert!((o.offset[0] + 1.0).abs() < 1e-9 && (o.offset[1] - 30.0).abs() < 1e-9, "{o:?}");
        for (i, a) in o.angles.iter().enumerate() {
            assert!((a - 0.3 - i as f64 * std::f64::consts::TAU / 7.0).abs() < 1e-12, "{o:?}");
        }
    }

    #[test]
    fn a_view_off_the_circle_is_no_orbit() {
        for change in [0usize, 1, 2, 3] {
            let mut views = circle();
            let v = &mut views[4];
            [&mut v.source, &mut v.detector, &mut v.u, &mut v.v][change][2] += 1e-4;
            assert_eq!(CircularOrbit::fit(&views), None);
        }
        // Columns in the opposite direction do not give such an orbit either.
        let mut views = circle();
        views.iter_mut().for_each(|v| v.u = v.u.map(|x| -x));
        assert_eq!(CircularOrbit::fit(&views), None);
        assert_eq!(CircularOrbit::fit(&[]), None);
    }

    /// Its source is far away, but part of a pixel is a shift for the detector.
    #[test]
    fn a_parallel_beam_with_a_shifted_detector_is_no_orbit() {
        let volume = VoxelGrid { shape: [512; 3], spacing: [1.0; 3], center: [0.0; 3] };
        let (mm, none) = (Millimetres, [Millimetres(0.0); 2]);
        let view = |i: i32| View::circular(Radians(0.3 + f64::from(i)), mm(500.0), mm(800.0), [mm(1.0); 2], none);
        let mut views: Vec<View> = (0..5).map(view).map(|v| v.parallel(v.normal().0, &volume)).collect();
        assert!(CircularOrbit::fit(&views).is_some());
        views[2].source[2] += 0.05;
        views[2].detector[2] += 0.05;
        assert_eq!(CircularOrbit::fit(&views), None);
    }

    /// Angles of `n` views from `start` over `arc` degrees.
    fn degrees(start: f64, arc: f64, n: usize) -> Vec<f64> {
        (0..n).map(|i| (start + arc * i as f64 / n as f64).to_radians()).collect()
    }

    fn found(angles: &[f64]) -> (Vec<[f64; 2]>, f64) {
        let a = Arcs::of(angles);
        assert!((a.steps.iter().sum::<f64>() - a.covered()).abs() < 1e-9, "{a:?}");
        (a.arcs.iter().map(|a| a.map(f64::to_degrees)).collect(), a.covered().to_degrees())
    }

    #[test]
    fn arcs_are_found_with_gaps_turns_and_repeated_angles() {
        let near = |found: (Vec<[f64; 2]>, f64), want: &[[f64; 2]]| {
            assert_eq!(found.0.len(), want.len(), "{found:?}");
            for (a, b) in found.0.iter().zip(want) {
                assert!((0..2).all(|k| (a[k] - b[k]).abs() < 1e-6), "{found:?}");
            }
        };
        near(found(&degrees(20.0, 360.0, 90)), &[]);
        near(found(&degrees(20.0, -360.0, 3)), &[]);
        // One view, and views at one angle.
        near(found(&[1.0]), &[]);
        near(found(&[1.0; 3]), &[]);
        near(found(&degrees(10.0, 200.0, 200)), &[[9.5, 200.0]]);
        let two = [degrees(0.0, 60.0, 60), degrees(180.0, 100.0, 100)].concat();
        near(found(&two), &[[-0.5, 60.0], [179.5, 100.0]]);
        // Four turns, exact and jittered, and both ends of one turn.
        near(found(&degrees(0.0, 1440.0, 720)), &[]);
        let jitter: Vec<f64> =
            degrees(0.0, 1440.0, 720).iter().enumerate().map(|(i, a)| a + 1e-4 * (i % 7) as f64).collect();
        near(found(&jitter), &[]);
        near(found(&degrees(0.0, 361.0, 361)), &[]);
        let over = Arcs::of(&degrees(0.0, 400.0, 400));
        assert!(over.whole() && (over.steps[0] / over.steps[100] - 0.5).abs() < 1e-9, "{over:?}");
        // One missing view does not end an arc; many do.
        let without = |k: usize| degrees(0.0, 360.0, 90).into_iter().skip(k).collect::<Vec<_>>();
        near(found(&without(1)), &[]);
        assert_eq!(found(&without(10)).0.len(), 1);
        assert_eq!(Arcs::of(&degrees(0.0, 200.0, 200)).nearest(-0.3), 0);
        assert_eq!(Arcs::of(&degrees(0.0, 360.0, 90)).nearest(359.0f64.to_radians()), 0);
        assert_eq!(Arcs::of(&[1.0]).steps, [TAU]);
    }
}
