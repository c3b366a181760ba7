//! What a scan itself tells of its geometry, without a phantom.
//!
//! [`calibrate`] looks for the [`Correction`] under which views that are kept aside are predicted best from a quick
//! reconstruction of the others (ordered subsets of SART, three passes). It goes from coarse to fine, in pixels and voxels and in how
//! far it looks (`search`). The criterion needs no marker, no symmetry and no full circle.
//!
//! How well few views predict others also depends on how large the object is made. What changes that ([`Parameter::by_pairs`]) is
//! sought by what pairs of views say of the same planes (`consistency`, `newton`), which no object changes.
//!
//! [`directions`] compares the angles with the same ones in the other direction.

mod consistency;
mod criterion;
mod direction;
mod newton;
mod parameters;
mod search;

pub use direction::{Directions, directions};
pub use parameters::{Correction, Parameter, turns};
pub use search::Watch;

use conefield_core::backend::Backend;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Geometry, View, norm};
use conefield_core::scan::Scan;
use consistency::Consistency;
use criterion::Level;
use newton::{Newton, Place};
use search::{Fit, Meter, Search, Told};
use serde::Serialize;
use serde_json::{Value, json};
use std::sync::Mutex;

/// Fewer views are not enough to keep any aside.
const FEWEST: usize = 8;
/// Pixels along the longer side of the detector of the coarsest level; each next has twice as many.
const COARSEST: usize = 32;
/// Times that a quarter of the views is kept aside.
const FOLDS: usize = 2;
/// Standard deviations from which a parameter counts as off.
const CLEAR: f64 = 3.0;
/// A parameter whose deviation is more than so many pixels of the finest level is not told, nor is one with less sensitivity.
const VAGUE: f64 = 1.0;
const FLAT: f64 = 0.03;
const FLAT_PAIRS: f64 = 0.01;
/// Where voxels lie moves the least error by about so many pixels of a level, which no view tells: part of every deviation. So does how
/// pixels sample the object, for pairs of views.
const INEXACT: f64 = 0.02;
const INEXACT_PAIRS: f64 = 0.1;
/// Pairs of views are compared on so many times finer pixels, which cost them little; most of Newton's steps.
const FINER: usize = 2;
const ROUNDS: usize = 6;
/// Why the views do not tell a parameter.
const FLAT_REASON: &str = "the views hardly depend on it, or another parameter changes them in the same way";
const CUT_REASON: &str = "no two views show the same planes whole: the object is cut off at the detector's border";
const CIRCLE_REASON: &str = "on a circle a tilted detector gives the views of an object that is wider at one end";
/// Sources whose distance from the axis and height differ by less than this share of the distance stand on a circle.
const CIRCLE: f64 = 0.01;
/// Points of the curve of a parameter.
const POINTS: i32 = 10;

/// What to look for, and how finely.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// The parameters.
    pub parameters: Vec<Parameter>,
    /// Pixels along the longer side of the detector of the finest level, about.
    pub width: usize,
    /// Whether to follow the criterion along each parameter, to draw it.
    pub curves: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self { parameters: vec![Parameter::OffsetU, Parameter::Rotation], width: 64, curves: true }
    }
}

/// What came out for a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// It is off: the correction holds its change.
    Corrected,
    /// It is right as far as the views tell: the correction leaves it as it is.
    Kept,
    /// The views do not tell: it is left as it is.
    NotDetermined,
}

/// What the views tell of a parameter.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Found {
    /// Which.
    pub parameter: Parameter,
    /// What becomes of it.
    pub verdict: Verdict,
    /// Why the views do not tell it, if they do not.
    pub reason: Option<&'static str>,
    /// Its unit.
    pub unit: &'static str,
    /// The change that predicts best, in its unit.
    pub change: f64,
    /// Standard deviation of that.
    pub uncertainty: f64,
    /// Both in pixels of the scan: of offsets, else as the shadow of a thing at the detector's side moves.
    pub pixels: [f64; 2],
    /// How much the predicted views change with it, beside a shift by a pixel.
    pub sensitivity: f64,
    /// The criterion's error for changes around it, with all else as corrected: the held-out error, relative to the largest line
    /// integral, or, where [`Parameter::by_pairs`], how much pairs of views differ, relative to what they say.
    pub curve: Vec<(f64, f64)>,
}

