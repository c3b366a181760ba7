//! The workspace's errors as exceptions, with the same words.

use conefield_core::Error;
use pyo3::prelude::*;
use std::io::ErrorKind;

/// Which class of `conefield._errors` an error is.
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

/// The exception of an error. That of a value that cannot be used also has its parts.
pub fn raised(py: Python<'_>, error: &Error) -> PyErr {
    let exception = named(py, class(error), &error.to_string());
    match (exception, error) {
        (Ok(exception), Error::Invalid { place, field, found, expected }) => {
            let parts = [("place", place), ("field", field), ("found", found), ("expected", expected)];
            match parts.into_iter().try_for_each(|(name, text)| exception.setattr(name, text)) {
                Ok(()) => PyErr::from_value(exception),
                Err(e) => e,
            }
        }
        (Ok(exception), _) => PyErr::from_value(exception),
        (Err(e), _) => e,
    }
}

/// The exception of a fault of the program itself, which a panic has told of.
pub fn broken(py: Python<'_>, what: &str) -> PyErr {
    let text = format!("a bug in conefield, please report it: {what}");
    named(py, "InternalError", &text).map_or_else(|e| e, PyErr::from_value)
}

fn named<'py>(py: Python<'py>, class: &str, text: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("conefield._errors")?.getattr(class)?.call1((text,))
}

/// For `?`: the result of work, with its error as an exception.
pub trait OrRaise<T> {
    /// See [`raised`].
    fn or_raise(self, py: Python<'_>) -> PyResult<T>;
}

impl<T> OrRaise<T> for conefield_core::Result<T> {
    fn or_raise(self, py: Python<'_>) -> PyResult<T> {
        self.map_err(|e| raised(py, &e))
    }
}
