//! Memory for numbers, reserved in the process's allowance before it is allocated, and what all arrays must pass.

use conefield_core::finite::stray;
use conefield_core::{Error, Result, allowance};
use ndarray::{Array, Dimension};

/// Makes room in `values` for `more` of `field` of the file `place`. A growing list doubles its capacity, up to `most`
/// values, so that it is copied seldom.
pub(crate) fn grow<T>(values: &mut Vec<T>, more: usize, most: usize, place: &str, field: &str) -> Result<()> {
    if values.capacity() - values.len() >= more {
        return Ok(());
    }
    let capacity = (2 * values.len()).min(most).max(values.len() + more);
    allowance::memory(place, field, (capacity as u64).saturating_mul(size_of::<T>() as u64))?;
    values
        .try_reserve_exact(capacity - values.len())
        .map_err(|_| Error::invalid(place, field, format!("{capacity} values"), "an array that fits in memory"))
}

/// `array` in C order; the conversion briefly holds the values twice.
pub(crate) fn in_order<D: Dimension>(place: &str, field: &str, array: Array<f32, D>) -> Result<Array<f32, D>> {
    if array.is_standard_layout() {
        return Ok(array);
    }
    allowance::numbers(place, field, array.len())?;
    Ok(array.as_standard_layout().into_owned())
}

/// `array`, unless a value is not finite; `name` is what errors call the value at an index.
pub(crate) fn all_finite<D: Dimension>(
    place: &str,
    array: Array<f32, D>,
    name: &dyn Fn(D::Pattern) -> String,
) -> Result<Array<f32, D>> {
    match stray(&array) {
        Some((at, x)) => Err(Error::invalid(place, name(at), x, "a finite number")),
        None => Ok(array),
    }
}
