//! Least squares: `½Σ r²`.

use crate::iterative::noise::{self, Noise};
use conefield_core::data_term::{DataTerm, DataTermSpec, Misfit};
use conefield_core::error::Result;
use conefield_core::scan::ScanHeader;
use ndarray::ArrayView3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `least-squares`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LeastSquares {}

conefield_core::stage_type!(DataTermSpec, "least-squares", LeastSquares, "squared residuals with equal weights");

impl DataTermSpec for LeastSquares {
    fn build(&self) -> Result<Box<dyn DataTerm>> {
        Ok(Box::new(*self))
    }
}

impl DataTerm for LeastSquares {
    fn of(&self, measured: ArrayView3<'_, f32>) -> Result<Box<dyn Misfit>> {
        Ok(Box::new(Noise::of(measured, false)))
    }

    fn scratch(&self, header: &ScanHeader) -> u64 {
        noise::scratch(header)
    }

    fn describe(&self) -> String {
        "least-squares: all values of the same weight".into()
    }
}
