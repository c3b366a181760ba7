//! Fourier transforms in one dimension, of any length.
//!
//! `rustfft` is generic: each crate that calls it compiles it anew, 2 MB of machine code. This crate has no generic
//! function, so that happens once.

pub use rustfft::Fft;
pub use rustfft::num_complex::Complex;

use rustfft::{FftPlanner, FftPlannerScalar};
use std::sync::Arc;

/// The transform of rows of `length` values and its inverse, in single precision. Neither divides by `length`.
pub fn pair_f32(length: usize) -> [Arc<dyn Fft<f32>>; 2] {
    let mut planner = FftPlanner::new();
    [planner.plan_fft_forward(length), planner.plan_fft_inverse(length)]
}

/// The transform of rows of `length` values in double precision.
pub fn forward_f64(length: usize) -> Arc<dyn Fft<f64>> {
    FftPlannerScalar::new().plan_fft_forward(length)
}