/// What [`calibrate`] finds.
#[derive(Debug, Clone)]
pub struct Calibration {
    /// The change of the geometry.
    pub correction: Correction,
    /// Of each parameter that was looked for.
    pub found: Vec<Found>,
    /// The held-out error at the finest level with the geometry as it was told, and corrected.
    pub held_out: [f64; 2],
    /// Pixels of the scan along the side of one at the finest level.
    pub bin: usize,
    /// Views that were kept aside and predicted.
    pub views: usize,
}

impl Calibration {
    /// Corrects the geometry of `scan` and records in its provenance how, with the scan that the calibration began from.
    pub fn correct(&self, scan: &mut Scan, source: &str) {
        scan.geometry.views = self.correction.views(&scan.geometry.views);
        let corrected: serde_json::Map<String, Value> = self
            .found
            .iter()
            .filter(|f| f.verdict == Verdict::Corrected)
            .map(|f| {
                (f.parameter.to_string(), json!({ "change": f.change, "uncertainty": f.uncertainty, "unit": f.unit }))
            })
            .collect();
        let calibrated = json!({ "from": source, "corrected": corrected, "held_out": self.held_out });
        match &mut scan.provenance {
            Value::Object(map) => drop(map.insert("calibrated".into(), calibrated)),
            Value::Null => scan.provenance = json!({ "calibrated": calibrated }),
            other => scan.provenance = json!({ "value": other.take(), "calibrated": calibrated }),
        }
    }

    /// The result as JSON, with that of [`directions`].
    pub fn json(&self, directions: Option<Directions>) -> Value {
        let [before, after] = self.held_out;
        json!({
            "parameters": self.found, "held_out": { "before": before, "after": after, "views": self.views },
            "direction": directions, "bin": self.bin,
        })
    }
}

