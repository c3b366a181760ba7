//! Finds the unit of a file that does not name it, from its numbers.

use crate::DataSet;
use crate::rays::Agreement;
use conefield_core::Result;
use conefield_core::error::ensure;
use conefield_core::scan::{Scan, Unit, Volume};
use ndarray::Array3;
use serde_json::json;

/// Source of the unit if the file names it.
pub(crate) const SAID: &str = "the file";

/// The unit of a scan and its source.
pub(crate) struct Units {
    pub unit: Unit,
    /// Millimetres per length unit of the file.
    pub length_mm: f64,
    /// How the unit was found, in words, for the scan's provenance.
    pub found: &'static str,
}

impl Units {
    /// Gives the scans this unit, says in their provenance how it was found, and checks them; `data` is the volume on
    /// their grid.
    pub fn data_set(
        self,
        place: &str,
        mut train: Scan,
        mut test: Option<Scan>,
        data: Option<Array3<f32>>,
    ) -> Result<DataSet> {
        for s in [Some(&mut train), test.as_mut()].into_iter().flatten() {
            s.geometry = s.geometry.scaled(self.length_mm);
            s.unit = self.unit.clone();
            s.provenance["unit_from"] = json!(self.found);
            s.validate(place)?;
        }
        let volume = data.map(|data| Volume { data, grid: train.geometry.volume, affine: None });
        Ok(DataSet { train, test, volume })
    }
}

/// A possible unit of a file's numbers.
pub(crate) struct Reading {
    /// Expected ratio of measured line integrals to those through the volume, in lengths of the file.
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

/// Refuses an invalid length unit.
pub(crate) fn check(place: &str, unit: &Unit) -> Result<()> {
    let expected = "a positive finite number of millimetres";
    ensure(unit.mm.is_finite() && unit.mm > 0.0, place, "unit.mm", unit.mm, expected)
}

/// The reading whose ratio matches the measured one (to −20 % or +25 %). The first reading is the default: with a
/// warning if none matches, and with the source `otherwise` if there is nothing to compare.
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
