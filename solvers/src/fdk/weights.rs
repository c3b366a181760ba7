//! Ray weights: the angular step, and shares of rays that are measured more than once.
//!
//! The ray at angle γ from the central one of a source at angle β is measured again from β + π − 2γ at −γ. FDK needs the
//! weights of all measurements of a ray to add up to 1, and to vary smoothly along detector rows. A measurement gets
//! its share of `Σ c`, in which `c(β, γ)` falls smoothly to 0 where the arc of views ends (Noo et al., Phys. Med. Biol.
//! 47(14), 2002) and, on a detector that reaches further on one side, along its short side (Wang, Med. Phys. 29(7),
//! 2002). This covers full turns (each ray is measured twice: 1/2), short scans, offset detectors, several turns and
//! arcs, gaps, and detectors that move between two arcs: views whose detectors lie elsewhere form groups with angular
//! steps of their own. A ray that is measured once has weight 1, wherever it is; one that no view measures is missing,
//! which [`FdkOrbit::missing`] counts.
//!
//! Rows are zero-padded on the shorter side of an offset detector: after filtering they are not 0 there, and voxels on
//! that side need them.

use conefield_core::geometry::{Geometry, Vec3, View, dot, norm, sub};
use conefield_core::orbit::Arcs;
use std::f64::consts::{FRAC_PI_4, PI};
use std::ops::Range;

/// Detectors whose middles are further apart than this share of their width form groups.
const APART: f64 = 0.1;
/// Most groups; more positions are one moving detector.
const GROUPS: usize = 8;
/// Least and most width, in radians, over which the weight falls towards the ends of an arc.
const FALL: [f64; 2] = [0.1, 0.6];
/// Directions of the source, and rays of each through the object, at which missing rays are counted.
const DIRECTIONS: usize = 240;
const RAYS: usize = 25;

/// The orbit of a scan for FDK.
#[derive(Debug, Clone)]
pub struct FdkOrbit {
    /// Angular step of each view, rad.
    pub steps: Vec<f64>,
    /// Distance from source to axis for each view, along the detector's normal, mm.
    pub radius: Vec<f64>,
    angles: Vec<f64>,
    /// Views with their detectors at about one place.
    groups: Vec<Group>,
    /// The group of each view.
    group: Vec<usize>,
    /// Each view's edges, as angles from the central ray towards increasing angles of the source, ascending, rad.
    edges: Vec<[f64; 2]>,
    /// Half the angle of a pixel at the axis, rad.
    half_pixel: f64,
    /// Sense of the columns of each view: 1 if u points towards increasing angles, else −1.
    sense: Vec<f64>,
    /// Whether every view's detector reaches equally far on both sides.
    centred: bool,
    /// Columns that the shorter sides lack, before the first and after the last.
    more: [usize; 2],
    /// Mean height of the sources, mm.
    plane: f64,
}

#[derive(Debug, Clone)]
struct Group {
    views: Vec<usize>,
    arcs: Arcs,
}

impl Group {
    /// How far `angle` lies within an arc, from 0 at its ends to 1.
    fn within(&self, angle: f64) -> f64 {
        if self.arcs.whole() {
            return 1.0;
        }
        let each = self.arcs.arcs.iter().map(|[start, length]| {
            let fall = (length - PI).clamp(FALL[0], FALL[1]).min(0.5 * length);
            let x = (angle - start).rem_euclid(2.0 * PI);
            rise(x.min(length - x) / fall)
        });
        each.fold(0.0, f64::max)
    }
}

/// A disc around the object in the plane of the orbit: centre and radius, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Disc {
    /// Centre.
    pub center: [f64; 2],
    /// Radius.
    pub radius: f64,
}

