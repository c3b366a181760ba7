//! JSON of this program's files.

use conefield_core::{Error, Result, written};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::Path;

/// Longest record, table or spec to read, in bytes.
pub const LONGEST: u64 = 16 << 20;

/// `value` as pretty-printed JSON.
pub fn to_json(value: &impl Serialize) -> Result<String> {
    serde_json::to_string_pretty(value).map_err(|e| Error::unsupported("writing JSON", e.to_string()))
}

/// Reads JSON written by this program.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T> {
    let text = conefield_core::files::read_text(path, LONGEST)?;
    written::read(&path.display().to_string(), &text).map_err(|e| match e {
        Error::Invalid { place, field, found, expected } => Error::invalid(
            place,
            field,
            found,
            expected + ", as conefield writes it; the command that wrote it starts over with --force",
        ),
        other => other,
    })
}
