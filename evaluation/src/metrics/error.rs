//! Metrics of the squared error: RMSE, PSNR, and the worst slice of each axis.

use crate::metrics::check;
use conefield_core::Result;
use conefield_core::parallel;
use ndarray::{ArrayView3, Axis as Along};
use serde::Serialize;

/// The axis perpendicular to a slice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Axis {
    /// First index.
    X,
    /// Second index.
    Y,
    /// Third index.
    Z,
}

/// The slice with the largest mean squared error along an axis (the first one if several share it).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WorstSlice {
    /// The axis perpendicular to the slice.
    pub axis: Axis,
    /// Index along that axis.
    pub index: usize,
    /// PSNR of this slice in dB; infinite, and `null` in JSON, if result and reference are equal.
    pub psnr: f64,
}

/// Root mean square error.
pub(crate) fn rmse(result: ArrayView3<f32>, reference: ArrayView3<f32>) -> Result<f64> {
    check::pair(result, reference, 1.0)?;
    Ok(SquaredError::of(result, reference).mean().sqrt())
}

/// Peak signal-to-noise ratio over the whole volume in dB, `10·log10(peak²/MSE)`; infinite for equal volumes.
pub fn psnr(result: ArrayView3<f32>, reference: ArrayView3<f32>, peak: f64) -> Result<f64> {
    check::pair(result, reference, peak)?;
    Ok(decibels(SquaredError::of(result, reference).mean(), peak))
}

/// PSNR from a mean squared error.
pub(crate) fn decibels(mse: f64, peak: f64) -> f64 {
    10.0 * (peak * peak / mse).log10()
}

/// Sums of squared errors over every slice of each axis.
pub(crate) struct SquaredError {
    slices: [Vec<f64>; 3],
}

impl SquaredError {
    /// One pass over both volumes, which must have the same shape.
    pub(crate) fn of(result: ArrayView3<f32>, reference: ArrayView3<f32>) -> Self {
        let (nx, ny, nz) = result.dim();
        let planes: Vec<[Vec<f64>; 2]> = parallel::map(0..nx, |_, i| {
            let (a, b) = (result.index_axis(Along(0), i), reference.index_axis(Along(0), i));
            let (mut y, mut z) = (vec![0.0; ny], vec![0.0; nz]);
            for ((a, b), y) in a.rows().into_iter().zip(b.rows()).zip(&mut y) {
                for ((&a, &b), z) in a.iter().zip(b).zip(&mut z) {
                    let d = f64::from(a) - f64::from(b);
                    *z += d * d;
                    *y += d * d;
                }
            }
            [y, z]
        });
        // Planes are added in order, whichever thread finishes first.
        let mut slices = [Vec::with_capacity(nx), vec![0.0; ny], vec![0.0; nz]];
        for [y, z] in &planes {
            slices[0].push(y.iter().sum());
            slices[1].iter_mut().zip(y).for_each(|(s, x)| *s += x);
            slices[2].iter_mut().zip(z).for_each(|(s, x)| *s += x);
        }
        Self { slices }
    }

    fn voxels(&self) -> f64 {
        self.slices.iter().map(|s| s.len() as f64).product()
    }

    /// Mean squared error of the volume.
    pub(crate) fn mean(&self) -> f64 {
        self.slices[0].iter().sum::<f64>() / self.voxels()
    }

    /// The worst slice of each axis.
    pub(crate) fn worst(&self, peak: f64) -> [WorstSlice; 3] {
        [Axis::X, Axis::Y, Axis::Z].map(|axis| {
            let sums = &self.slices[axis as usize];
            let (index, sum) =
                sums.iter().enumerate().fold((0, 0.0), |worst, (i, &s)| if s > worst.1 { (i, s) } else { worst });
            let mse = sum * sums.len() as f64 / self.voxels();
            WorstSlice { axis, index, psnr: decibels(mse, peak) }
        })
    }
}