impl FdkOrbit {
    /// Determines the orbit of `geometry` about the axis x = y = 0.
    pub fn of(geometry: &Geometry) -> Self {
        let views = &geometry.views;
        let angles: Vec<f64> = views.iter().map(|v| v.source[1].atan2(v.source[0])).collect();
        let radius: Vec<f64> = views.iter().map(|v| -dot([v.source[0], v.source[1], 0.0], v.normal().0)).collect();
        let sense: Vec<f64> = views.iter().map(sense).collect();
        let angle = |v: usize, c: f64| (sense[v] * place(geometry, v, c, radius[v]) / radius[v]).atan();
        let last = geometry.detector[1] as f64 - 0.5;
        let edges: Vec<[f64; 2]> = (0..views.len())
            .map(|v| {
                let [a, b] = [angle(v, -0.5), angle(v, last)];
                [a.min(b), a.max(b)]
            })
            .collect();
        let half_pixel = 0.5 * norm(views[0].u) / views[0].normal().1;
        let groups: Vec<Group> = positions(&edges)
            .into_iter()
            .map(|views| {
                let arcs = Arcs::of(&views.iter().map(|&v| angles[v]).collect::<Vec<_>>());
                Group { views, arcs }
            })
            .collect();
        let (mut steps, mut group) = (vec![0.0; views.len()], vec![0; views.len()]);
        for (k, g) in groups.iter().enumerate() {
            for (&v, step) in g.views.iter().zip(&g.arcs.steps) {
                (steps[v], group[v]) = (*step, k);
            }
        }
        let centred = edges.iter().all(|e| equal(*e, half_pixel));
        let plane = views.iter().map(|v| v.source[2]).sum::<f64>() / views.len() as f64;
        let mut orbit =
            Self { steps, radius, angles, groups, group, edges, half_pixel, sense, centred, more: [0; 2], plane };
        if !centred {
            orbit.more = orbit.short_of(geometry);
        }
        orbit
    }

    /// Columns to add before the first and after the last until both sides of every view reach equally far.
    fn short_of(&self, geometry: &Geometry) -> [usize; 2] {
        let most = self.reach().fold(0.0, |m, r| f64::max(m, r[1]));
        let mut more = [0.0f64; 2];
        for (v, view) in geometry.views.iter().enumerate() {
            let pitch = norm(view.u) * self.radius[v] / view.normal().1;
            let ends = [-0.5, geometry.detector[1] as f64 - 0.5].map(|c| place(geometry, v, c, self.radius[v]));
            more = [more[0].max((most + ends[0]) / pitch), more[1].max((most - ends[1]) / pitch)];
        }
        more.map(|m| (m - 1e-6).ceil() as usize)
    }

    /// Height of a point of the upright frame above the middle of the sources, mm.
    pub fn height(&self, point: Vec3) -> f64 {
        point[2] - self.plane
    }

    /// Whether each ray is measured twice: a full turn with a centred detector.
    pub fn twice(&self) -> bool {
        self.groups.len() == 1 && self.groups[0].arcs.whole() && self.centred
    }

