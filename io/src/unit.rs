//! Which unit a file is in that does not say it: the numbers tell.

use crate::rays::Agreement;
use conefield_core::Result;
use conefield_core::error::ensure;
use conefield_core::scan::Unit;

/// How the unit is known where the file names it.
pub(crate) const SAID: &str = "the file";

/// The unit of a scan and how it was decided.
pub(crate) struct Units {
    pub unit: Unit,
    /// Millimetres a length of the file.
    pub length_mm: f64,
    /// In words, for the scan's provenance.
    pub found: &'static str,
}

/// One meaning that the numbers of a file can have.
pub(crate) struct Reading {
    /// Measured line integrals over those through the volume, in lengths of the file.
    pub ratio: f64,
    pub unit: &'static str,
    pub unit_mm: f64,
    pub length_mm: f64,
    pub found: &'static str,
}

impl Reading {
    fn units(&self, found: &'static str) -> Units {
        Units { unit: Unit { name: self.unit.into(), mm: self.unit_mm }, length_mm: self.length_mm, found }
    }
}

/// Refuses a unit that is no length.
pub(crate) fn check(place: &str, unit: &Unit) -> Result<()> {
    let expected = "a positive finite number of millimetres";
    ensure(unit.mm.is_finite() && unit.mm > 0.0, place, "unit.mm", unit.mm, expected)
}

/// The reading whose ratio (to −20 % or +25 %) is the one found. The first stands where none is, with a warning, and
/// where there is nothing to compare (`otherwise` says so).
pub(crate) fn from_numbers(
    place: &str,
    agreement: Option<Agreement>,
    readings: &[Reading; 2],
    otherwise: &'static str,
) -> Units {
    let [usual, other] = readings;
    let Some(Agreement { ratio, .. }) = agreement else { return usual.units(otherwise) };
    let near = |r: &Reading| (0.8..1.25).contains(&(ratio / r.ratio));
    match readings.iter().find(|r| near(r)) {
        Some(r) => r.units(r.found),
        None => {
            tracing::warn!(
                "{place}: the projections are {ratio:.3e} times the integrals through the volume, not {} or {}: \
                 the volume may not be in the unit of the lengths",
                usual.ratio,
                other.ratio
            );
            usual.units(usual.found)
        }
    }
}
