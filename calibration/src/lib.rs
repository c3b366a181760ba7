//! What a scan itself tells of its geometry, without a phantom.
//!
//! [`calibrate`] looks for the [`Correction`] under which views that are kept aside are predicted best from a quick
//! reconstruction of the others (ordered subsets of SART, three passes). It goes from coarse to fine, in pixels and voxels and in how
//! far it looks (`search`). The criterion needs no marker, no symmetry and no full circle.

mod criterion;
mod parameters;
mod search;

pub use parameters::{Correction, Parameter, turns};
pub use search::Watch;

use conefield_core::backend::Backend;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::norm;
use conefield_core::scan::Scan;
use criterion::Level;
use search::{Fit, Meter, Search, Told};
use serde::Serialize;
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
/// Where voxels lie moves the least error by about so many pixels of a level, which no view tells: part of every deviation.
const INEXACT: f64 = 0.02;
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
    Untold,
}

/// What the views tell of a parameter.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Found {
    /// Which.
    pub parameter: Parameter,
    /// What becomes of it.
    pub verdict: Verdict,
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
    /// The held-out error (relative to the largest line integral) for changes around it, with all else as corrected.
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

/// Looks for the correction of `scan`'s geometry.
pub fn calibrate(scan: &Scan, settings: &Settings, backend: &dyn Backend, watch: &dyn Watch) -> Result<Calibration> {
    scan.validate("scan")?;
    let n = scan.geometry.views.len();
    ensure(n >= FEWEST, "scan", "views", n, format!("at least {FEWEST}, some of which are kept aside"))?;
    let mut asked = settings.parameters.clone();
    asked.sort_unstable();
    asked.dedup();
    let mut at = Correction::default();
    let widths = widths(scan, settings.width);
    let first = Level::new(scan, widths[0], FOLDS, &at)?;
    let meter = Meter { watch, total: planned(&first, &widths, &asked, settings.curves), done: Mutex::new(0.0) };
    let coarse = Search { level: &first, backend, meter: &meter };
    // Half a detector, or as far as anything can reasonably be off.
    let ranges = [(Parameter::OffsetU, 1.0, 5, 15), (Parameter::Rotation, 0.5, 4, 16), (Parameter::OffsetV, 0.5, 2, 8)];
    for (parameter, pixels, steps, most) in ranges.into_iter().filter(|r| asked.contains(&r.0)) {
        at = coarse.look(parameter, at, pixels, steps, most)?;
    }
    // What lies where is known well enough now to choose the voxels by; the coarsest level has them anew.
    let mut levels = vec![];
    for &width in &widths {
        let level = Level::new(scan, width, FOLDS, &at)?;
        if width != widths[widths.len() - 1] {
            at = Search { level: &level, ..coarse }.refine(&asked, at, 4)?.correction;
        }
        levels.push(level);
    }
    let last = Search { level: &levels[levels.len() - 1], ..coarse };
    let (mut found, fit) = settle(&last, last.refine(&asked, at, 4)?, scan)?;
    // Where voxels lie moves the best: what is off is looked for once more on voxels that have followed.
    let finest = Level::new(scan, widths[widths.len() - 1], FOLDS, &fit.correction)?;
    let fine = Search { level: &finest, ..coarse };
    let before = fine.predict(&Correction::default())?.error;
    let (again, fit) = settle(&fine, fine.refine(&fit.active, fit.correction, 4)?, scan)?;
    found.retain(|f| again.iter().all(|a| a.parameter != f.parameter));
    found.extend(again);
    found.sort_by_key(|f| f.parameter);
    if settings.curves {
        let middle = Search { level: &levels[levels.len().saturating_sub(2)], ..coarse };
        for f in &mut found {
            f.curve = curve(&middle, f, fit.correction)?;
        }
    }
    Ok(Calibration {
        correction: fit.correction,
        held_out: [before, fit.prediction.error],
        found,
        bin: finest.bin,
        views: fit.prediction.views.len(),
    })
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

/// Takes away what the views do not tell, and what is right as it is: one after the other, the vaguest first, since what is left may
/// have been held up by it.
fn settle(fine: &Search<'_>, mut fit: Fit, scan: &Scan) -> Result<(Vec<Found>, Fit)> {
    let mut found: Vec<Found> = vec![];
    loop {
        let mut all = findings(fine, &fit, scan);
        let vagueness = |f: &&Found| f.pixels[1];
        let vaguest = |verdict| {
            let of = all.iter().filter(|f| f.verdict == verdict);
            of.max_by(|a, b| vagueness(a).total_cmp(&vagueness(b))).map(|f| f.parameter)
        };
        let Some(gone) = vaguest(Verdict::Untold).or_else(|| vaguest(Verdict::Kept)) else {
            found.append(&mut all);
            found.sort_by_key(|f| f.parameter);
            return Ok((found, fit));
        };
        found.extend(all.into_iter().filter(|f| f.parameter == gone));
        fit = fine.without(fit, gone)?;
    }
}

/// What a fit says of each of its parameters.
fn findings(fine: &Search<'_>, fit: &Fit, scan: &Scan) -> Vec<Found> {
    let of = |(&parameter, told): (&Parameter, Told)| {
        let value = fit.correction.get(parameter);
        let pixel = parameter.pixel(&fine.level.geometry);
        let deviation = told.deviation.hypot(INEXACT * pixel);
        let verdict = if !(deviation < VAGUE * pixel && told.sensitivity > FLAT) {
            Verdict::Untold
        } else if value.abs() > CLEAR * deviation {
            Verdict::Corrected
        } else {
            Verdict::Kept
        };
        let full = match parameter {
            Parameter::OffsetV => norm(scan.geometry.views[0].v),
            p => p.pixel(&scan.geometry),
        };
        Found {
            parameter,
            verdict,
            unit: parameter.unit(),
            change: value * parameter.in_unit(),
            uncertainty: deviation * parameter.in_unit(),
            pixels: [value / full, deviation / full],
            sensitivity: told.sensitivity,
            curve: vec![],
        }
    };
    fit.active.iter().zip(fine.told(fit)).map(of).collect()
}

/// The criterion along a parameter, from where it was to as far beyond what was found.
fn curve(search: &Search<'_>, found: &Found, at: Correction) -> Result<Vec<(f64, f64)>> {
    let p = found.parameter;
    let best = found.change / p.in_unit();
    let reach = (1.5 * best.abs()).max(1.5 * p.pixel(&search.level.geometry));
    let values: Vec<f64> =
        (-POINTS / 2..=POINTS / 2).map(|i| best + reach * f64::from(2 * i) / f64::from(POINTS)).collect();
    let met = search.along(p, at, &values)?;
    Ok(met.into_iter().map(|(x, e)| (x * p.in_unit(), e)).collect())
}
