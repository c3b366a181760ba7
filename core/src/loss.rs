//! Losses: distance between a predicted and a measured value.

use crate::error::Result;
use crate::wgsl::Fragment;

/// Compares a predicted with a measured value, both in the scale of the stages.
pub trait Loss: Send + Sync {
    /// The loss and its derivative by `predicted`. It is 0 if both values agree, never negative, and NaN if a value is
    /// NaN.
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64);

    /// The same in WGSL, see [`crate::wgsl`]; `None` if the loss runs on the CPU only.
    fn wgsl(&self) -> Option<Fragment> {
        None
    }

    /// Whether the loss adapts to the scan. Training then uses the result of [`Loss::fitted`].
    fn needs_scan(&self) -> bool {
        false
    }

    /// The loss for a scan with this noise; `None` if the loss does not depend on it.
    fn fitted(&self, _noise: &NoiseModel<'_>) -> Option<Box<dyn Loss>> {
        None
    }

    /// Returns an error of the calls so far, such as a panic in a plugin.
    fn fault(&self) -> Result<()> {
        Ok(())
    }

    /// A short description.
    fn describe(&self) -> String;
}

/// The noise of a scan, in the scale of the stages: a line integral `p` has the variance `sigma²·exp(growth·p)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseModel<'a> {
    /// Standard deviation for an unattenuated ray.
    pub sigma: f64,
    /// Growth of the variance with the line integral, 0 or more.
    pub growth: f64,
    /// Measured line integrals, sampled as in training.
    pub measured: &'a [f64],
}
