//! Measured minus predicted views.

use super::error::rmse;
use conefield_core::error::Result;
use conefield_core::finite::range;
use conefield_core::parallel;
use conefield_core::scan::Scan;
use ndarray::{Array3, Axis};
use serde::Serialize;

/// Differences between predicted and measured views.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Residual {
    /// Root mean square of measured minus predicted line integrals.
    pub rms: f64,
    /// `rms` relative to the largest measured line integral.
    pub relative: f64,
    /// Root mean square per view.
    pub views: Vec<f64>,
}

/// Replaces `views`, predicted for `scan`, by measured minus predicted line integrals, and returns their statistics.
pub fn residual(scan: &Scan, views: &mut Array3<f32>) -> Result<Residual> {
    let of_view = |(measured, found): (ndarray::ArrayView2<f32>, ndarray::ArrayView2<f32>)| {
        let [measured, found] = [measured, found].map(|a| a.insert_axis(Axis(0)));
        rmse(found, measured)
    };
    let pairs = scan.projections.outer_iter().zip(views.outer_iter());
    let each: Vec<f64> = pairs.map(of_view).collect::<Result<_>>()?;
    let rms = (each.iter().map(|x| x * x).sum::<f64>() / each.len().max(1) as f64).sqrt();
    let largest = range(&scan.projections).into_iter().fold(0.0f32, |m, x| m.max(x.abs()));
    parallel::over(views.outer_iter_mut().zip(scan.projections.outer_iter()), |_, (mut views, measured)| {
        views.zip_mut_with(&measured, |a, p| *a = p - *a);
    });
    let relative = if largest > 0.0 { rms / f64::from(largest) } else { 0.0 };
    Ok(Residual { rms, relative, views: each })
}
