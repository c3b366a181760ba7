//! Refuses inputs on which no metric can be computed, before any work.

use conefield_core::error::{Error, Result, ensure};
use conefield_core::finite::stray;
use ndarray::ArrayView3;

const PLACE: &str = "metrics";

/// Refuses pairs of different shape, empty ones, non-finite values and a peak that is not a data range.
pub(crate) fn pair(result: ArrayView3<f32>, reference: ArrayView3<f32>, peak: f64) -> Result<()> {
    ensure(
        result.shape() == reference.shape(),
        PLACE,
        "shape of the result",
        format!("{:?}", result.shape()),
        format!("{:?}, the shape of the reference", reference.shape()),
    )?;
    ensure(!result.is_empty(), PLACE, "shape", format!("{:?}", result.shape()), "at least one voxel per axis")?;
    ensure(peak.is_finite() && peak > 0.0, PLACE, "peak", peak, "a positive finite data range")?;
    finite(result, "result")?;
    finite(reference, "reference")
}

fn finite(volume: ArrayView3<f32>, name: &str) -> Result<()> {
    match stray(&volume) {
        Some(((i, j, k), x)) => Err(Error::invalid(PLACE, format!("{name}[{i}, {j}, {k}]"), x, "a finite value")),
        None => Ok(()),
    }
}

/// Refuses, in the name of `metric`, volumes with an axis shorter than its window.
pub(crate) fn window(metric: &str, shape: &[usize], window: usize) -> Result<()> {
    ensure(
        shape.iter().all(|&n| n >= window),
        metric,
        "shape",
        format!("{shape:?}"),
        format!("at least {window} voxels along each axis, the size of the window"),
    )
}

/// Largest value, in units of the data range, whose square leaves the constants of an SSIM significant.
const SSIM_REACH: f64 = 1e4;

/// Refuses, in the name of `metric`, values so far beyond the data range that rounding would dominate.
pub(crate) fn reach(metric: &str, result: ArrayView3<f32>, reference: ArrayView3<f32>, peak: f64) -> Result<()> {
    let top = [result, reference].iter().flatten().fold(0.0f32, |m, x| m.max(x.abs()));
    let found = format!("values to {top:e} for a data range of {peak}");
    ensure(f64::from(top) <= SSIM_REACH * peak, metric, "values", found, format!("at most {SSIM_REACH:e} times it"))
}
