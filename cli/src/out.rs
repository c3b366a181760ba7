//! Results on standard output, for people and for programs.

use conefield_core::{Error, Result};
pub use conefield_report::text::{bytes, duration, number, table};
pub use conefield_tradeoff::json::to_json;
use serde::Serialize;
use std::io::{ErrorKind, Write};

/// Prints `text` and a line end. A reader that has gone away (`| head`) is no failure.
pub fn say(text: &str) -> Result<()> {
    match writeln!(std::io::stdout(), "{text}") {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(Error::io("standard output", e)),
        _ => Ok(()),
    }
}

/// Prints one JSON object.
pub fn json(value: &impl Serialize) -> Result<()> {
    say(&to_json(value)?)
}
