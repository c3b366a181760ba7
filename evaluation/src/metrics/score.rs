//! All metrics of a pair.

use crate::metrics::check;
use crate::metrics::error::{SquaredError, WorstSlice, decibels};
use crate::metrics::ssim;
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
    /// SSIM as reported by R2-Gaussian; the [module](crate::metrics) compares all three.
    pub ssim_2d: Option<f64>,
    /// SSIM as reported by NI-NeRF.
    pub ssim_3d: Option<f64>,
    /// SSIM by scikit-image's default per slice.
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
    let ssim_2d = known("ssim_2d", ssim::ssim_2d(result, reference, peak));
    let ssim_3d = known("ssim_3d", ssim::ssim_3d(result, reference, peak));
    let ssim_skimage = known("ssim_skimage", ssim::ssim_skimage(result, reference, peak));
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