    /// How far each view reaches at the axis, mm: on its shorter side (negative: it does not reach the axis) and on the
    /// longer one.
    fn reach(&self) -> impl Iterator<Item = [f64; 2]> + '_ {
        self.edges.iter().zip(&self.radius).map(|([low, high], r)| {
            let [a, b] = [-low, *high].map(|g| r * g.tan());
            [a.min(b), a.max(b)]
        })
    }

    /// `geometry` with columns added to the short sides of detectors until both sides of every view reach equally far,
    /// and the measured columns.
    pub fn symmetric(&self, geometry: &Geometry) -> (Geometry, Range<usize>) {
        let mut wide = geometry.clone();
        let (columns, more) = (geometry.detector[1], self.more);
        wide.detector[1] += more[0] + more[1];
        let shift = 0.5 * (more[1] as f64 - more[0] as f64);
        for v in &mut wide.views {
            // The centre moves towards the added columns.
            v.detector = std::array::from_fn(|k| v.detector[k] + shift * v.u[k]);
        }
        (wide, more[0]..more[0] + columns)
    }

    /// The share of the ray of view `view` at `u` mm from the axis on the virtual detector at the axis.
    pub fn weight(&self, view: usize, u: f64) -> f64 {
        if self.twice() {
            return 0.5;
        }
        let (beta, gamma) = (self.angles[view], self.sense[view] * (u / self.radius[view]).atan());
        let own = self.groups[self.group[view]].within(beta) * self.on_detector(view, gamma);
        if own == 0.0 {
            return 0.0;
        }
        let others = (0..self.groups.len()).filter(|k| *k != self.group[view]);
        let beside: f64 = others.map(|k| self.measured(k, beta, gamma)).sum();
        own / (own + beside + self.again(beta, gamma))
    }

    /// `c` of all measurements from the other side of the ray at `gamma` from `beta`.
    fn again(&self, beta: f64, gamma: f64) -> f64 {
        (0..self.groups.len()).map(|k| self.measured(k, beta + PI - 2.0 * gamma, -gamma)).sum()
    }

    /// `c` of the measurement of a group of views at `gamma` from `beta`.
    fn measured(&self, group: usize, beta: f64, gamma: f64) -> f64 {
        let g = &self.groups[group];
        match g.within(beta) {
            0.0 => 0.0,
            c => c * self.on_detector(g.views[g.arcs.nearest(beta)], gamma),
        }
    }

    /// How far `gamma` lies on the detector of `view`: 0 outside; falls towards a short side.
    fn on_detector(&self, view: usize, gamma: f64) -> f64 {
        let [low, high] = self.edges[view];
        if gamma < low - self.half_pixel || gamma > high + self.half_pixel {
            return 0.0;
        }
        let overlap = high.min(-low);
        if equal([low, high], self.half_pixel) || overlap <= 2e-6 * self.half_pixel {
            return 1.0;
        }
        let x = if high > -low { gamma } else { -gamma };
        rise(0.5 * (x / overlap + 1.0))
    }

    /// The disc around an object whose shadow in each of some views lies between two places on the virtual detector at
    /// the axis, mm. `None` without views.
    pub fn disc(&self, shadows: &[(usize, [f64; 2])]) -> Option<Disc> {
        let source = |v: usize| -> [f64; 2] {
            let (sin, cos) = self.angles[v].sin_cos();
            [self.radius[v] * cos, self.radius[v] * sin]
        };
        // The normal of the ray at `gamma`, and its distance from the axis.
        let line = |v: usize, gamma: f64| {
            let (sin, cos) = (self.angles[v] - gamma).sin_cos();
            let n = [-sin, cos];
            let s = source(v);
            (n, n[0] * s[0] + n[1] * s[1])
        };
        let ends = |&(v, places): &(usize, [f64; 2])| (v, places.map(|u| self.sense[v] * (u / self.radius[v]).atan()));
        let all: Vec<(usize, [f64; 2])> = shadows.iter().map(ends).collect();
        // The point nearest to all middle rays, held near the axis where they hardly differ in direction.
        let (mut a, mut b) = ([[1e-3 * all.len() as f64, 0.0], [0.0, 1e-3 * all.len() as f64]], [0.0; 2]);
        for (v, [low, high]) in &all {
            let (n, t) = line(*v, 0.5 * (low + high));
            for i in 0..2 {
                b[i] += n[i] * t;
                (0..2).for_each(|j| a[i][j] += n[i] * n[j]);
            }
        }
        let det = a[0][0] * a[1][1] - a[0][1] * a[1][0];
        let center = [(a[1][1] * b[0] - a[0][1] * b[1]) / det, (a[0][0] * b[1] - a[1][0] * b[0]) / det];
        let distance = |v: usize, gamma: f64| {
            let (n, t) = line(v, gamma);
            (n[0] * center[0] + n[1] * center[1] - t).abs()
        };
        let radius = all.iter().flat_map(|(v, e)| e.map(|g| distance(*v, g))).fold(f64::NEG_INFINITY, f64::max);
        (radius.is_finite() && center.iter().all(|x| x.is_finite())).then_some(Disc { center, radius })
    }

    /// The share of the rays through `object` that no view measures.
    pub fn missing(&self, object: Disc) -> f64 {
        let radius = self.radius.iter().sum::<f64>() / self.radius.len() as f64;
        let (mut all, mut missing) = (0usize, 0usize);
        for i in 0..DIRECTIONS {
            let beta = 2.0 * PI * (i as f64 + 0.5) / DIRECTIONS as f64;
            let (sin, cos) = beta.sin_cos();
            let to = [object.center[0] - radius * cos, object.center[1] - radius * sin];
            let ahead = -(to[0] * cos + to[1] * sin);
            let middle = (to[1] * cos - to[0] * sin).atan2(ahead);
            let half = (object.radius / to[0].hypot(to[1])).min(1.0).asin();
            for k in 0..RAYS {
                let gamma = middle + half * 0.98 * (2.0 * k as f64 / (RAYS - 1) as f64 - 1.0);
                let direct: f64 = (0..self.groups.len()).map(|k| self.measured(k, beta, gamma)).sum();
                all += 1;
                missing += usize::from(direct + self.again(beta, gamma) == 0.0);
            }
        }
        missing as f64 / all as f64
    }

    /// Description for the log.
    pub fn describe(&self) -> String {
        let fan = self.edges.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |f, e| [f[0].min(e[0]), f[1].max(e[1])]);
        let covered = self.groups.iter().map(|g| g.arcs.covered().to_degrees());
        let covered: Vec<String> = covered.map(|c| format!("{c:.1}")).collect();
        let arc = format!("{} of 360 degrees, fan {:.1}", covered.join(" and "), (fan[1] - fan[0]).to_degrees());
        let share = "rays that are measured more than once share their weight";
        let first = &self.groups[0].arcs;
        if self.groups.len() > 1 {
            return format!("detector at {} places: {share} ({arc})", self.groups.len());
        }
        if self.twice() {
            return format!("full turn: each ray is measured twice and weighted by one half ({arc})");
        }
        if !first.whole() {
            return match first.arcs.len() {
                1 if first.covered() < PI - 1e-9 => format!("limited arc: {share} ({arc})"),
                1 => format!("short scan: {share} ({arc})"),
                n => format!("{n} arcs: {share} ({arc})"),
            };
        }
        let overlap = self.reach().fold(f64::INFINITY, |m, r| m.min(r[0]));
        if overlap <= 0.0 {
            return format!(
                "detector wholly on one side of the axis: each ray is measured once, those near the axis are missing ({arc})"
            );
        }
        format!("offset detector: {share}, over {overlap:.1} mm either side of the axis ({arc})")
    }
}

