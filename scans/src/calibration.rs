//! Estimates a scan's geometry from its own views, without a phantom.
//!
//! [`calibrate`] finds the [`Correction`] with the smallest held-out error: a quick reconstruction (ordered subsets of
//! SART, three passes) of some views predicts the held-out ones. Pixels, voxels and the search range go from coarse to
//! fine (`search`). The criterion needs no marker, no symmetry and no full circle.
//!
//! The held-out error has its minimum elsewhere if the views do not determine the object: on short arcs, and where it is cut
//! off. So rays that are measured from both sides (`opposite`) must agree with a shift along u, and without such rays
//! nothing is determined.
//!
//! The held-out error also depends on the size of the reconstructed object. Parameters that change this size
//! ([`Parameter::by_pairs`]) are found by comparing pairs of views on the same planes (`consistency`, `newton`). This
//! comparison is independent of the object.
//!
//! [`directions`] compares the angles with the reversed ones. [`jitter()`] estimates a shift of the detector for each
//! view.

mod consistency;
mod criterion;
mod direction;
mod jitter;
mod newton;
mod opposite;
mod parameters;
mod search;

pub use criterion::bytes;
pub use direction::{Directions, directions};
pub use jitter::{Jitter, jitter};
pub use parameters::{Correction, Parameter};
pub use search::Watch;

use crate::provenance;
use conefield_core::backend::Backend;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Geometry, View, norm};
use conefield_core::scan::Scan;
use consistency::Consistency;
use criterion::Level;
use newton::{Newton, Place};
use opposite::Opposite;
use search::{Evidence, Fit, Meter, Search};
use serde::Serialize;
use serde_json::{Value, json};
use std::sync::Mutex;

/// Least number of views; with fewer, none can be held out.
const FEWEST: usize = 8;
/// Pixels along the longer side of the detector of the coarsest level; each next has twice as many.
const COARSEST: usize = 32;
/// Times that a quarter of the views is held out.
const FOLDS: usize = 2;
/// A parameter is wrong if its change exceeds this many standard deviations.
const CLEAR: f64 = 3.0;
/// A parameter is not determined if its deviation exceeds this number of pixels of the finest level.
const VAGUE: f64 = 1.0;
/// Pairs of views are compared on pixels finer by this factor, at little cost; the largest number of Newton's steps.
const FINER: usize = 2;
const ROUNDS: usize = 6;
/// Reasons why the views do not determine a parameter.
const FLAT_REASON: &str = "the views hardly depend on it, or another parameter changes them in the same way";
const CUT_REASON: &str = "no two views show the same planes completely: the object is cut off at the detector's border";
const ARC_REASON: &str =
    "no rays are measured from both sides: the arc is too short, or the detector lies beside the axis";
const OPPOSITE_REASON: &str = "the rays that are measured from both sides do not agree better with another value";
const ROWS_REASON: &str = "the detector has too few rows";
/// Fewest rows that show a rotation of the detector.
const ROWS: usize = 4;
const CIRCLE_REASON: &str = "on a circle a tilted detector gives the same views as an object that is wider at one end";
/// Sources are on a circle if their heights and distances from the axis differ by less than this share of the distance.
const CIRCLE: f64 = 0.01;
/// Intervals of the curve of a parameter.
const POINTS: i32 = 10;

/// The parameters to estimate, and the resolution.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// The parameters.
    pub parameters: Vec<Parameter>,
    /// Approximate number of pixels along the longer side of the detector at the finest level.
    pub width: usize,
    /// Whether to compute the curve of the criterion along each parameter.
    pub curves: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self { parameters: vec![Parameter::OffsetU, Parameter::Rotation], width: 64, curves: true }
    }
}

/// The outcome for a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// It is wrong: the correction contains its change.
    Corrected,
    /// It is right within the uncertainty: the correction does not change it.
    Kept,
    /// The views do not determine it: the correction does not change it.
    NotDetermined,
}

