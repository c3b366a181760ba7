//! Warnings about problems for a reconstruction, with figures and advice.

use crate::diagnosis::repeated::repeated;
use crate::diagnosis::survey::Survey;
use conefield_core::scan::Scan;
use serde::Serialize;
use std::fmt;

/// Subject of a warning.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum WarningKind {
    /// Projections that do not look like line integrals.
    Values,
    /// An object that extends beyond the detector's sides.
    Truncated,
    /// An object that extends beyond the volume.
    Outside,
    /// A volume that some views see only partly.
    Coverage,
    /// A detector that the axis misses or barely hits.
    Offset,
    /// An arc that is too short.
    Arc,
    /// A gap between views.
    Gap,
    /// Angles in degrees that were read as radians.
    Degrees,
    /// A last view that shows the same as the first.
    Repeated,
    /// Lengths or attenuation of an unusual size.
    Scale,
    /// Voxels that do not match the detector's resolution.
    VoxelSize,
}

/// A problem for a reconstruction.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Warning {
    /// Its subject.
    pub kind: WarningKind,
    /// The finding, with figures.
    pub found: String,
    /// Advice; empty if `found` includes it.
    pub advice: String,
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.advice.as_str() {
            "" => write!(f, "{}", self.found),
            advice => write!(f, "{}: {advice}", self.found),
        }
    }
}

/// Usual ranges of distances in mm and of attenuation in 1/mm.
const DISTANCES: [f64; 2] = [10.0, 5000.0];
const ATTENUATIONS: [f64; 2] = [1e-4, 10.0];
/// Fewest voxels along a side that are worth a proposal.
const FEW: f64 = 8.0;
/// Smallest sufficient overlap past the axis, as a share of the detector.
const OVERLAP: f64 = 0.05;
/// A gap is large if it exceeds the mean gap by this factor.
const GAP: f64 = 3.0;

fn percent(x: f64) -> String {
    match 100.0 * x {
        p if p > 0.0 && p < 0.1 => "under 0.1 %".into(),
        p if p < 100.0 && p > 99.9 => "over 99.9 %".into(),
        p => format!("{p:.1} %"),
    }
}

/// All problems of `scan`.
pub(crate) fn warnings(scan: &Scan, s: &Survey) -> Vec<Warning> {
    let mut all = Vec::new();
    let mut warn = |kind, found: String, advice: String| all.push(Warning { kind, found, advice });
    for complaint in &s.check.complaints {
        warn(WarningKind::Values, complaint.clone(), String::new());
    }
    truncated(s, &mut warn);
    outside(s, &mut warn);
    covered(scan, s, &mut warn);
    offset(s, &mut warn);
    angles(scan, s, &mut warn);
    repeats(scan, s, &mut warn);
    scale(scan, s, &mut warn);
    voxels(scan, s, &mut warn);
    all
}

type Warn<'a> = &'a mut dyn FnMut(WarningKind, String, String);

fn truncated(s: &Survey, warn: Warn) {
    let t = &s.truncation;
    // Values that are not line integrals are not near zero anywhere.
    if t.views <= 0.02 || !s.check.complaints.is_empty() {
        return;
    }
    warn(
        WarningKind::Truncated,
        format!(
            "the object extends beyond the detector's side in {} of the views, on {} of the rows ({:.1} mm at the \
             axis): line integrals of {:.3} there; up to {:.3} counts as air",
            percent(t.views),
            percent(t.rows),
            t.height_mm,
            t.level,
            t.threshold
        ),
        "make the volume as large as the whole object, not just the field of view, and do not trust values near the \
         rim of the field of view"
            .into(),
    );
}

fn outside(s: &Survey, warn: Warn) {
    // A body that the detector cuts off has been warned of, with the same advice.
    if !s.outside.is_seen() || s.truncation.views > 0.02 || !s.check.complaints.is_empty() {
        return;
    }
    let along: Vec<&str> = ["x", "y", "z"].into_iter().zip(s.outside.along).filter(|a| a.1).map(|a| a.0).collect();
    warn(
        WarningKind::Outside,
        format!(
            "rays that pass beside the volume measure up to {:.3} in {} of the views: the object extends beyond it along {}",
            s.outside.most,
            percent(s.outside.views),
            along.join(" and ")
        ),
        "every method but fdk puts that attenuation into the volume: make the volume as large as the object, or set \
         scene.surround = { coarse = {} }"
            .into(),
    );
}

