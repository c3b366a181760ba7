//! Norms of arrays, independent of the number of threads.

use super::flat;
use ndarray::Array3;
use rayon::prelude::*;

/// Numbers per partial sum.
const PART: usize = 1 << 16;

/// Sum of squares.
pub fn square_sum(x: &[f32]) -> f64 {
    let parts: Vec<f64> =
        x.par_chunks(PART).map(|c| c.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>()).collect();
    parts.iter().sum()
}

/// Sum of the squares of `x − y`.
pub fn difference_square_sum(x: &[f32], y: &[f32]) -> f64 {
    let square = |(a, b): (&f32, &f32)| (f64::from(*a) - f64::from(*b)).powi(2);
    let parts: Vec<f64> =
        x.par_chunks(PART).zip(y.par_chunks(PART)).map(|(x, y)| x.iter().zip(y).map(square).sum::<f64>()).collect();
    parts.iter().sum()
}

/// `‖x‖²`.
pub(crate) fn norm2(x: &Array3<f32>) -> f64 {
    square_sum(flat(x))
}

/// `‖x − y‖`.
pub(crate) fn distance(x: &Array3<f32>, y: &Array3<f32>) -> f64 {
    difference_square_sum(flat(x), flat(y)).sqrt()
}

/// Root mean square of `x − before`, relative to that of `x`.
pub(crate) fn change(x: &Array3<f32>, before: &Array3<f32>) -> f64 {
    distance(x, before) / norm2(x).max(1e-300).sqrt()
}
