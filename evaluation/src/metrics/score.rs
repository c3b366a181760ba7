//! All metrics of a pair.

use crate::metrics::check;
use crate::metrics::error::{SquaredError, WorstSlice, decibels};
use crate::metrics::ssim::{gaussian_slices, gaussian_volume, uniform_slices};
use conefield_core::Result;
use ndarray::ArrayView3;
use serde::Serialize;
use std::collections::BTreeMap;

/// All metrics of a reconstruction, by name.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scores {
    /// Over the whole volume, in dB; infinite, and `null` in JSON, if result and reference are equal.
    pub psnr: f64,
    /// Root mean square error.
    pub rmse: f64,
    /// See [`crate::metrics::ssim_2d`].
    pub ssim_2d: Option<f64>,
    /// See [`crate::metrics::ssim_3d`].
    pub ssim_3d: Option<f64>,
    /// See [`crate::metrics::ssim_skimage`].
    pub ssim_skimage: Option<f64>,
    /// The slice with the largest error along x, y and z.
    pub worst_slices: [WorstSlice; 3],
    /// Reasons for missing metrics, by name.
    pub missing: BTreeMap<&'static str, String>,
}

/// Scores `result` against `reference` with the data range `peak`.
///
/// Refuses pairs of different shape, empty ones and non-finite values. A metric that is undefined for the pair (a
/// volume smaller than its window, an empty reference) is omitted with its reason in [`Scores::missing`]; the others
/// are still computed.
pub fn evaluate(result: ArrayView3<f32>, reference: ArrayView3<f32>, peak: f64) -> Result<Scores> {
    check::pair(result, reference, peak)?;
    let error = SquaredError::of(result, reference);
    let mut missing = BTreeMap::new();
    let mut known = |name, score: Result<f64>| match score {
        Ok(x) => Some(x),
        Err(why) => {
            missing.insert(name, why.to_string());
            None
        }
    };
    let ssim_2d = known("ssim_2d", gaussian_slices(result, reference, peak));
    let ssim_3d = known("ssim_3d", gaussian_volume(result, reference, peak));
    let ssim_skimage = known("ssim_skimage", uniform_slices(result, reference, peak));
    Ok(Scores {
        psnr: decibels(error.mean(), peak),
        rmse: error.mean().sqrt(),
        ssim_2d,
        ssim_3d,
        ssim_skimage,
        worst_slices: error.worst(peak),
        missing,
    })
}