/// Whether edges are equally far from the central ray, up to one and a half pixels.
fn equal([low, high]: [f64; 2], half_pixel: f64) -> bool {
    (low + high).abs() <= 3.0 * half_pixel
}

/// From 0 at 0 to 1 at 1, flat at both ends.
fn rise(x: f64) -> f64 {
    (FRAC_PI_4 * 2.0 * x.clamp(0.0, 1.0)).sin().powi(2)
}

/// Views by the place of their detectors: `edges` in rad.
fn positions(edges: &[[f64; 2]]) -> Vec<Vec<usize>> {
    let middle = |v: usize| 0.5 * (edges[v][0] + edges[v][1]);
    let width = edges.iter().map(|e| e[1] - e[0]).fold(0.0, f64::max);
    let mut order: Vec<usize> = (0..edges.len()).collect();
    order.sort_unstable_by(|&a, &b| middle(a).total_cmp(&middle(b)));
    let mut groups: Vec<Vec<usize>> = vec![];
    let mut last = f64::NEG_INFINITY;
    for v in order {
        match groups.last_mut() {
            Some(group) if middle(v) - last <= APART * width => group.push(v),
            _ => groups.push(vec![v]),
        }
        last = middle(v);
    }
    if groups.len() > GROUPS {
        return vec![(0..edges.len()).collect()];
    }
    groups.iter_mut().for_each(|g| g.sort_unstable());
    groups
}