/// Looks for the correction of `scan`'s geometry.
pub fn calibrate(scan: &Scan, settings: &Settings, backend: &dyn Backend, watch: &dyn Watch) -> Result<Calibration> {
    scan.validate("scan")?;
    let n = scan.geometry.views.len();
    ensure(n >= FEWEST, "scan", "views", n, format!("at least {FEWEST}, some of which are kept aside"))?;
    let mut asked = settings.parameters.clone();
    asked.sort_unstable();
    asked.dedup();
    let (paired, asked): (Vec<_>, Vec<_>) = asked.into_iter().partition(|p| p.by_pairs());
    let mut at = Correction::default();
    let widths = widths(scan, settings.width);
    let finest = widths[widths.len() - 1];
    let first = Level::new(scan, widths[0], FOLDS, &at)?;
    let mut pairs = if paired.is_empty() { None } else { Some(Consistency::new(scan, FINER * finest, &at)?) };
    let work = planned(&first, &widths, &asked, settings.curves)
        + pairs.as_ref().map_or(0.0, |p| planned_pairs(p, &paired, settings.curves));
    let meter = Meter { watch, total: work, done: Mutex::new(0.0) };
    let coarse = Search { level: &first, backend, meter: &meter };
    // Half a detector, or as far as anything can reasonably be off.
    let ranges = [(Parameter::OffsetU, 1.0, 5, 15), (Parameter::Rotation, 0.5, 4, 16)];
    for (parameter, pixels, steps, most) in ranges.into_iter().filter(|r| asked.contains(&r.0)) {
        at = coarse.look(parameter, at, pixels, steps, most)?;
    }
    // What lies where is known well enough now to choose the voxels by; the coarsest level has them anew.
    let mut levels = vec![];
    for &width in &widths {
        let level = Level::new(scan, width, FOLDS, &at)?;
        if width != finest {
            at = Search { level: &level, ..coarse }.refine(&asked, at, 4)?.correction;
        }
        levels.push(level);
    }
    let last = Search { level: &levels[levels.len() - 1], ..coarse };
    let (mut found, mut fit) = settled(&last, last.refine(&asked, at, 4)?, scan)?;
    let mut told_by_pairs = vec![];
    if pairs.is_some() {
        let made = Consistency::new(scan, FINER * finest, &fit.correction)?;
        let told = look_at_pairs(&Newton { pairs: &made, meter: &meter }, &paired, fit.correction, scan)?;
        if told.0.iter().any(|f| f.verdict == Verdict::Corrected) {
            // What the first search found was found in another geometry.
            fit = last.refine(&asked, told.1, 4)?;
            found.clear();
        }
        pairs = Some(made);
        told_by_pairs = told.0;
    }
    // Where voxels lie moves the best: what is off is looked for once more on voxels that have followed.
    let level = Level::new(scan, finest, FOLDS, &fit.correction)?;
    let fine = Search { level: &level, ..coarse };
    let before = fine.predict(&Correction::default())?.error;
    let (again, fit) = settled(&fine, fine.refine(&fit.active, fit.correction, 4)?, scan)?;
    found.retain(|f| again.iter().all(|a| a.parameter != f.parameter));
    found.extend(again);
    let (mut correction, mut after) = (fit.correction, fit.prediction.error);
    if told_by_pairs.iter().any(|f| f.verdict == Verdict::Corrected) {
        let made = Consistency::new(scan, FINER * finest, &correction)?;
        (told_by_pairs, correction) =
            look_at_pairs(&Newton { pairs: &made, meter: &meter }, &paired, correction, scan)?;
        after = fine.predict(&correction)?.error;
        pairs = Some(made);
    }
    found.extend(told_by_pairs);
    found.sort_by_key(|f| f.parameter);
    if settings.curves {
        let middle = Search { level: &levels[levels.len().saturating_sub(2)], ..coarse };
        for f in &mut found {
            f.curve = match &pairs {
                Some(pairs) if f.parameter.by_pairs() => {
                    let newton = Newton { pairs, meter: &meter };
                    curve(f, &pairs.geometry, |values| newton.along(f.parameter, correction, values))?
                }
                _ => curve(f, &middle.level.geometry, |values| middle.along(f.parameter, correction, values))?,
            };
        }
    }
    Ok(Calibration { correction, held_out: [before, after], found, bin: level.bin, views: fit.prediction.views.len() })
}

/// Changes of a pixel and more than this, that lower the held-out error to less than this share, are worth a warning.
const WORTH: f64 = 0.5;
const LOWER: f64 = 0.85;

/// A quick look, on coarse pixels, whether the detector stands aside or is turned: what [`calibrate`] finds of that, if the views
/// are predicted clearly better with it.
pub fn suspect(scan: &Scan, backend: &dyn Backend, watch: &dyn Watch) -> Result<Option<Calibration>> {
    if scan.geometry.views.len() < FEWEST {
        return Ok(None);
    }
    let parameters = vec![Parameter::OffsetU, Parameter::Rotation];
    let found = calibrate(scan, &Settings { parameters, width: COARSEST, curves: false }, backend, watch)?;
    let [before, after] = found.held_out;
    let off = |f: &Found| f.verdict == Verdict::Corrected && f.pixels[0].abs() > WORTH;
    Ok((after < LOWER * before && found.found.iter().any(off)).then_some(found))
}

/// Pixels along the detector's longer side of each level: each has twice those of the one before, up to about `finest`.
fn widths(scan: &Scan, finest: usize) -> Vec<usize> {
    let finest = finest.min(scan.geometry.detector.into_iter().max().unwrap_or(0)).max(1);
    let mut all = vec![finest];
    while all[0] >= 2 * COARSEST {
        all.insert(0, all[0] / 2);
    }
    all
}