/// The result for one parameter.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Found {
    /// The parameter.
    pub parameter: Parameter,
    /// The outcome.
    pub verdict: Verdict,
    /// Why the views do not determine it, if they do not.
    pub reason: Option<&'static str>,
    /// Its unit.
    pub unit: &'static str,
    /// The best change, in its unit.
    pub change: f64,
    /// Standard deviation of the change.
    pub uncertainty: f64,
    /// Both in pixels of the scan: for parameters other than offsets, the shift of a shadow at the side of the
    /// detector.
    pub pixels: [f64; 2],
    /// Change of the predicted views with it, relative to a shift by a pixel.
    pub sensitivity: f64,
    /// The criterion for changes around the best one, with the other parameters corrected: the held-out error relative
    /// to the largest line integral or, if [`Parameter::by_pairs`], the difference of pairs of views relative to their
    /// values.
    pub curve: Vec<(f64, f64)>,
}

/// The result of [`calibrate`].
#[derive(Debug, Clone)]
pub struct Calibration {
    /// The change of the geometry.
    pub correction: Correction,
    /// The result for each requested parameter.
    pub found: Vec<Found>,
    /// The held-out error at the finest level, before and after correction.
    pub held_out: [f64; 2],
    /// Pixels of the scan along the side of a pixel of the finest level.
    pub bin: usize,
    /// Number of held-out views.
    pub views: usize,
}

impl Calibration {
    /// Corrects the geometry of `scan` and records the correction and the path of the original scan in its provenance.
    pub fn correct(&self, scan: &mut Scan, source: &str) {
        scan.geometry.views = self.correction.views(&scan.geometry.views);
        let mut corrected = json!({});
        for f in self.found.iter().filter(|f| f.verdict == Verdict::Corrected) {
            let Found { change, uncertainty, unit, .. } = f;
            corrected[f.parameter.name()] = json!({ "change": change, "uncertainty": uncertainty, "unit": unit });
        }
        *provenance::entry(scan, "calibrated") =
            json!({ "from": source, "corrected": corrected, "held_out": self.held_out });
    }

    /// The result as JSON, with those of [`directions`] and [`jitter()`].
    pub fn json(&self, directions: Option<Directions>, jitter: Option<&Jitter>) -> Value {
        let [before, after] = self.held_out;
        json!({
            "parameters": self.found, "held_out": { "before": before, "after": after, "views": self.views },
            "direction": directions, "jitter": jitter, "bin": self.bin,
        })
    }
}

