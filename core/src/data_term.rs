//! How far line integrals are from the measured ones.

use crate::error::Result;
use crate::scan::ScanHeader;
use ndarray::ArrayView3;

/// Settings of a data term.
#[typetag::serde(tag = "type")]
pub trait DataTermSpec: Send + Sync {
    /// The data term, or why the settings make none.
    fn build(&self) -> Result<Box<dyn DataTerm>>;
}

/// A convex function of the residuals `r = p − A·x`, pixel by pixel, for any scan.
pub trait DataTerm: Send + Sync {
    /// The function for these measured line integrals, `[view, row, column]`. They are only looked at.
    fn of(&self, measured: ArrayView3<'_, f32>) -> Result<Box<dyn Misfit>>;

    /// Bytes that [`DataTerm::of`] takes for a moment.
    fn scratch(&self, header: &ScanHeader) -> u64 {
        let _ = header;
        0
    }

    /// Bytes that it holds for a scan of this size.
    fn held(&self, header: &ScanHeader) -> u64 {
        let _ = header;
        0
    }

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// A data term `Σ φ_i(r_i)` of one scan. It is asked for an image at a time, from many threads: of the view `view`, whose
/// line integrals `measured` were found, row by row.
pub trait Misfit: Send + Sync {
    /// Overwrites the residuals with the derivatives `φ'_i(r_i)`. Returns `Σ φ_i(r_i)`.
    fn differentiate(&self, view: usize, measured: &[f32], residuals: &mut [f32]) -> f64;

    /// Multiplies each value by an upper bound of `φ''_i`: what the step of a gradient method follows from.
    fn curve(&self, view: usize, measured: &[f32], values: &mut [f32]);

    /// Multiplies each value by the standard deviation that noise gives `φ'_i`, in units of [`Misfit::noise`].
    fn spread(&self, view: usize, measured: &[f32], values: &mut [f32]);

    /// Standard deviation of the noise of line integrals near 0, from the scan.
    fn noise(&self) -> f64;

    /// What it could not do since this was last asked, as [`crate::stage::Stage::fault`].
    fn fault(&self) -> Result<()> {
        Ok(())
    }

    /// What was found in the scan.
    fn describe(&self) -> String;
}
