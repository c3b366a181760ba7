//! Penalized weighted least squares: `½Σ w·r²`, where the weights w are inverse variances of the measured values up to
//! a factor (Fessler, IEEE Trans. Image Process. 3(4), 1994), from the noise that is found in the scan.

use crate::iterative::noise::Squares;
use conefield_core::data_term::{DataTerm, DataTermSpec};
use conefield_core::error::Result;
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
        Ok(Box::new(Squares { growing: true, text: "noise-weighted: noisier values count less" }))
    }
}
