//! Losses: how far a predicted value is from the measured one.

use crate::error::Result;
use crate::wgsl::Fragment;

/// Compares a predicted with a measured value. Both are in the scale that stages see.
pub trait Loss: Send + Sync {
    /// The loss and its derivative by `predicted`. It is 0 where both values agree, never negative, and NaN where a
    /// value is NaN.
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64);

    /// The same in WGSL, see [`crate::wgsl`]; `None` where the loss runs on the CPU only.
    fn wgsl(&self) -> Option<Fragment> {
        None
    }

    /// Whether it learns from the scan. Training then uses what [`Loss::fitted`] returns.
    fn needs_scan(&self) -> bool {
        false
    }

    /// The loss for a scan with this noise; `None` where the loss learns nothing from it.
    fn fitted(&self, _noise: &NoiseModel<'_>) -> Option<Box<dyn Loss>> {
        None
    }

    /// An error of the calls so far, such as a panic in a plugin.
    fn fault(&self) -> Result<()> {
        Ok(())
    }

    /// A few words for people.
    fn describe(&self) -> String;
}

/// The noise of a scan, in the scale that stages see: a line integral `p` has the variance `sigma²·exp(growth·p)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseModel<'a> {
    /// Standard deviation where nothing is in the way.
    pub sigma: f64,
    /// How the variance grows with the line integral, 0 or more.
    pub growth: f64,
    /// Measured line integrals, drawn as training draws them.
    pub measured: &'a [f64],
}