/// What the whole search takes, about: pixels and voxels along a ray go with the width.
fn planned(coarsest: &Level, widths: &[usize], asked: &[Parameter], curves: bool) -> f64 {
    let n = asked.len() as f64;
    let work = |width: usize| coarsest.work() * (width as f64 / widths[0] as f64).powi(3);
    let finest = widths[widths.len() - 1];
    let looks = 30.0 * coarsest.work();
    let rounds: f64 = widths.iter().map(|&w| 3.0 * (2.0 * n + 1.5) * work(w)).sum();
    let fine = (2.0 * (2.0 * n + 1.5) + n) * work(finest);
    let middle = widths[widths.len().saturating_sub(2)];
    looks + rounds + fine + if curves { n * f64::from(POINTS + 1) * work(middle) } else { 0.0 }
}

/// What pairs of views take, about.
fn planned_pairs(pairs: &Consistency, asked: &[Parameter], curves: bool) -> f64 {
    let n = asked.len() as f64;
    let round = 2.0 + 2.0 * n + n * (n - 1.0) / 2.0;
    pairs.work() * (5.0 * round + if curves { n * f64::from(POINTS + 1) } else { 0.0 })
}

/// What pairs of views tell of some parameters, from `at`.
fn look_at_pairs(
    newton: &Newton<'_>,
    asked: &[Parameter],
    at: Correction,
    scan: &Scan,
) -> Result<(Vec<Found>, Correction)> {
    let geometry = &newton.pairs.geometry;
    let reason = |p: &Parameter| match p {
        _ if newton.pairs.planes() == 0 => Some(CUT_REASON),
        Parameter::Tilt if on_a_circle(&geometry.views) => Some(CIRCLE_REASON),
        _ => None,
    };
    let mut found: Vec<Found> = vec![];
    for &parameter in asked {
        if let Some(reason) = reason(&parameter) {
            let told = Told { deviation: f64::INFINITY, sensitivity: 0.0, sure: false };
            let unchanged = finding(parameter, 0.0, told, PAIRS, geometry, scan);
            found.push(Found { reason: Some(reason), ..unchanged });
        }
    }
    let active: Vec<Parameter> = asked.iter().copied().filter(|p| reason(p).is_none()).collect();
    let findings = |place: &Place| -> Vec<Found> {
        let all = place.active.iter().zip(&place.told);
        all.map(|(&p, &told)| finding(p, place.correction.get(p), told, PAIRS, geometry, scan)).collect()
    };
    let without = |place: Place, gone: Parameter| {
        let rest: Vec<Parameter> = place.active.into_iter().filter(|p| *p != gone).collect();
        newton.refine(&rest, place.correction.with(gone, 0.0), ROUNDS)
    };
    let (told, place) = settle(newton.refine(&active, at, ROUNDS)?, findings, without)?;
    found.extend(told);
    Ok((found, place.correction))
}

/// Whether the sources stand on a circle about the axis z. With z from its plane, the map `(x, y, z) → (x, y, z)/(1 + b·z)` of space
/// changes every view as a tilt of the detector does, so that the same planes meet the views in the same lines. It is one of the two
/// maps that views on a turntable do not tell (Fitzgibbon, Cross and Zisserman, SMILE 1998; the other one is the scale of z). Only
/// lengths of rays change, by the tilt times the ray's slope, and a change of the object takes most of that up.
fn on_a_circle(views: &[View]) -> bool {
    let place = |v: &View| (v.source[0].hypot(v.source[1]), v.source[2]);
    let Some((radius, height)) = views.first().map(place) else { return false };
    let near = |a: f64, b: f64| (a - b).abs() <= CIRCLE * radius;
    views.iter().map(place).all(|(r, h)| near(r, radius) && near(h, height))
}

