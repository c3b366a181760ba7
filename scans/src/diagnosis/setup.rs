//! A scan's lengths and angles, in millimetres and degrees.

use crate::diagnosis::arc::{ScanArc, scan_arc};
use crate::diagnosis::shadow::Shadow;
use conefield_core::geometry::{Geometry, Vec3, View, norm, sub};
use serde::Serialize;
use std::f64::consts::{PI, TAU};

/// A scan's lengths and angles; medians if views differ. The axis is z; the isocentre is its point at the source's
/// height.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Setup {
    /// Whether all views lie on one circle about the axis: source and detector turn about it as one body.
    pub circle: bool,
    /// Distance from the source to the axis.
    pub source_to_axis_mm: f64,
    /// Distance from the source to the detector plane.
    pub source_to_detector_mm: f64,
    /// Magnification at the isocentre.
    pub magnification: f64,
    /// Along v, u.
    pub pixel_mm: [f64; 2],
    /// Size of the whole detector along v, u.
    pub detector_mm: [f64; 2],
    /// Offset of the detector's centre from the projection of the isocentre, along v, u.
    pub offset_mm: [f64; 2],
    /// The smallest voxel along x, y, z that the detector supports: the pixel size divided by the magnification, with u
    /// for x and y and v for z.
    pub supported_voxel_mm: [f64; 3],
    /// The region that the views see.
    pub field_of_view: FieldOfView,
    /// Angular positions of the views.
    pub angles: ScanArc,
    /// Number of turns of a source that moves along the axis by more than half of what a view sees of it, as on a helix.
    #[serde(skip)]
    pub helix_turns: Option<f64>,
}

/// The cylinder about the axis that the views see.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FieldOfView {
    /// Radius that every view sees in the plane of the source; 0 if some views do not see the axis.
    pub radius_mm: f64,
    /// Radius that every view sees on at least one side of the axis: sufficient on a full circle.
    pub one_sided_radius_mm: f64,
    /// Height of the axis that every view sees.
    pub height_mm: f64,
}

/// The lengths and angles of `geometry`.
pub fn setup(geometry: &Geometry) -> Setup {
    let [rows, columns] = geometry.detector.map(|n| n as f64);
    let (mut axis, mut reach) = (Vec::new(), Vec::new());
    for view in &geometry.views {
        let s = view.source;
        let shadow = Shadow::of(view);
        // A source beside its detector plane sees no isocentre and is excluded from the medians.
        let Some(foot) = shadow.of_point([0.0, 0.0, s[2]]) else { continue };
        let pixel = [norm(view.v), norm(view.u)];
        let edge = |column: f64| -> f64 {
            let q: Vec3 = std::array::from_fn(|k| view.detector[k] + column * view.u[k] - s[k]);
            (q[0] * s[1] - q[1] * s[0]).abs() / q[0].hypot(q[1])
        };
        let side = |room: f64, column: f64| if room < 0.0 { -edge(column) } else { edge(column) };
        let left = side(columns / 2.0 + foot.column, -columns / 2.0);
        let right = side(columns / 2.0 - foot.column, columns / 2.0);
        // Heights on the axis whose projection leaves the detector.
        let per_mm = foot.magnification / pixel[0] * -view.v[2].signum();
        let ends = [-rows / 2.0, rows / 2.0].map(|r| s[2] - (r - foot.row) / per_mm);
        axis.push([
            s[0].hypot(s[1]),
            shadow.depth,
            foot.magnification,
            pixel[0],
            pixel[1],
            -foot.row * pixel[0],
            -foot.column * pixel[1],
        ]);
        reach.push([left.min(right), left.max(right), ends[0].min(ends[1]), ends[0].max(ends[1])]);
    }
    let middle = |k: usize| {
        let mut all: Vec<f64> = axis.iter().map(|a: &[f64; 7]| a[k]).collect();
        all.sort_unstable_by(f64::total_cmp);
        all.get(all.len() / 2).copied().unwrap_or(0.0)
    };
    let least = |k: usize| reach.iter().map(|r: &[f64; 4]| r[k]).fold(f64::INFINITY, f64::min);
    let most = |k: usize| reach.iter().map(|r: &[f64; 4]| r[k]).fold(f64::NEG_INFINITY, f64::max);
    let finite = |x: f64| if x.is_finite() { x.max(0.0) } else { 0.0 };
    let [dso, dsd, magnification, pv, pu, ov, ou] = std::array::from_fn(middle);
    let heights = || geometry.views.iter().map(|v| v.source[2]);
    let rise = heights().fold(f64::NEG_INFINITY, f64::max) - heights().fold(f64::INFINITY, f64::min);
    Setup {
        circle: turns_about_the_axis(&geometry.views),
        source_to_axis_mm: dso,
        source_to_detector_mm: dsd,
        magnification,
        pixel_mm: [pv, pu],
        detector_mm: [pv * rows, pu * columns],
        offset_mm: [round(ov, dsd), round(ou, dsd)],
        supported_voxel_mm: [pu, pu, pv].map(|p| if magnification > 0.0 { p / magnification } else { 0.0 }),
        field_of_view: FieldOfView {
            radius_mm: finite(least(0)),
            one_sided_radius_mm: finite(least(1)),
            height_mm: finite(least(3) - most(2)),
        },
        angles: scan_arc(&geometry.views),
        helix_turns: (rise * magnification > 0.5 * pv * rows).then(|| turns(&geometry.views)),
    }
}