fn covered(scan: &Scan, s: &Survey, warn: Warn) {
    let (c, fov) = (&s.coverage, &s.setup.field_of_view);
    if c.complete >= 0.995 {
        return;
    }
    let size = scan.geometry.volume.size();
    let radius = if c.needed < 1.0 { fov.one_sided_radius_mm } else { fov.radius_mm };
    let none = if c.unseen > 0.0 { format!(", no view sees {}", percent(c.unseen)) } else { String::new() };
    let (enough, height) = match s.setup.helix_turns {
        Some(_) => ("the views of half a turn", "that moves along the axis".to_owned()),
        None if c.needed < 1.0 => ("half the views", format!("and height {:.1} mm", fov.height_mm)),
        None => ("all views", format!("and height {:.1} mm", fov.height_mm)),
    };
    // A smaller volume would leave out even more of the object.
    let advice = match s.outside.is_seen() || s.truncation.views > 0.02 {
        true => "trust the parts outside less; conefield info --png shows them",
        false => "make the volume smaller, or trust the parts outside less; conefield info --png shows them",
    };
    warn(
        WarningKind::Coverage,
        format!(
            "{enough} see {} of the volume{none}, and the worst voxel is seen by {} of the views; the volume is {:.1} x \
             {:.1} x {:.1} mm and the field of view a cylinder of radius {radius:.1} mm {height}",
            percent(c.complete),
            percent(c.least),
            size[0],
            size[1],
            size[2]
        ),
        advice.into(),
    );
}

fn offset(s: &Survey, warn: Warn) {
    let g = &s.setup;
    let (overlap, half) = (g.overlap_mm(), g.detector_mm[1] / 2.0);
    let found = format!(
        "the detector is shifted by {:.2} mm along u, {} its half width of {half:.2} mm",
        g.offset_mm[1].abs(),
        if overlap < 0.0 { "more than" } else { "nearly" },
    );
    if overlap < 0.0 {
        let advice =
            "no ray crosses the axis: check the offset's sign and unit, and that it refers to the detector's centre";
        warn(WarningKind::Offset, found, advice.into());
    } else if overlap < OVERLAP * 2.0 * half {
        warn(
            WarningKind::Offset,
            format!("{found}: only {overlap:.2} mm extend beyond the axis"),
            format!("opposite views hardly overlap; {:.1} mm or more would connect them", OVERLAP * 2.0 * half),
        );
    }
}

fn angles(scan: &Scan, s: &Survey, warn: Warn) {
    let a = &s.setup.angles;
    if a.like_degrees {
        warn(
            WarningKind::Degrees,
            format!(
                "views follow each other in steps of {:.4} rad, which divide 180, 360 or 720 evenly",
                a.step_deg.to_radians()
            ),
            "the angles look like degrees read as radians: convert them".into(),
        );
        return;
    }
    let size = scan.geometry.volume.size();
    // The reconstructed region that the detector sees.
    let radius = s.setup.field_of_view.one_sided_radius_mm.min(size[0].hypot(size[1]) / 2.0);
    let fan = 2.0 * (radius / s.setup.source_to_axis_mm.max(radius)).asin().to_degrees();
    let shifted = s.setup.offset_mm[1].abs() > 0.1 * s.setup.detector_mm[1];
    let (least, why) = match shifted {
        true => (360.0, "a full circle, because the detector is shifted".to_owned()),
        false => (180.0 + fan, format!("180° and the fan angle of {fan:.1}°")),
    };
    if !a.full_circle && a.covered_deg < least - a.mean_gap_deg.max(0.1) {
        warn(
            WarningKind::Arc,
            format!("the views cover an arc of {:.1}°, less than {least:.1}°: {why}", a.covered_deg),
            format!(
                "edges along the missing directions will be blurred; take views over {least:.0}°, check the range of the \
                 angles, or try --spec limited-angle"
            ),
        );
    }
    if scan.geometry.views.len() > 4 && a.largest_gap_deg > GAP * a.mean_gap_deg {
        warn(
            WarningKind::Gap,
            format!(
                "no view between {:.1}° and {:.1}°: a gap of {:.1}°, {:.1} times the mean step of {:.2}°",
                a.largest_gap_at_deg,
                a.largest_gap_at_deg + a.largest_gap_deg,
                a.largest_gap_deg,
                a.largest_gap_deg / a.mean_gap_deg,
                a.mean_gap_deg
            ),
            "check that no views are missing and that the angles match their projections".into(),
        );
    }
}

