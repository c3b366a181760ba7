//! Ray weights: the angular step, and corrections for rays that are measured twice.
//!
//! - A full turn measures every line of the orbit's plane twice: each measurement has weight 1/2.
//! - A short scan measures some lines twice and others once: Parker's weights (Med. Phys. 9(2), 1982), for any arc of
//!   at least π plus the fan angle by widening the fan (Silver, Med. Phys. 27(4), 2000).
//! - A detector shifted sideways measures, over a full turn, the middle twice and the wide side once: Wang's weights
//!   (Med. Phys. 29(7), 2002). Rows are zero-padded on the shorter side: after filtering they are not 0 there, and
//!   voxels on that side need them. A detector wholly on one side measures every line once and none near the axis: each
//!   has weight 1.
//!
//! The views alone determine the kind of orbit.

use conefield_core::geometry::{Geometry, Vec3, View, dot, norm, sub};
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI, TAU};
use std::ops::Range;

/// Kind of orbit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Coverage {
    /// A full turn with a centred detector.
    Full,
    /// A full turn with a detector that reaches further on one side. Both sides see `overlap` mm on the virtual
    /// detector at the axis; `sign` is the side of u that reaches further.
    Offset {
        /// Half width of the part measured twice, mm at the axis; 0 if the detector lies wholly on one side.
        overlap: f64,
        /// 1 if u reaches further, −1 if −u does.
        sign: f64,
    },
    /// An arc of at least π plus the fan angle, from `start`, in the direction of increasing angles.
    Short {
        /// The first angle, rad.
        start: f64,
        /// Parker's half fan angle, widened to the arc: `arc = π + 2·delta`.
        delta: f64,
    },
    /// Less than a short scan, or a partial turn with an offset detector: no weights can replace the missing data.
    Limited,
}

/// A detector offset by more than this share of its width needs a full turn: the opposite rays of its longer side were
/// not measured.
const ASIDE: f64 = 0.1;

/// The orbit of a scan for FDK.
#[derive(Debug, Clone)]
pub struct FdkOrbit {
    /// Kind of orbit.
    pub coverage: Coverage,
    /// The arc covered, rad.
    pub arc: f64,
    /// Fan angle, rad.
    pub fan: f64,
    /// Each view's angle, rad.
    pub angles: Vec<f64>,
    /// Angular step of each view, rad.
    pub steps: Vec<f64>,
    /// Distance from source to axis for each view, along the detector's normal, mm.
    pub radius: Vec<f64>,
    /// How much further an offset detector reaches on one side than on the other, mm at the axis.
    aside: f64,
    /// 1 if u points in the direction in which the source moves at increasing angles, else −1.
    sense: f64,
}

impl FdkOrbit {
    /// Determines the orbit of `geometry` about the axis x = y = 0.
    pub fn of(geometry: &Geometry) -> Self {
        let views = &geometry.views;
        let angles: Vec<f64> = views.iter().map(|v| v.source[1].atan2(v.source[0]).rem_euclid(TAU)).collect();
        let mut order: Vec<usize> = (0..views.len()).collect();
        order.sort_by(|&a, &b| angles[a].total_cmp(&angles[b]));
        let n = order.len();
        // Gap after each view, in angular order.
        let gaps: Vec<f64> = (0..n).map(|i| (angles[order[(i + 1) % n]] - angles[order[i]]).rem_euclid(TAU)).collect();
        let gaps = if n == 1 { vec![TAU] } else { gaps };
        let (widest, gap) = gaps.iter().copied().enumerate().fold((0, 0.0), |a, b| if b.1 > a.1 { b } else { a });
        let rest = (TAU - gap) / (n.max(2) - 1) as f64;
        // A gap much wider than the average of the others marks the end of the arc.
        let full = n < 3 || gap <= 2.5 * rest;
        let mut steps = vec![0.0; n];
        for i in 0..n {
            let (before, after) = ((i + n - 1) % n, i);
            let side = |g: usize| if !full && g == widest { rest } else { gaps[g] };
            steps[order[i]] = 0.5 * (side(before) + side(after));
        }
        let arc = if full { TAU } else { TAU - gap + rest };
        let radius: Vec<f64> = views.iter().map(|v| -dot([v.source[0], v.source[1], 0.0], v.normal().0)).collect();
        let ends: Vec<[f64; 2]> = (0..n).map(|v| edges(geometry, v, radius[v])).collect();
        let low = ends.iter().fold(f64::INFINITY, |m, e| m.min(e[0]));
        let high = ends.iter().fold(f64::NEG_INFINITY, |m, e| m.max(e[1]));
        let mean = radius.iter().sum::<f64>() / n as f64;
        let fan = (low.abs() / mean).atan() + (high.abs() / mean).atan();
        let pitch = norm(views[0].u) * radius[0] / views[0].normal().1;
        let (narrow, wide) = (low.abs().min(high), low.abs().max(high));
        let both = low < 0.0 && high > 0.0;
        let aside = (low + high).abs();
        let coverage = if full && aside > 1.5 * pitch {
            // An edge on the axis itself, up to rounding.
            let overlap = if both && narrow > 1e-6 * pitch { narrow } else { 0.0 };
            Coverage::Offset { overlap, sign: if high > -low { 1.0 } else { -1.0 } }
        } else if full {
            Coverage::Full
        } else if arc >= PI + fan - rest && wide - narrow < ASIDE * (wide + narrow) {
            let first = angles[order[(widest + 1) % n]];
            Coverage::Short { start: first - 0.5 * rest, delta: 0.5 * (arc - PI) }
        } else {
            Coverage::Limited
        };
        let v = &views[0];
        let sense = (v.source[0] * v.u[1] - v.source[1] * v.u[0]).signum();
        Self { coverage, arc, fan, angles, steps, radius, aside, sense }
    }

