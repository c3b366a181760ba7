//! What a scan itself tells of its geometry, without a phantom.
//!
//! [`calibrate`] looks for the [`Correction`] under which views that are kept aside are predicted best from a quick
//! reconstruction of the others (ordered subsets of SART, three passes). It goes from coarse to fine, in pixels and voxels and in how
//! far it looks ([`search`]). The criterion needs no marker and no symmetry: it holds for truncated objects, offset detectors and
//! short scans as well.

mod criterion;
mod parameters;
mod search;

pub use parameters::{Correction, Parameter, turns};
pub use search::Watch;

use conefield_core::backend::Backend;
use conefield_core::error::{Result, ensure};
use conefield_core::scan::Scan;
use criterion::Level;
use search::{Fit, Meter, Search};
use serde::Serialize;
use std::sync::Mutex;

/// Fewer views are not enough to keep any aside.
const FEWEST: usize = 8;
/// Pixels along the longer side of the detector of the coarsest level; each next has twice as many.
const COARSEST: usize = 32;
/// Standard deviations from which a parameter counts as off.
const CLEAR: f64 = 3.0;
/// A parameter whose deviation is more than so many pixels of the finest level is not told, nor is one with less sensitivity.
const VAGUE: f64 = 1.0;
const FLAT: f64 = 0.03;
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
        Self { parameters: vec![Parameter::OffsetU, Parameter::OffsetV, Parameter::Rotation], width: 128, curves: true }
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
    let levels = levels(scan, settings.width)?;
    let meter = Meter { watch, total: planned(&levels, settings), done: Mutex::new(0.0) };
    let search = |level| Search { level, backend, meter: &meter };
    let mut asked = settings.parameters.clone();
    asked.sort_unstable();
    asked.dedup();

    let mut at = Correction::default();
    let coarse = search(&levels[0]);
    // Half a detector, or as far as anything can reasonably be off.
    let ranges = [(Parameter::OffsetU, 1.0, 5, 14), (Parameter::Rotation, 0.5, 4, 16), (Parameter::OffsetV, 1.0, 5, 10)];
    for (parameter, pixels, steps, most) in ranges.into_iter().filter(|r| asked.contains(&r.0)) {
        at = coarse.look(parameter, at, pixels, steps, most)?;
    }
    let (finest, coarser) = levels.split_last().unwrap_or_else(|| unreachable!("there is a level"));
    for level in coarser {
        at = search(level).refine(&asked, at, 4)?.correction;
    }
    let fine = search(finest);
    let before = fine.predict(&Correction::default())?.error;
    let fit = fine.refine(&asked, at, 4)?;
    let (found, fit) = settle(&fine, &asked, fit, scan)?;
    let mut found = found;
    let after = fit.prediction.error;
    if settings.curves {
        let middle = search(&levels[levels.len().saturating_sub(2)]);
        for f in &mut found {
            f.curve = curve(&middle, f, fit.correction)?;
        }
    }
    Ok(Calibration {
        correction: fit.correction,
        found,
        held_out: [before, after],
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
    let found = calibrate(scan, &Settings { parameters, width: 2 * COARSEST, curves: false }, backend, watch)?;
    let [before, after] = found.held_out;
    let off = |f: &Found| f.verdict == Verdict::Corrected && f.pixels[0].abs() > WORTH;
    Ok((after < LOWER * before && found.found.iter().any(off)).then_some(found))
}

/// What the whole search takes, about.
fn planned(levels: &[Level], settings: &Settings) -> f64 {
    let n = settings.parameters.len() as f64;
    let Some((finest, coarser)) = levels.split_last() else { return 1.0 };
    // Looks along three parameters; three rounds a level; another for what is settled.
    let looks = 31.0 * levels[0].work();
    let rounds: f64 = coarser.iter().map(|l| 3.0 * (2.0 * n + 1.0) * l.work()).sum();
    let fine = (3.0 * (2.0 * n + 1.0) + 2.0 * n) * finest.work();
    let curves = if settings.curves { n * f64::from(POINTS + 1) * levels[levels.len().saturating_sub(2)].work() } else { 0.0 };
    looks + rounds + fine + curves
}

/// From coarse to fine; the finest has about `width` pixels along the detector's longer side.
fn levels(scan: &Scan, width: usize) -> Result<Vec<Level>> {
    let mut all: Vec<Level> = vec![];
    let mut w = COARSEST.min(width);
    loop {
        let level = Level::new(scan, w, 2)?;
        if all.last().is_none_or(|last| level.bin < last.bin) {
            all.push(level);
        }
        if w >= width {
            return Ok(all);
        }
        w = (2 * w).min(width);
    }
}

/// Takes away what the views do not tell, and what is right as it is, and fits the rest again.
fn settle(fine: &Search<'_>, asked: &[Parameter], mut fit: Fit, scan: &Scan) -> Result<(Vec<Found>, Fit)> {
    let mut active = asked.to_vec();
    let mut found: Vec<Found> = vec![];
    loop {
        let told = |i: usize, p: Parameter| {
            let (value, told) = (fit.correction.get(p), fit.told[i]);
            let pixel = p.pixel(&fine.level.geometry);
            let vague = told.deviation > VAGUE * pixel || told.sensitivity < FLAT || !told.deviation.is_finite();
            let verdict = match vague {
                true => Verdict::Untold,
                false if value.abs() > CLEAR * told.deviation => Verdict::Corrected,
                false => Verdict::Kept,
            };
            let full = p.pixel(&scan.geometry);
            Found {
                parameter: p,
                verdict,
                unit: p.unit(),
                change: value * p.in_unit(),
                uncertainty: told.deviation * p.in_unit(),
                pixels: [value / full, told.deviation / full],
                sensitivity: told.sensitivity,
                curve: vec![],
            }
        };
        let all: Vec<Found> = active.iter().enumerate().map(|(i, &p)| told(i, p)).collect();
        // Of those that are not corrected the vaguest goes first.
        let vague = |f: &Found| f.uncertainty / (f.parameter.pixel(&scan.geometry) * f.parameter.in_unit());
        let out = all.iter().filter(|f| f.verdict == Verdict::Untold).max_by(|a, b| vague(a).total_cmp(&vague(b)));
        let kept = all.iter().filter(|f| f.verdict == Verdict::Kept).max_by(|a, b| vague(a).total_cmp(&vague(b)));
        let Some(gone) = out.or(kept) else {
            found.extend(all);
            found.sort_by_key(|f| f.parameter);
            return Ok((found, fit));
        };
        let gone = gone.clone();
        active.retain(|p| *p != gone.parameter);
        let start = fit.correction.with(gone.parameter, 0.0);
        found.push(gone);
        fit = fine.refine(&active, start, 2)?;
    }
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