/// Estimates the correction of `scan`'s geometry.
pub fn calibrate(scan: &Scan, settings: &Settings, backend: &dyn Backend, watch: &dyn Watch) -> Result<Calibration> {
    scan.validate("scan")?;
    let n = scan.geometry.views.len();
    ensure(n >= FEWEST, "scan", "views", n, format!("at least {FEWEST}, some of which are held out"))?;
    let cone = (0..n).all(|view| !scan.geometry.is_parallel(view));
    ensure(cone, "scan", "views", "a parallel beam", "a cone beam: calibration moves its source and detector")?;
    let mut asked = settings.parameters.clone();
    asked.sort_unstable();
    asked.dedup();
    let (paired, mut asked): (Vec<_>, Vec<_>) = asked.into_iter().partition(|p| p.by_pairs());
    let mut at = Correction::default();
    let widths = widths(scan, settings.width);
    let finest = widths[widths.len() - 1];
    let first = Level::new(scan, widths[0], FOLDS, &at)?;
    let opposite = on_a_circle(&scan.geometry.views)
        .then(|| Opposite::of(scan.binned(criterion::bin(scan.geometry.detector, finest))));
    let shared = opposite.as_ref().is_none_or(Opposite::enough);
    let reason = |p: &Parameter| match p {
        _ if !shared => Some(ARC_REASON),
        Parameter::Rotation if scan.geometry.detector[0] < ROWS => Some(ROWS_REASON),
        _ => None,
    };
    let judge = Judge { limits: PREDICTION, geometry: &first.geometry, scan };
    let open = |p: &Parameter| Some(judge.undetermined(*p, reason(p)?));
    let open: Vec<Found> = asked.iter().filter_map(open).collect();
    asked.retain(|p| reason(p).is_none());
    let mut pairs = if paired.is_empty() { None } else { Some(Consistency::new(scan, FINER * finest, &at)?) };
    let work = planned(&first, &widths, &asked, settings.curves)
        + pairs.as_ref().map_or(0.0, |p| planned_pairs(p, &paired, settings.curves));
    let meter = Meter { watch, total: work, done: Mutex::new(0.0) };
    let coarse = Search { level: &first, backend, meter: &meter };
    // Half a detector, or the largest error that is plausible.
    let ranges = [(Parameter::OffsetU, 1.0, 5, 15), (Parameter::Rotation, 0.5, 4, 16)];
    for (parameter, pixels, steps, most) in ranges.into_iter().filter(|r| asked.contains(&r.0)) {
        at = coarse.scan(parameter, at, pixels, steps, most)?;
    }
    let (levels, at) = descend(scan, &widths, &coarse, &asked, at)?;
    let last = Search { level: &levels[levels.len() - 1], ..coarse };
    let (mut found, mut fit) = settled(&last, last.refine(&asked, at, 4)?, scan, opposite.as_ref())?;
    // Pairs of views in a corrected geometry, and what they say.
    let by_pairs_at = |at: Correction| -> Result<_> {
        let made = Consistency::new(scan, FINER * finest, &at)?;
        let (results, corrected) = compare_pairs(&Newton { pairs: &made, meter: &meter }, &paired, at, scan)?;
        Ok((made, results, corrected))
    };
    let mut by_pairs = vec![];
    if pairs.is_some() {
        let (made, results, corrected) = by_pairs_at(fit.correction)?;
        if results.iter().any(|f| f.verdict == Verdict::Corrected) {
            // The results of the first search belong to another geometry.
            fit = last.refine(&asked, corrected, 4)?;
            found.clear();
        }
        pairs = Some(made);
        by_pairs = results;
    }
    // The voxel positions shift the minimum: the search is repeated on voxels in the corrected geometry.
    let level = Level::new(scan, finest, FOLDS, &fit.correction)?;
    let fine = Search { level: &level, ..coarse };
    let before = fine.predict(&Correction::default())?.error;
    let (again, fit) = settled(&fine, fine.refine(&fit.active, fit.correction, 4)?, scan, opposite.as_ref())?;
    found.retain(|f| again.iter().all(|a| a.parameter != f.parameter));
    found.extend(again);
    let (mut correction, mut after) = (fit.correction, fit.prediction.error);
    if by_pairs.iter().any(|f| f.verdict == Verdict::Corrected) {
        let made;
        (made, by_pairs, correction) = by_pairs_at(correction)?;
        after = fine.predict(&correction)?.error;
        pairs = Some(made);
    }
    found.extend(by_pairs);
    found.extend(open);
    found.sort_unstable_by_key(|f| f.parameter);
    if settings.curves {
        let middle = Search { level: &levels[levels.len().saturating_sub(2)], ..coarse };
        put_curves(&mut found, &middle, pairs.as_ref(), correction)?;
    }
    Ok(Calibration { correction, held_out: [before, after], found, bin: level.bin, views: fit.prediction.views.len() })
}

/// The levels from the coarsest to the finest, and the correction that all but the finest lead to. The geometry is accurate
/// enough to choose their voxels.
fn descend(
    scan: &Scan,
    widths: &[usize],
    coarse: &Search<'_>,
    asked: &[Parameter],
    mut at: Correction,
) -> Result<(Vec<Level>, Correction)> {
    let mut levels = vec![];
    for (i, &width) in widths.iter().enumerate() {
        let level = Level::new(scan, width, FOLDS, &at)?;
        if i + 1 < widths.len() {
            at = Search { level: &level, ..*coarse }.refine(asked, at, 4)?.correction;
        }
        levels.push(level);
    }
    Ok((levels, at))
}

/// Adds the criterion along each parameter, on the pixels of `middle` or on pairs of views.
fn put_curves(
    found: &mut [Found],
    middle: &Search<'_>,
    pairs: Option<&Consistency>,
    correction: Correction,
) -> Result<()> {
    for f in found {
        f.curve = match pairs {
            Some(pairs) if f.parameter.by_pairs() => {
                let newton = Newton { pairs, meter: middle.meter };
                curve(f, &pairs.geometry, |values| newton.along(f.parameter, correction, values))?
            }
            _ => curve(f, &middle.level.geometry, |values| middle.along(f.parameter, correction, values))?,
        };
    }
    Ok(())
}

