//! Least squares: `½Σ r²`.

use crate::iterative::noise::Squares;
use conefield_core::data_term::{DataTerm, DataTermSpec};
use conefield_core::error::Result;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `least-squares`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LeastSquares {}

conefield_core::stage_type!(DataTermSpec, "least-squares", LeastSquares, "squared residuals with equal weights");

impl DataTermSpec for LeastSquares {
    fn build(&self) -> Result<Box<dyn DataTerm>> {
        Ok(Box::new(Squares { growing: false, text: "least-squares: all values of the same weight" }))
    }
}
