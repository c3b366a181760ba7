//! Penalized weighted least squares: `½Σ w·r²`, where the weights w are inverse variances of the measured values up to
//! a factor (Fessler, IEEE Trans. Image Process. 3(4), 1994), from the noise that [`Noise`] finds in the scan.

use crate::iterative::noise::{self, Noise};
use conefield_core::data_term::{DataTerm, DataTermSpec, Misfit};
use conefield_core::error::Result;
use conefield_core::scan::ScanHeader;
use ndarray::ArrayView3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `noise-weighted`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct NoiseWeighted {}

conefield_core::stage_type!(
    DataTermSpec,
    "noise-weighted",
    NoiseWeighted,
    "squared residuals divided by the noise variance of the measured values"
);

impl DataTermSpec for NoiseWeighted {
    fn build(&self) -> Result<Box<dyn DataTerm>> {
        Ok(Box::new(*self))
    }
}

impl DataTerm for NoiseWeighted {
    fn of(&self, measured: ArrayView3<'_, f32>) -> Result<Box<dyn Misfit>> {
        Ok(Box::new(Noise::of(measured, true)))
    }

    fn scratch(&self, header: &ScanHeader) -> u64 {
        noise::scratch(header)
    }

    fn describe(&self) -> String {
        "noise-weighted: noisier values count less".into()
    }
}