/// Number of turns of the source about the axis, each step the shorter way.
fn turns(views: &[View]) -> f64 {
    let position = |v: &View| v.source[1].atan2(v.source[0]);
    let step = |pair: &[View]| (position(&pair[1]) - position(&pair[0]) + PI).rem_euclid(TAU) - PI;
    let steps: f64 = views.windows(2).map(|pair| step(pair).abs()).sum();
    // The last view makes a step, too.
    steps / TAU * views.len() as f64 / (views.len() - 1).max(1) as f64
}

/// Tolerance of a view's deviation from the turned first view, relative to the distance from source to detector.
const TOLERANCE: f64 = 1e-9;

/// Whether every view is the first one, turned about z.
fn turns_about_the_axis(views: &[View]) -> bool {
    let Some(first) = views.first().filter(|v| v.source[0].hypot(v.source[1]) > 0.0) else { return false };
    let position = |v: &View| v.source[1].atan2(v.source[0]);
    let distance = norm(sub(first.detector, first.source));
    views.iter().all(|view| {
        let (s, c) = (position(view) - position(first)).sin_cos();
        let turned = |p: Vec3| [c * p[0] - s * p[1], s * p[0] + c * p[1], p[2]];
        let near = |p: Vec3, q: Vec3, scale: f64| norm(sub(turned(p), q)) <= TOLERANCE * scale;
        near(first.source, view.source, distance)
            && near(first.detector, view.detector, distance)
            && near(first.u, view.u, norm(first.u))
            && near(first.v, view.v, norm(first.v))
    })
}

/// Rounds tiny offsets, which are rounding errors, to 0.
fn round(x: f64, scale: f64) -> f64 {
    if x.abs() < 1e-9 * scale { 0.0 } else { x }
}

impl Setup {
    /// Whether the detector is offset so that opposite views complement each other: half of the views then suffice over
    /// a full circle.
    pub fn half_is_enough(&self) -> bool {
        self.angles.full_circle && self.offset_mm[1].abs() > 0.01 * self.detector_mm[1]
    }

    /// Whether the left and the right side must show air: a detector that is shifted on purpose cuts through the object on
    /// its near side.
    pub fn open_sides(&self) -> [bool; 2] {
        match self.half_is_enough() {
            true => [self.offset_mm[1] < 0.0, self.offset_mm[1] > 0.0],
            false => [true; 2],
        }
    }

    /// How far the detector extends beyond the axis on the shorter side, in mm on the detector; negative if the axis
    /// does not project onto it.
    pub fn overlap_mm(&self) -> f64 {
        self.detector_mm[1] / 2.0 - self.offset_mm[1].abs()
    }
}
