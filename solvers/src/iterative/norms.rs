//! Norms of arrays, independent of the number of threads on the host.

use conefield_core::error::Result;
use conefield_core::place::{Array, Place, Reduction};

/// `‖x‖²`.
pub(crate) fn norm2(place: &dyn Place, x: &Array) -> Result<f64> {
    place.reduce(Reduction::Squares, x, x)
}

/// `‖x − y‖`.
pub(crate) fn distance(place: &dyn Place, x: &Array, y: &Array) -> Result<f64> {
    Ok(place.reduce(Reduction::Differences, x, y)?.sqrt())
}

/// Root mean square of `x − before`, relative to that of `x`.
pub(crate) fn change(place: &dyn Place, x: &Array, before: &Array) -> Result<f64> {
    Ok(distance(place, x, before)? / norm2(place, x)?.max(1e-300).sqrt())
}
