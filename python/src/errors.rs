//! The workspace's errors as Python exceptions with the same messages.

use conefield_core::Error;
use pyo3::prelude::*;
use std::io::ErrorKind;

/// The class in `conefield._errors` for an error.
fn class(error: &Error) -> &'static str {
    match error {
        Error::Invalid { .. } => "InvalidError",
        Error::Io { source, .. } if source.kind() == ErrorKind::NotFound => "MissingFileError",
        Error::Io { .. } => "FileError",
        Error::Unsupported { .. } => "UnsupportedError",
        Error::Device { .. } => "DeviceError",
        Error::Diverged { .. } => "DivergedError",
        Error::Interrupted { .. } | Error::Stopped { .. } | Error::Cancelled { .. } | Error::Aborted { .. } => "Error",
    }
}

/// The exception for an error. For an unusable value it also has the parts of the error as attributes.
pub fn raised(py: Python<'_>, error: &Error) -> PyErr {
    let exception = in_python(py, &error.to_string()).and_then(|text| named(py, class(error), &text));
    match (exception, error) {
        (Ok(exception), Error::Invalid { place, field, found, expected }) => {
            let parts = [("place", place), ("field", field), ("found", found), ("expected", expected)];
            match parts.into_iter().try_for_each(|(name, text)| exception.setattr(name, in_python(py, text)?)) {
                Ok(()) => PyErr::from_value(exception),
                Err(e) => e,
            }
        }
        (Ok(exception), _) => PyErr::from_value(exception),
        (Err(e), _) => e,
    }
}

/// The exception for an internal error, reported by a panic.
pub fn broken(py: Python<'_>, what: &str) -> PyErr {
    let text = format!("a bug in conefield, please report it: {what}");
    named(py, "InternalError", &text).map_or_else(|e| e, PyErr::from_value)
}

/// A message of the command as one of this package, which has arguments in place of options.
pub fn in_python(py: Python<'_>, text: &str) -> PyResult<String> {
    py.import("conefield._errors")?.call_method1("in_python", (text,))?.extract()
}

fn named<'py>(py: Python<'py>, class: &str, text: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("conefield._errors")?.getattr(class)?.call1((text,))
}

/// Converts errors to exceptions, for `?`.
pub trait OrRaise<T> {
    /// See [`raised`].
    fn or_raise(self, py: Python<'_>) -> PyResult<T>;
}

impl<T> OrRaise<T> for conefield_core::Result<T> {
    fn or_raise(self, py: Python<'_>) -> PyResult<T> {
        self.map_err(|e| raised(py, &e))
    }
}