fn repeats(scan: &Scan, s: &Survey, warn: Warn) {
    let Some([seam, least]) = repeated(scan) else { return };
    let n = scan.geometry.views.len();
    // With both ends, the same angles have one step fewer.
    let given = s.setup.angles.step_deg.abs();
    let step = given * n as f64 / (n - 1) as f64;
    warn(
        WarningKind::Repeated,
        format!(
            "the last view repeats the first: they differ by {} and their neighbours by {} or more, but their angles are \
             {given:.4}° apart",
            percent(seam),
            percent(least)
        ),
        format!(
            "if the scan includes both ends of a full turn, its steps are {step:.4}°: import it with step_deg = {} \
             instead of range_deg, and leave the last view out with --views 0-{}",
            (step * 1e6).round() / 1e6,
            n - 2
        ),
    );
}

fn scale(scan: &Scan, s: &Survey, warn: Warn) {
    if !scan.unit.is_length() {
        return;
    }
    let dso = s.setup.source_to_axis_mm;
    if !scan.geometry.is_parallel(0) && !(DISTANCES[0]..=DISTANCES[1]).contains(&dso) {
        let advice = if dso < DISTANCES[0] {
            "unless this is a micro-CT, check that the lengths are mm and not metres"
        } else {
            "check that the lengths are mm and not micrometres"
        };
        warn(
            WarningKind::Scale,
            format!(
                "the source is {dso:.4} mm from the axis; most scanners have {} to {} mm",
                DISTANCES[0], DISTANCES[1]
            ),
            advice.into(),
        );
    }
    let mu = s.attenuation_per_mm;
    if s.check.complaints.is_empty() && mu > 0.0 && !(ATTENUATIONS[0]..=ATTENUATIONS[1]).contains(&mu) {
        warn(
            WarningKind::Scale,
            format!(
                "line integrals up to {:.3} over a volume of {:.3} mm are an attenuation of about {mu:.1e} /mm; \
                 scanned objects have {:.0e} to {} /mm (water 0.02)",
                s.check.typical_range[1],
                scan.geometry.volume.size()[0].max(scan.geometry.volume.size()[1]),
                ATTENUATIONS[0],
                ATTENUATIONS[1]
            ),
            "check the unit of the lengths, or of the values".into(),
        );
    }
}

fn voxels(scan: &Scan, s: &Survey, warn: Warn) {
    let grid = &scan.geometry.volume;
    let supported = s.setup.supported_voxel_mm;
    let ratios: [f64; 3] = std::array::from_fn(|k| grid.spacing[k] / supported[k]);
    if ratios.iter().any(|r| !r.is_finite()) {
        return;
    }
    let list = |v: [f64; 3]| format!("{:.4} x {:.4} x {:.4} mm", v[0], v[1], v[2]);
    let (fine, coarse) = (ratios.iter().any(|r| *r < 0.499), ratios.iter().all(|r| *r > 2.001));
    if !fine && !coarse {
        return;
    }
    let size = grid.size();
    let fitting: [f64; 3] = std::array::from_fn(|k| (size[k] / supported[k]).round().max(1.0));
    let found = format!(
        "voxels of {}, but a pixel divided by the magnification of {:.3} is {}",
        list(grid.spacing),
        s.setup.magnification,
        list(supported)
    );
    let shape = match fitting.iter().all(|n| *n >= FEW) {
        true => format!("a shape of {:?} gives voxels of that size", fitting.map(|n| n as usize)),
        false => "check that the pixel size is in mm, and that dso and dsd are not swapped".into(),
    };
    let why = if fine { "finer than the detector resolves" } else { "details that the detector resolves are lost" };
    warn(WarningKind::VoxelSize, found, format!("{why}; {shape}"));
}
