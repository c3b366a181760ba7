//! The command line.

use pyo3::prelude::*;
use std::ffi::OsString;

/// Runs a command line, as the program `conefield` does, and returns its exit status. Only for processes that do
/// nothing else: the command sets up signals, log and threads, and may end the process. `program` are the words that
/// start another such process.
#[pyfunction]
pub fn command(py: Python<'_>, words: Vec<OsString>, program: Vec<OsString>) -> u8 {
    py.detach(|| conefield_cli::run(words, Some(program)))
}
