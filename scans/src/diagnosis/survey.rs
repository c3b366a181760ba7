//! The complete diagnosis of a scan.

use crate::diagnosis::coverage::{VolumeCoverage, volume_coverage};
use crate::diagnosis::line_integrals::{LineIntegralCheck, check_line_integrals};
use crate::diagnosis::setup::{Setup, setup};
use crate::diagnosis::truncation::{Truncation, truncation};
use crate::diagnosis::warnings::{Warning, warnings};
use conefield_core::outside::Outside;
use conefield_core::scan::Scan;
use serde::Serialize;

/// The result of [`survey`].
#[derive(Debug, Clone, Serialize)]
pub struct Survey {
    /// Lengths and angles.
    pub setup: Setup,
    /// The part of the volume that the views see.
    pub coverage: VolumeCoverage,
    /// Whether the object extends beyond the detector's sides.
    pub truncation: Truncation,
    /// What rays beside the volume measure, as far as it exceeds `truncation.threshold`.
    pub outside: Outside,
    /// Whether the projections look like line integrals.
    pub check: LineIntegralCheck,
    /// The order of magnitude of the attenuation in 1/mm: the highest line integrals (99.9 % quantile) divided by the
    /// volume's longer side across the axis.
    pub attenuation_per_mm: f64,
    /// Problems for a reconstruction; empty if there are none.
    pub warnings: Vec<Warning>,
}

/// Surveys `scan`, whose values and geometry must be finite and consistent ([`Scan::validate`]).
pub fn survey(scan: &Scan) -> Survey {
    let g = &scan.geometry;
    let setup = setup(g);
    let coverage = volume_coverage(g, &setup);
    let check = check_line_integrals(scan.projections.view());
    let truncation = truncation(scan.projections.view(), &setup, &check);
    let outside = Outside::of(scan, truncation.threshold);
    let size = g.volume.size();
    let attenuation_per_mm = f64::from(check.typical_range[1]) / size[0].max(size[1]);
    let mut survey = Survey { setup, coverage, truncation, outside, check, attenuation_per_mm, warnings: Vec::new() };
    survey.warnings = warnings(scan, &survey);
    survey
}

#[cfg(test)]
mod tests;
