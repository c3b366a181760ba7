//! Data terms: distance between computed and measured line integrals.

use crate::error::Result;
use crate::registry::Registered;
use crate::scan::ScanHeader;
use crate::wgsl::Fragment;
use ndarray::ArrayView3;

/// Settings of a data term.
pub trait DataTermSpec: Registered + Send + Sync {
    /// Builds the data term; fails on invalid settings.
    fn build(&self) -> Result<Box<dyn DataTerm>>;
}

crate::settings_of!(DataTerm, DataTermSpec);

/// A convex function of the residuals `r = p − A·x`, pixel by pixel, for any scan.
pub trait DataTerm: Send + Sync {
    /// The function for these measured line integrals, `[view, row, column]`, which it does not keep.
    fn of(&self, measured: ArrayView3<'_, f32>) -> Result<Box<dyn Misfit>>;

    /// Temporary memory of [`DataTerm::of`], in bytes.
    fn scratch(&self, header: &ScanHeader) -> u64 {
        let _ = header;
        0
    }

    /// Memory held for a scan of this size, in bytes.
    fn held(&self, header: &ScanHeader) -> u64 {
        let _ = header;
        0
    }

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// A data term `Σ φ_i(r_i)` of one scan. It is called for one image at a time, from many threads: view `view`, with its
/// line integrals `measured`, row by row.
pub trait Misfit: Send + Sync {
    /// Overwrites the residuals with the derivatives `φ'_i(r_i)`. Returns `Σ φ_i(r_i)`.
    fn differentiate(&self, view: usize, measured: &[f32], residuals: &mut [f32]) -> f64;

    /// Multiplies each value by an upper bound of `φ''_i`, which determines the step of a gradient method.
    fn curve(&self, view: usize, measured: &[f32], values: &mut [f32]);

    /// Multiplies each value by the standard deviation of `φ'_i` under noise, in units of [`Misfit::noise`].
    fn spread(&self, view: usize, measured: &[f32], values: &mut [f32]);

    /// The same formulas for a place with kernels: `stage_differentiate`, `stage_curve` and `stage_spread`; see
    /// [`crate::wgsl`].
    fn wgsl(&self) -> Option<Fragment> {
        None
    }

    /// Standard deviation of the noise of line integrals near 0, estimated from the scan.
    fn noise(&self) -> f64;

    /// Returns and clears the first error since the last call; see [`crate::stage::Stage::fault`].
    fn fault(&self) -> Result<()> {
        Ok(())
    }

    /// Describes what was estimated from the scan.
    fn describe(&self) -> String;
}