/// A change is worth a warning above this many pixels, and if it lowers the held-out error below this share.
const WORTH: f64 = 0.5;
const LOWER: f64 = 0.85;

/// Quick test on coarse pixels for a shifted or rotated detector. Returns the result of [`calibrate`] if the correction
/// lowers the held-out error clearly.
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

/// Pixels along the detector's longer side at each level. Each level has twice as many as the previous one, up to about
/// `finest`.
fn widths(scan: &Scan, finest: usize) -> Vec<usize> {
    let finest = finest.min(scan.geometry.detector.into_iter().max().unwrap_or(0)).max(1);
    let mut all = vec![finest];
    while all[0] >= 2 * COARSEST {
        all.insert(0, all[0] / 2);
    }
    all
}

/// Approximate work of the whole search: pixels and voxels along a ray are proportional to the width.
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

/// Approximate work for pairs of views.
fn planned_pairs(pairs: &Consistency, asked: &[Parameter], curves: bool) -> f64 {
    let n = asked.len() as f64;
    let round = 2.0 + 2.0 * n + n * (n - 1.0) / 2.0;
    pairs.work() * (5.0 * round + if curves { n * f64::from(POINTS + 1) } else { 0.0 })
}

/// Estimates parameters from pairs of views, starting at `at`.
fn compare_pairs(
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
    let judge = Judge { limits: PAIRS, geometry, scan };
    let open = |p: &Parameter| Some(judge.undetermined(*p, reason(p)?));
    let mut found: Vec<Found> = asked.iter().filter_map(open).collect();
    let active: Vec<Parameter> = asked.iter().copied().filter(|p| reason(p).is_none()).collect();
    let findings = |place: &Place| -> Vec<Found> {
        let all = place.active.iter().zip(&place.evidence);
        all.map(|(&p, &evidence)| judge.finding(p, place.correction.get(p), evidence)).collect()
    };
    let without = |place: Place, gone: Parameter| {
        let rest: Vec<Parameter> = place.active.into_iter().filter(|p| *p != gone).collect();
        newton.refine(&rest, place.correction.with(gone, 0.0), ROUNDS)
    };
    let (determined, place) = settle(newton.refine(&active, at, ROUNDS)?, findings, without)?;
    found.extend(determined);
    Ok((found, place.correction))
}

/// Whether the sources are on a circle around the z axis. With z measured from the plane of the circle, the map `(x, y,
/// z) → (x, y, z)/(1 + b·z)` of space changes every view like a tilt of the detector: the same planes meet the views in
/// the same lines. Views on a turntable leave two maps undetermined: this one and the scale of z (Fitzgibbon, Cross and
/// Zisserman, SMILE 1998). Only the lengths of rays change, by the tilt times the ray's slope. A change of the object
/// compensates most of this.
fn on_a_circle(views: &[View]) -> bool {
    let place = |v: &View| (v.source[0].hypot(v.source[1]), v.source[2]);
    let Some((radius, height)) = views.first().map(place) else { return false };
    let near = |a: f64, b: f64| (a - b).abs() <= CIRCLE * radius;
    views.iter().map(place).all(|(r, h)| near(r, radius) && near(h, height))
}

/// Removes the parameters that the views do not determine or that are already right. It removes the least certain one
/// first and fits again, because this can make the others more certain.
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
            found.sort_unstable_by_key(|f| f.parameter);
            return Ok((found, fit));
        };
        found.extend(all.into_iter().filter(|f| f.parameter == gone));
        fit = without(fit, gone)?;
    }
}

