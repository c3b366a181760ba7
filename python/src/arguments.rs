//! Arguments passed from Python as JSON, parsed like those of the command line.

use crate::errors::raised;
use conefield::backend::BackendChoice;
use conefield::parse::{self, HoldOut};
use conefield_core::error::{Error, Result, ensure};
use pyo3::prelude::*;
use serde::de::DeserializeOwned;

/// The arguments in `text`, which the package itself has written.
pub fn read<T: DeserializeOwned>(py: Python<'_>, text: &str) -> PyResult<T> {
    serde_json::from_str(text)
        .map_err(|e| raised(py, &Error::invalid("arguments", "values", e, "numbers and texts of the documented kinds")))
}

/// An argument in command-line syntax.
pub fn parsed<T>(name: &str, text: &str, parse: impl Fn(&str) -> Result<T, String>) -> Result<T> {
    parse(text)
        .map_err(|why| Error::invalid("arguments", name, format!("{text:?}"), why.trim_start_matches("expected ")))
}

/// See [`parsed`]; `None` stays `None`.
pub fn optional<T>(name: &str, text: Option<&String>, parse: impl Fn(&str) -> Result<T, String>) -> Result<Option<T>> {
    text.map(|t| parsed(name, t, parse)).transpose()
}

/// The compute backend.
pub fn backend(text: &str) -> Result<BackendChoice> {
    parsed("backend", text, |t| t.parse())
}

/// Seconds.
pub fn seconds(name: &str, text: Option<&String>) -> Result<Option<f64>> {
    optional(name, text, parse::seconds)
}

/// A data range.
pub fn peak(peak: Option<f64>) -> Result<Option<f64>> {
    let good = peak.is_none_or(|p| p > 0.0 && p.is_finite());
    ensure(good, "arguments", "peak", peak.unwrap_or(0.0), "a number above 0")?;
    Ok(peak)
}

/// Indices of the held-out views, of `n`.
pub fn held_out(text: Option<&String>, n: usize) -> Result<Vec<usize>> {
    let choice: Option<HoldOut> = optional("hold_out", text, parse::hold_out)?;
    conefield::input::held_out(choice.as_ref(), n, "arguments", "hold_out")
}

/// Indices of views, of `n`: as given, or where a mask is true.
pub fn views(value: &Bound<'_, PyAny>, name: &str, n: usize) -> PyResult<Vec<usize>> {
    value.py().import("conefield._arrays")?.call_method1("views", (value, name, n))?.extract()
}