    /// `geometry` with columns added to the shorter side of an offset detector until both sides are equal, and the
    /// measured columns.
    pub fn symmetric(&self, geometry: &Geometry) -> (Geometry, Range<usize>) {
        let mut wide = geometry.clone();
        let columns = geometry.detector[1];
        let Coverage::Offset { sign, .. } = self.coverage else { return (wide, 0..columns) };
        let v = &geometry.views[0];
        let more = self.aside * v.normal().1 / (norm(v.u) * self.radius[0]);
        let more = (more - 1e-6).ceil() as usize;
        wide.detector[1] += more;
        for v in &mut wide.views {
            // The centre moves towards the added columns.
            v.detector = std::array::from_fn(|k| v.detector[k] - sign * 0.5 * more as f64 * v.u[k]);
        }
        let first = if sign > 0.0 { more } else { 0 };
        (wide, first..first + columns)
    }

    /// The weight of a ray of view `view` at `u` mm from the axis on the virtual detector at the axis.
    pub fn weight(&self, view: usize, u: f64) -> f64 {
        match self.coverage {
            Coverage::Full | Coverage::Limited => 0.5,
            Coverage::Offset { overlap, sign } => {
                let x = u * sign;
                if x <= -overlap {
                    0.0
                } else if x >= overlap {
                    1.0
                } else {
                    let radius = self.radius[view];
                    let ratio = (x / radius).atan() / (overlap / radius).atan();
                    0.5 * ((FRAC_PI_2 * ratio).sin() + 1.0)
                }
            }
            Coverage::Short { start, delta } => {
                // With increasing u a ray turns against the direction of increasing angles.
                let gamma = -self.sense * (u / self.radius[view]).atan();
                parker((self.angles[view] - start).rem_euclid(TAU), gamma, delta)
            }
        }
    }

    /// Description for the log.
    pub fn describe(&self) -> String {
        let degrees = |x: f64| x.to_degrees();
        let arc = format!("{:.1} of 360 degrees, fan {:.1}", degrees(self.arc), degrees(self.fan));
        match self.coverage {
            Coverage::Full => format!("full turn: each ray is measured twice and weighted by one half ({arc})"),
            Coverage::Offset { overlap: 0.0, .. } => {
                format!(
                    "detector wholly on one side of the axis: each ray is measured once, those near the axis are missing ({arc})"
                )
            }
            Coverage::Offset { overlap, .. } => {
                format!("offset detector: Wang's weights over {:.1} mm either side of the axis ({arc})", overlap)
            }
            Coverage::Short { .. } => format!("short scan: Parker's weights ({arc})"),
            Coverage::Limited => {
                let needed = degrees(PI + self.fan);
                format!("no weights can complete it ({arc}; {needed:.1} needed, or 360 with an offset detector)")
            }
        }
    }
}

/// Parker's weight at angle `beta` from the start of an arc of π + 2·delta, for a ray at `gamma` from the central one.
/// The ray (β, γ) is measured again as (β + π + 2γ, −γ), and the two weights add up to 1.
fn parker(beta: f64, gamma: f64, delta: f64) -> f64 {
    let ramp = |x: f64, width: f64| {
        if x >= width {
            1.0
        } else if x <= 0.0 {
            0.0
        } else {
            (FRAC_PI_4 * 2.0 * x / width).sin().powi(2)
        }
    };
    ramp(beta, 2.0 * (delta - gamma)) * ramp(PI + 2.0 * delta - beta, 2.0 * (delta + gamma))
}

