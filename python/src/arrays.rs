//! Conversion between NumPy arrays and ndarray. Inputs are copied, as Python may change an array while the work runs
//! without the GIL. Outputs are moved.

use crate::errors::OrRaise;
use conefield::memory::Memory;
use ndarray::{Array, Dimension};
use numpy::{Element, IntoPyArray, PyArray, PyReadonlyArray, PyUntypedArrayMethods};
use pyo3::prelude::*;
use serde::Serialize;

/// A copy in C order.
pub fn owned<T: Element + Clone, D: Dimension>(array: &PyReadonlyArray<'_, T, D>) -> Array<T, D> {
    array.as_array().as_standard_layout().into_owned()
}

/// See [`owned`]; refuses a large array that does not fit into memory.
pub fn fitting<T: Element + Clone, D: Dimension>(array: &PyReadonlyArray<'_, T, D>) -> PyResult<Array<T, D>> {
    check_memory((array.len() * size_of::<T>()) as u64).or_raise(array.py())?;
    Ok(owned(array))
}

/// Refuses arrays of so many bytes if they do not fit into memory: an allocation that fails ends the process.
pub fn check_memory(buffers: u64) -> conefield_core::Result<()> {
    Memory::most(&[Memory { buffers, ..Memory::default() }]).check()
}

/// Passes the array to Python without a copy.
pub fn given<T: Element, D: Dimension>(py: Python<'_>, array: Array<T, D>) -> Bound<'_, PyArray<T, D>> {
    array.into_pyarray(py)
}

/// Converts the JSON form of `value` to Python dicts, lists and numbers.
pub fn plain<'py>(py: Python<'py>, value: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    let text = serde_json::to_string(value)
        .map_err(|e| crate::errors::broken(py, &format!("a result that cannot be written as text: {e}")))?;
    py.import("json")?.call_method1("loads", (text,))
}
