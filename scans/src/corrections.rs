//! Corrects the effects of detectors, tubes and scatter on line integrals. Takes a scan and returns a scan; reads no files.
//!
//! Every correction is off by default. They always run in the same order, from the detector back to the object:
//!
//! 1. `pixels`: pixels that do not measure, before another correction reads their neighbours;
//! 2. `flux`: the brightness of each view;
//! 3. `rings`: a constant offset of each pixel in all views, before a nonlinear correction changes it;
//! 4. `low-counts`: the logarithm of few photons, before anything is subtracted from them;
//! 5. `scatter`: scattered light, subtracted from the rest;
//! 6. `hardening`: the remaining line integrals of many energies;
//! 7. `truncation`: the parts beyond the detector's sides, from rows that are otherwise right.

pub(crate) mod filling;
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
pub use spectrum::WATER;
pub use truncation::Truncation;

use crate::provenance;
use conefield_core::Result;
use conefield_core::scan::Scan;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// The requested corrections, with their settings.
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

/// The result of a correction.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Applied {
    /// Its name, as in [`Corrections`].
    pub name: &'static str,
    /// All its settings.
    pub settings: Value,
    /// A summary of its findings and changes.
    pub found: String,
}

/// A correction: settings that change a scan.
trait Correct {
    /// Refuses invalid settings. Errors name a setting; [`Corrections`] puts the correction's name before it.
    fn validate(&self) -> Result<()>;

    /// Changes the scan, whose values are finite, and returns a summary.
    fn correct(&self, scan: &mut Scan) -> Result<String>;
}

impl Corrections {
    /// The requested corrections, in the order in which they run.
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

    /// Whether no correction is requested.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Largest memory in bytes in addition to a scan of `pixels` pixels, including the new scan of a wider detector.
    pub fn bytes(&self, pixels: u64) -> u64 {
        self.truncation.map_or(0, |t| (4.0 * (1.0 + 2.0 * t.share) * pixels as f64) as u64)
    }

    /// Refuses invalid settings.
    pub fn validate(&self) -> Result<()> {
        self.chosen().into_iter().try_for_each(|(name, c, _)| c.validate().map_err(|e| settings::placed(e, name)))
    }

    /// Returns the corrected scan and the results of the corrections. Adds the list `corrections` to its provenance;
    /// another call appends to it. Refuses an invalid scan, invalid settings, and a scan that a correction cannot use.
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
        let list = provenance::entry(&mut scan, "corrections");
        if list.is_null() {
            *list = json!([]);
        }
        if let Value::Array(list) = list {
            list.extend(applied.iter().map(|a| json!(a)));
        }
        Ok((scan, applied))
    }
}

#[cfg(test)]
mod tests;