/// The same for a fit to held-out views. Shared rays judge the result, if the sources are on a circle.
fn settled(fine: &Search<'_>, fit: Fit, scan: &Scan, opposite: Option<&Opposite>) -> Result<(Vec<Found>, Fit)> {
    let limits = if fine.level.cut { PREDICTION_CUT } else { PREDICTION };
    let judge = Judge { limits, geometry: &fine.level.geometry, scan };
    let findings = |fit: &Fit| -> Vec<Found> {
        let of = |(&p, evidence): (&Parameter, Evidence)| match opposite {
            Some(opposite) => judge.with_shared_rays(p, evidence, opposite, fit),
            None => judge.finding(p, fit.correction.get(p), evidence),
        };
        fit.active.iter().zip(fine.evidence(fit)).map(of).collect()
    };
    settle(fit, findings, |fit, gone| fine.without(fit, gone))
}

/// Limits of a criterion.
#[derive(Clone, Copy)]
struct Limits {
    /// Sensitivity below which a parameter is not determined.
    flat: f64,
    /// Pixels of a level by which the voxel positions, or for pairs of views the sampling of the object by pixels, shift
    /// the minimum of the error. The views do not show this shift, so it is part of every deviation.
    inexact: f64,
}

const PREDICTION: Limits = Limits { flat: 0.03, inexact: 0.02 };
/// If the object is cut off at the sides, also on a half-fan scan: the reconstruction is wrong there.
const PREDICTION_CUT: Limits = Limits { inexact: 0.1, ..PREDICTION };
const PAIRS: Limits = Limits { flat: 0.01, inexact: 0.1 };

/// What turns evidence on a parameter into its result.
struct Judge<'a> {
    limits: Limits,
    /// The level's.
    geometry: &'a Geometry,
    scan: &'a Scan,
}

impl Judge<'_> {
    /// The result for a parameter with this value.
    fn finding(&self, parameter: Parameter, value: f64, evidence: Evidence) -> Found {
        let pixel = parameter.pixel(self.geometry);
        let deviation = evidence.deviation.hypot(self.limits.inexact * pixel);
        let verdict = if !(deviation < VAGUE * pixel && evidence.sensitivity > self.limits.flat) {
            Verdict::NotDetermined
        } else if value.abs() <= CLEAR * deviation {
            Verdict::Kept
        } else if evidence.sure {
            Verdict::Corrected
        } else {
            Verdict::NotDetermined
        };
        let full = match parameter {
            Parameter::OffsetV => norm(self.scan.geometry.views[0].v),
            p => p.pixel(&self.scan.geometry),
        };
        Found {
            parameter,
            verdict,
            reason: (verdict == Verdict::NotDetermined).then_some(FLAT_REASON),
            unit: parameter.unit(),
            change: value * parameter.in_unit(),
            uncertainty: deviation * parameter.in_unit(),
            pixels: [value / full, deviation / full],
            sensitivity: evidence.sensitivity,
            curve: vec![],
        }
    }

    /// The result for a parameter that the views do not determine.
    fn undetermined(&self, parameter: Parameter, reason: &'static str) -> Found {
        let evidence = Evidence { deviation: f64::INFINITY, sensitivity: 0.0, sure: false };
        Found { reason: Some(reason), ..self.finding(parameter, 0.0, evidence) }
    }

    /// The value of `parameter` that held-out views prefer. What shared rays prefer instead is part of its uncertainty.
    /// They must agree better with a shift along u, which every such ray shows, and with every change if the object is
    /// cut off.
    fn with_shared_rays(&self, parameter: Parameter, evidence: Evidence, opposite: &Opposite, fit: &Fit) -> Found {
        let Some(opinion) = opposite.opinion(&fit.correction, parameter) else {
            return self.undetermined(parameter, ARC_REASON);
        };
        let beyond = (opinion.change.abs() - opinion.deviation).max(0.0);
        let evidence = Evidence { deviation: evidence.deviation.hypot(beyond), ..evidence };
        let found = self.finding(parameter, fit.correction.get(parameter), evidence);
        let asked = parameter == Parameter::OffsetU || self.limits.inexact > PREDICTION.inexact;
        if found.verdict == Verdict::Corrected && asked && !opinion.better {
            return self.undetermined(parameter, OPPOSITE_REASON);
        }
        found
    }
}

/// The criterion along a parameter, from its original value to the same distance beyond the best one.
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