/// Edges of the detector of view `view` along u, at the axis' distance, mm from the axis.
fn edges(geometry: &Geometry, view: usize, radius: f64) -> [f64; 2] {
    let columns = geometry.detector[1] as f64;
    [-0.5, columns - 0.5].map(|c| place(geometry, view, c, radius))
}

/// Position of column `column` of view `view`: `radius` times the tangent of the angle between its ray in the orbit's
/// plane and the ray to the axis, mm along increasing u. On a detector that faces the axis this is the position on the
/// virtual detector through the axis.
pub fn place(geometry: &Geometry, view: usize, column: f64, radius: f64) -> f64 {
    let v = &geometry.views[view];
    let [ahead, across] = in_plane(v, ray(geometry, view, column));
    let sense = (v.source[0] * v.u[1] - v.source[1] * v.u[0]).signum();
    radius * sense * across / ahead
}

/// Correction of the weight of column `column` for a detector that does not face the axis. An angular step moves the
/// source across the rays by R·cos γ, with γ measured from the ray to the axis and R the distance to it. The filter's
/// geometry has `radius`·cos of the angle to the detector's normal instead (the change of variables of Kak and Slaney,
/// section 3.4.2, for a normal in another direction). 1 on a detector that faces the axis.
pub fn lean(geometry: &Geometry, view: usize, column: f64, radius: f64) -> f64 {
    let v = &geometry.views[view];
    let (normal, _) = v.normal();
    let [ahead, across] = in_plane(v, normal);
    if across.abs() <= 1e-9 * ahead {
        return 1.0;
    }
    let d = ray(geometry, view, column);
    let to_axis = v.source[0].hypot(v.source[1]) * in_plane(v, d)[0];
    to_axis / (radius * (normal[0] * d[0] + normal[1] * d[1]))
}

/// From the source to the middle row's pixel in column `column`.
fn ray(geometry: &Geometry, view: usize, column: f64) -> Vec3 {
    let v = &geometry.views[view];
    let row = (geometry.detector[0] as f64 - 1.0) / 2.0;
    sub(v.pixel(geometry.detector, row, column), v.source)
}

