//! Conversion between NumPy arrays and ndarray. Inputs are copied, as Python may change an array while the work runs
//! without the GIL. Outputs are moved.

use ndarray::{Array, Dimension};
use numpy::{Element, IntoPyArray, PyArray, PyReadonlyArray};
use pyo3::prelude::*;
use serde::Serialize;

/// A copy in C order.
pub fn owned<T: Element + Clone, D: Dimension>(array: &PyReadonlyArray<'_, T, D>) -> Array<T, D> {
    array.as_array().as_standard_layout().into_owned()
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
