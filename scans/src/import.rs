//! Scans as methods need them: line integrals, whatever the files hold.

use crate::corrections::{Applied, Corrections};
use crate::counts::{CountsReport, line_integrals};
use crate::selection::{Mean, Selection};
use conefield_core::Result;
use conefield_core::scan::Scan;
use conefield_io::{Counts, DataSet, I0, Parts, Stored};
use serde_json::json;
use std::path::Path;

/// Options that override the description, corrections, and the part of the scan to keep.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImportOptions {
    /// Replaces the file's `i0` and flat field.
    pub i0: Option<I0>,
    /// Replaces the file's `floor`.
    pub floor: Option<f64>,
    /// Corrections, applied after the conversion of counts and before the selection.
    pub corrections: Corrections,
    /// The part of the scan to keep. Counts are converted first, so that bad pixels use all their neighbours and air is
    /// found at the border of the whole detector. Larger pixels then hold the mean light, as they would have measured
    /// it; if the files hold line integrals, their mean.
    pub selection: Selection,
}

/// The result of [`import`].
#[derive(Debug, Clone)]
pub struct Imported {
    /// The scan, in mm.
    pub scan: Scan,
    /// Statistics of the conversion from counts; `None` if the files hold line integrals.
    pub counts: Option<CountsReport>,
    /// The corrections applied.
    pub corrections: Vec<Applied>,
}

/// Reads the scan that a scanner's description `path` describes (see [`conefield_io::read_scanner`]), converts counts,
/// corrects the scan and selects a part of it.
pub fn import(path: impl AsRef<Path>, options: &ImportOptions) -> Result<Imported> {
    let place = path.as_ref().display().to_string();
    let (scan, counts) = match conefield_io::read_scanner(path, options.i0, options.floor)? {
        Stored::Scan(scan) => (scan, None),
        Stored::Counts(counts) => converted(counts).map(|(scan, report)| (scan, Some(report)))?,
    };
    let (scan, corrections) = options.corrections.apply(scan, &place)?;
    let mean = if counts.is_some() { Mean::Light } else { Mean::LineIntegrals };
    let scan = options.selection.take(scan, mean)?;
    Ok(Imported { scan, counts, corrections })
}

/// Reads a scan of any format of [`conefield_io::read_scan`] and converts counts.
pub fn read_scan(path: impl AsRef<Path>) -> Result<Scan> {
    conefield_io::read_scan(path).and_then(integrals)
}

/// Reads a scan and `parts` of its file or folder (see [`conefield_io::read_data_set`]), and converts counts.
pub fn read_data_set(path: impl AsRef<Path>, parts: Parts) -> Result<DataSet> {
    let DataSet { train, test, volume } = conefield_io::read_data_set(path, parts)?;
    Ok(DataSet { train: integrals(train)?, test, volume })
}

fn integrals(stored: Stored) -> Result<Scan> {
    match stored {
        Stored::Scan(scan) => Ok(scan),
        Stored::Counts(counts) => converted(counts).map(|(scan, _)| scan),
    }
}

fn converted(mut counts: Counts) -> Result<(Scan, CountsReport)> {
    let values = std::mem::take(&mut counts.values);
    let (a, report) = line_integrals(values, &counts.conversion, counts.place())?;
    let scan = counts.scan(a, json!(report))?;
    Ok((scan, report))
}
