//! Mends what detectors, tubes and scatter do to line integrals: a scan comes in, a scan goes out, no file is read.
//!
//! Every correction is off unless it is asked for. They run in one order, whatever order they are asked for in, from the
//! detector back to the object:
//!
//! 1. `pixels`: pixels that do not measure, before anything reads their neighbours;
//! 2. `flux`: the brightness of each view;
//! 3. `rings`: what a pixel adds to every view, which is one number a pixel only as long as nothing has bent the values;
//! 4. `low-counts`: the logarithm of few photons, before anything is subtracted from them;
//! 5. `scatter`: light that did not come straight, which is subtracted from the rest;
//! 6. `hardening`: what is left are the line integrals of many energies;
//! 7. `truncation`: what the detector's sides cut off, of rows that are right otherwise.

pub mod filling;
mod flux;
mod hardening;
mod low_counts;
mod pixels;
mod rings;
mod scatter;
mod settings;
mod smooth;
mod spectrum;
mod truncation;

pub use flux::Flux;
pub use hardening::{Hardening, Water};
pub use low_counts::LowCounts;
pub use pixels::Pixels;
pub use rings::{RingMethod, Rings};
pub use scatter::Scatter;
pub use truncation::Truncation;

use conefield_core::Result;
use conefield_core::scan::Scan;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// The corrections that are asked for, with their settings.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, rename_all = "kebab-case")]
pub struct Corrections {
    /// Dead, hot and flickering pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pixels: Option<Pixels>,
    /// The brightness of each view.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub flux: Option<Flux>,
    /// Ring artefacts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rings: Option<Rings>,
    /// The logarithm of few photons.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub low_counts: Option<LowCounts>,
    /// Scattered light.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scatter: Option<Scatter>,
    /// Beam hardening.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hardening: Option<Hardening>,
    /// Objects that are wider than the detector.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truncation: Option<Truncation>,
}

/// What a correction did.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Applied {
    /// Its name, as in [`Corrections`].
    pub name: &'static str,
    /// All its settings.
    pub settings: Value,
    /// What it found and changed, in words.
    pub found: String,
}

/// A correction: settings that change a scan.
trait Correct {
    /// Refuses settings that mean nothing. Errors name a setting; [`Corrections`] puts the correction's name before it.
    fn validate(&self) -> Result<()>;

    /// Changes the scan, whose values are finite, and tells what it found.
    fn correct(&self, scan: &mut Scan) -> Result<String>;
}

impl Corrections {
    /// Those that are asked for, in the order in which they run.
    fn chosen(&self) -> Vec<(&'static str, &dyn Correct, Value)> {
        fn one<'a, T: Correct + Serialize>(
            name: &'static str,
            settings: &'a Option<T>,
        ) -> Option<(&'static str, &'a dyn Correct, Value)> {
            settings.as_ref().map(|s| (name, s as &dyn Correct, json!(s)))
        }
        let all = [
            one("pixels", &self.pixels),
            one("flux", &self.flux),
            one("rings", &self.rings),
            one("low-counts", &self.low_counts),
            one("scatter", &self.scatter),
            one("hardening", &self.hardening),
            one("truncation", &self.truncation),
        ];
        all.into_iter().flatten().collect()
    }

    /// Whether none is asked for.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Bytes that they take at most beside a scan of so many `pixels`, the new scan of a wider detector included.
    pub fn bytes(&self, pixels: u64) -> u64 {
        let over_time = if self.pixels.is_some() { 4 * pixels } else { 0 };
        let wider = self.truncation.map_or(0, |t| (4.0 * (1.0 + 2.0 * t.share) * pixels as f64) as u64);
        over_time.max(wider)
    }

    /// Refuses settings that mean nothing.
    pub fn validate(&self) -> Result<()> {
        self.chosen().into_iter().try_for_each(|(name, c, _)| c.validate().map_err(|e| settings::placed(e, name)))
    }

    /// The corrected scan and what was done. Its provenance gets the list `corrections`, to which another call appends. Refuses
    /// a scan that is none, settings that mean nothing, and a scan that a correction has no use for, in words.
    pub fn apply(&self, mut scan: Scan, place: &str) -> Result<(Scan, Vec<Applied>)> {
        if self.is_none() {
            return Ok((scan, vec![]));
        }
        self.validate()?;
        scan.validate(place)?;
        let mut applied = Vec::new();
        for (name, correction, settings) in self.chosen() {
            let found = correction.correct(&mut scan).map_err(|e| settings::placed(e, name))?;
            applied.push(Applied { name, settings, found });
        }
        scan.validate(place)?;
        note(&mut scan, &applied);
        Ok((scan, applied))
    }
}

/// Keeps in the scan what was done to it.
fn note(scan: &mut Scan, applied: &[Applied]) {
    let map = match &mut scan.provenance {
        Value::Object(map) => map,
        Value::Null => {
            scan.provenance = json!({});
            return note(scan, applied);
        }
        other => {
            scan.provenance = json!({ "value": other.take() });
            return note(scan, applied);
        }
    };
    let list = map.entry("corrections").or_insert_with(|| json!([]));
    if let Value::Array(list) = list {
        list.extend(applied.iter().map(|a| json!(a)));
    }
}

#[cfg(test)]
mod tests;