/// 1 if u points in the direction in which the source moves at increasing angles, else −1.
fn sense(v: &View) -> f64 {
    (v.source[0] * v.u[1] - v.source[1] * v.u[0]).signum()
}

/// Position of column `column` of view `view`: `radius` times the tangent of the angle between its ray in the orbit's
/// plane and the ray to the axis, mm along increasing u. On a detector that faces the axis this is the position on the
/// virtual detector through the axis.
pub fn place(geometry: &Geometry, view: usize, column: f64, radius: f64) -> f64 {
    let v = &geometry.views[view];
    let [ahead, across] = in_plane(v, ray(geometry, view, column));
    radius * sense(v) * across / ahead
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
    use std::f64::consts::TAU;

    fn scan(angles: impl Iterator<Item = f64>, offset: f64) -> Geometry {
        moving(angles.map(|a| (a, offset)))
    }

    fn moving(views: impl Iterator<Item = (f64, f64)>) -> Geometry {
        let mm = Millimetres;
        let view = |(a, x)| View::circular(Radians(a), mm(500.0), mm(750.0), [mm(1.0); 2], [mm(0.0), mm(x)]);
        Geometry {
            detector: [10, 200],
            views: views.map(view).collect(),
            volume: VoxelGrid { shape: [10; 3], spacing: [1.0; 3], center: [0.0; 3] },
        }
    }

    fn turn(n: usize, arc: f64) -> impl Iterator<Item = f64> {
        (0..n).map(move |i| 0.3 + arc * i as f64 / n as f64)
    }

    /// A disc about the axis.
    fn disc(radius: f64) -> Disc {
        Disc { center: [0.0; 2], radius }
    }

    #[test]
    fn orbits_are_distinguished() {
        // The detector reaches 66.7 mm on either side: asin(66.7/500) is 7.66 degrees.
        let of = |n, arc, offset| FdkOrbit::of(&scan(turn(n, arc), offset));
        for (orbit, said, whole, narrow) in [
            (of(50, TAU, 0.0), "full turn", true, true),
            (of(3, TAU, 0.0), "full turn", true, true),
            (of(100, 3.6, 0.0), "short scan", true, true),
            (of(100, 3.6, 4.0), "short scan", true, true),
            // Enough for a narrow object only.
            (of(100, 3.3, 0.0), "short scan", false, true),
            (of(100, 2.9, 0.0), "limited arc", false, false),
            (of(100, 3.6, 45.0), "short scan", false, true),
            (of(50, TAU, 45.0), "offset detector", true, true),
            (of(50, TAU, 120.0), "wholly on one side", false, false),
            (of(800, 4.0 * TAU, 0.0), "full turn", true, true),
        ] {
            assert!(orbit.describe().contains(said), "{}", orbit.describe());
            let [a, b] = [60.0, 30.0].map(|r| orbit.missing(disc(r)));
            assert_eq!([a == 0.0, b == 0.0], [whole, narrow], "{said}: {a} and {b}");
        }
        // One missing view does not end an orbit.
        let missing = (0..50).filter(|i| *i != 7).map(|i| TAU * i as f64 / 50.0);
        assert!(FdkOrbit::of(&scan(missing, 0.0)).twice());
    }

    /// A detector that moves to the other side for a second turn measures what one that is twice as wide measures.
    /// If it moves between two halves of one turn, half of the outer rays are missing.
    #[test]
    fn detectors_that_move_form_groups() {
        let both = moving(turn(90, TAU).map(|a| (a, 45.0)).chain(turn(90, TAU).map(|a| (a, -45.0))));
        let orbit = FdkOrbit::of(&both);
        assert!(orbit.describe().contains("2 places"), "{}", orbit.describe());
        assert_eq!((orbit.missing(disc(95.0)), orbit.groups.len()), (0.0, 2));
        for u in [-80.0, -30.0, 0.0, 20.0, 36.0, 90.0] {
            // The four measurements: both detectors, from both sides.
            let sum: f64 = [(0, u), (0, -u), (90, u), (90, -u)].iter().map(|&(v, u)| orbit.weight(v, u)).sum();
            assert!((sum - 1.0).abs() < 1e-6, "u {u}: {sum}");
        }
        let (wide, measured) = orbit.symmetric(&both);
        assert_eq!((wide.detector[1], measured), (380, 90..290));
        let halves = moving(turn(90, TAU).enumerate().map(|(i, a)| (a, if i < 45 { 45.0 } else { -45.0 })));
        assert!(FdkOrbit::of(&halves).missing(disc(90.0)) > 0.05);
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
            assert!(FdkOrbit::of(&wide).centred);
        }
        let g = scan((0..9).map(|i| 0.7 * f64::from(i)), 0.0);
        assert_eq!(FdkOrbit::of(&g).symmetric(&g), (g.clone(), 0..200));
    }

    /// The weights of all measurements of one ray add up to 1, for every kind of orbit.
    #[test]
    fn shares_of_a_ray_add_up_to_one() {
        let n = 1440;
        for (arc, offset) in [
            (TAU, 0.0),
            (TAU, 45.0),
            (TAU, -45.0),
            (TAU, 120.0),
            (3.6, 0.0),
            (4.4, 0.0),
            (5.9, 0.0),
            (-3.6, 4.0),
            (2.0, 0.0),
        ] {
            let orbit = FdkOrbit::of(&scan(turn(n, arc), offset));
            for v in (0..n).step_by(37) {
                for u in [-60.0, -31.0, -3.0, 0.0, 12.0, 36.0, 58.0] {
                    let (beta, gamma) = (orbit.angles[v], orbit.sense[v] * (u / 500.0f64).atan());
                    let own = orbit.weight(v, u);
                    let other = beta + PI - 2.0 * gamma;
                    let group = &orbit.groups[0];
                    let again =
                        if group.within(other) > 0.0 { orbit.weight(group.arcs.nearest(other), -u) } else { 0.0 };
                    let on = orbit.on_detector(v, gamma) > 0.0 || again > 0.0;
                    let sum = own + again;
                    // The opposite view is off by up to half a step.
                    assert!(!on || (sum - 1.0).abs() < 0.06, "arc {arc}, offset {offset}, view {v}, u {u}: {sum}");
                }
            }
        }
    }

    /// A source on the axis has no angle: it must be there to be refused.
    #[test]
    fn a_source_on_the_axis_has_no_radius() {
        let mut g = scan(turn(9, TAU), 0.0);
        g.views.iter_mut().for_each(|v| v.source = [0.0, 0.0, 500.0]);
        assert!(FdkOrbit::of(&g).radius.iter().all(|r| *r == 0.0));
    }

    #[test]
    fn the_object_lies_in_a_disc_around_its_shadows() {
        let g = scan(turn(40, 3.5), 0.0);
        let orbit = FdkOrbit::of(&g);
        let (center, radius) = ([12.0, -7.0], 9.0);
        let shadow = |v: usize| {
            let s = &g.views[v].source;
            let (sin, cos) = orbit.angles[v].sin_cos();
            let to = [center[0] - s[0], center[1] - s[1]];
            let middle = (to[1] * cos - to[0] * sin).atan2(-(to[0] * cos + to[1] * sin));
            let half = (radius / to[0].hypot(to[1])).asin();
            let places = [middle - half, middle + half].map(|g| orbit.sense[v] * 500.0 * g.tan());
            (v, [places[0].min(places[1]), places[0].max(places[1])])
        };
        let found = orbit.disc(&(0..40).map(shadow).collect::<Vec<_>>()).unwrap();
        assert!(
            (found.radius - radius).abs() < 0.2 && (0..2).all(|k| (found.center[k] - center[k]).abs() < 0.2),
            "{found:?}"
        );
        assert_eq!(orbit.disc(&[]), None);
    }
}