/// Takes away what the views do not tell, and what is right as it is: one after the other, the vaguest first, since what is left may
/// have been held up by it.
fn settle<F>(
    mut fit: F,
    findings: impl Fn(&F) -> Vec<Found>,
    without: impl Fn(F, Parameter) -> Result<F>,
) -> Result<(Vec<Found>, F)> {
    let mut found: Vec<Found> = vec![];
    loop {
        let mut all = findings(&fit);
        let vagueness = |f: &&Found| f.pixels[1];
        let vaguest = |verdict| {
            let of = all.iter().filter(|f| f.verdict == verdict);
            of.max_by(|a, b| vagueness(a).total_cmp(&vagueness(b))).map(|f| f.parameter)
        };
        let Some(gone) = vaguest(Verdict::NotDetermined).or_else(|| vaguest(Verdict::Kept)) else {
            found.append(&mut all);
            found.sort_by_key(|f| f.parameter);
            return Ok((found, fit));
        };
        found.extend(all.into_iter().filter(|f| f.parameter == gone));
        fit = without(fit, gone)?;
    }
}

/// The same for a fit to views that are kept aside.
fn settled(fine: &Search<'_>, fit: Fit, scan: &Scan) -> Result<(Vec<Found>, Fit)> {
    let geometry = &fine.level.geometry;
    let findings = |fit: &Fit| -> Vec<Found> {
        let all = fit.active.iter().zip(fine.told(fit));
        all.map(|(&p, told)| finding(p, fit.correction.get(p), told, PREDICTION, geometry, scan)).collect()
    };
    settle(fit, findings, |fit, gone| fine.without(fit, gone))
}

/// What a criterion cannot tell: least sensitivity, and pixels that are part of every deviation.
#[derive(Clone, Copy)]
struct Limits {
    flat: f64,
    inexact: f64,
}

const PREDICTION: Limits = Limits { flat: FLAT, inexact: INEXACT };
const PAIRS: Limits = Limits { flat: FLAT_PAIRS, inexact: INEXACT_PAIRS };

/// What is said of a parameter with this value; `geometry` is the level's.
fn finding(parameter: Parameter, value: f64, told: Told, limits: Limits, geometry: &Geometry, scan: &Scan) -> Found {
    let pixel = parameter.pixel(geometry);
    let deviation = told.deviation.hypot(limits.inexact * pixel);
    let verdict = if !(deviation < VAGUE * pixel && told.sensitivity > limits.flat) {
        Verdict::NotDetermined
    } else if value.abs() <= CLEAR * deviation {
        Verdict::Kept
    } else if told.sure {
        Verdict::Corrected
    } else {
        Verdict::NotDetermined
    };
    let full = match parameter {
        Parameter::OffsetV => norm(scan.geometry.views[0].v),
        p => p.pixel(&scan.geometry),
    };
    Found {
        parameter,
        verdict,
        reason: (verdict == Verdict::NotDetermined).then_some(FLAT_REASON),
        unit: parameter.unit(),
        change: value * parameter.in_unit(),
        uncertainty: deviation * parameter.in_unit(),
        pixels: [value / full, deviation / full],
        sensitivity: told.sensitivity,
        curve: vec![],
    }
}

/// The criterion along a parameter, from where it was to as far beyond what was found.
fn curve(
    found: &Found,
    geometry: &Geometry,
    along: impl Fn(&[f64]) -> Result<Vec<(f64, f64)>>,
) -> Result<Vec<(f64, f64)>> {
    let p = found.parameter;
    let best = found.change / p.in_unit();
    let reach = (1.5 * best.abs()).max(1.5 * p.pixel(geometry));
    let values: Vec<f64> =
        (-POINTS / 2..=POINTS / 2).map(|i| best + reach * f64::from(2 * i) / f64::from(POINTS)).collect();
    Ok(along(&values)?.into_iter().map(|(x, e)| (x * p.in_unit(), e)).collect())
}