/// Components of `a` from the source towards the axis, and across it in the direction of increasing angles.
fn in_plane(v: &View, a: Vec3) -> [f64; 2] {
    let radius = v.source[0].hypot(v.source[1]);
    let [c, s] = [v.source[0] / radius, v.source[1] / radius];
    [-(a[0] * c + a[1] * s), a[1] * c - a[0] * s]
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::geometry::{Millimetres, Radians, View, VoxelGrid};

    fn scan(angles: impl Iterator<Item = f64>, offset: f64) -> Geometry {
        let mm = Millimetres;
        let view = |a| View::circular(Radians(a), mm(500.0), mm(750.0), [mm(1.0); 2], [mm(0.0), mm(offset)]);
        Geometry {
            detector: [10, 200],
            views: angles.map(view).collect(),
            volume: VoxelGrid { shape: [10; 3], spacing: [1.0; 3], center: [0.0; 3] },
        }
    }

    #[test]
    fn orbits_are_distinguished() {
        let turn = |n: usize, arc: f64| (0..n).map(move |i| 0.3 + arc * i as f64 / n as f64);
        assert_eq!(FdkOrbit::of(&scan(turn(50, TAU), 0.0)).coverage, Coverage::Full);
        assert_eq!(FdkOrbit::of(&scan(turn(3, TAU), 0.0)).coverage, Coverage::Full);
        assert!(matches!(FdkOrbit::of(&scan(turn(100, 3.6), 0.0)).coverage, Coverage::Short { .. }));
        assert!(matches!(FdkOrbit::of(&scan(turn(100, 3.6), 4.0)).coverage, Coverage::Short { .. }));
        assert_eq!(FdkOrbit::of(&scan(turn(100, 2.9), 0.0)).coverage, Coverage::Limited);
        assert_eq!(FdkOrbit::of(&scan(turn(100, 3.6), 45.0)).coverage, Coverage::Limited);
        let Coverage::Offset { overlap, sign } = FdkOrbit::of(&scan(turn(50, TAU), 45.0)).coverage else {
            panic!("an offset was not seen")
        };
        assert!((overlap - (100.0 - 45.0) / 1.5).abs() < 1e-9 && sign == 1.0);
        // From the axis outwards, and from beyond it: no line is measured twice.
        for offset in [100.0, 120.0, -120.0] {
            let one_sided = scan(turn(50, TAU), offset);
            let orbit = FdkOrbit::of(&one_sided);
            assert_eq!(orbit.coverage, Coverage::Offset { overlap: 0.0, sign: offset.signum() });
            let ends = edges(&one_sided, 0, 500.0);
            for u in [ends[0] + 0.1, 0.5 * (ends[0] + ends[1]), ends[1] - 0.1] {
                assert_eq!(orbit.weight(0, u), 1.0, "offset {offset}, u {u}");
            }
            let (wide, _) = orbit.symmetric(&one_sided);
            let ends = edges(&wide, 0, 500.0);
            assert!((ends[0] + ends[1]).abs() < 1e-9, "{ends:?}");
        }
        assert_eq!(FdkOrbit::of(&scan(turn(50, TAU).map(|a| -a), -45.0)).coverage, {
            Coverage::Offset { overlap, sign: -1.0 }
        });
        // One missing view does not end an orbit.
        let missing = (0..50).filter(|i| *i != 7).map(|i| TAU * i as f64 / 50.0);
        assert_eq!(FdkOrbit::of(&scan(missing, 0.0)).coverage, Coverage::Full);
    }

    #[test]
    fn an_offset_detector_is_widened_where_it_is_short() {
        for offset in [45.0, -45.0] {
            let g = scan((0..9).map(|i| 0.7 * f64::from(i)), offset);
            let (wide, measured) = FdkOrbit::of(&g).symmetric(&g);
            assert_eq!(wide.detector, [10, 290]);
            assert_eq!(measured, if offset > 0.0 { 90..290 } else { 0..200 });
            for (a, b) in g.views.iter().zip(&wide.views) {
                for c in [0, 77] {
                    let (p, q) =
                        (a.pixel(g.detector, 3.0, c as f64), b.pixel(wide.detector, 3.0, (c + measured.start) as f64));
                    assert!(norm(sub(p, q)) < 1e-9, "{p:?} and {q:?}");
                }
            }
            let ends = edges(&wide, 0, 500.0);
            assert!((ends[0] + ends[1]).abs() < 1e-9, "{ends:?}");
        }
        let g = scan((0..9).map(|i| 0.7 * f64::from(i)), 0.0);
        assert_eq!(FdkOrbit::of(&g).symmetric(&g), (g.clone(), 0..200));
    }

    #[test]
    fn steps_add_up_to_the_arc() {
        let uneven = [0.1, 0.2, 0.9, 1.4, 2.0, 2.2, 3.0, 3.9, 4.4, 5.0, 5.6, 6.1];
        let o = FdkOrbit::of(&scan(uneven.into_iter(), 0.0));
        assert!((o.steps.iter().sum::<f64>() - TAU).abs() < 1e-12);
        let o = FdkOrbit::of(&scan((0..40).map(|i| 0.1 * f64::from(i)), 0.0));
        assert!((o.steps.iter().sum::<f64>() - 4.0).abs() < 1e-12 && (o.arc - 4.0).abs() < 1e-12);
    }

    /// The weights of two measurements of one line sum to 1 in every case.
    #[test]
    fn conjugate_rays_count_one() {
        for gamma in [-0.15, -0.04, 0.0, 0.11] {
            let delta = 0.2;
            for i in 0..200 {
                let beta = (PI + 2.0 * delta) * (f64::from(i) + 0.5) / 200.0;
                let other = [beta + PI + 2.0 * gamma, beta - PI + 2.0 * gamma]
                    .into_iter()
                    .find(|b| (0.0..PI + 2.0 * delta).contains(b));
                let sum = parker(beta, gamma, delta) + other.map_or(0.0, |b| parker(b, -gamma, delta));
                assert!((sum - 1.0).abs() < 1e-9, "beta {beta} gamma {gamma}: {sum}");
            }
        }
        let o = FdkOrbit::of(&scan((0..50).map(|i| TAU * f64::from(i) / 50.0), 45.0));
        for u in [-60.0, -30.0, -3.0, 0.0, 12.0, 36.0, 50.0] {
            assert!((o.weight(0, u) + o.weight(0, -u) - 1.0).abs() < 1e-12, "u {u}");
        }
    }
}
