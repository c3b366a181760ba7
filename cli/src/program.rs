//! How this program starts itself: for work in separate processes, and in scripts.

use conefield_core::{Error, Result};
use std::ffi::OsString;
use std::process::Command;
use std::sync::OnceLock;

/// The words that start the program, if it is not an executable of its own, and the arguments of this process.
static STARTED: OnceLock<Started> = OnceLock::new();

struct Started {
    program: Option<Vec<OsString>>,
    arguments: Vec<OsString>,
}

/// Remembers how this process was started. The first call counts.
pub fn note(program: Option<Vec<OsString>>, arguments: Vec<OsString>) {
    let _ = STARTED.set(Started { program, arguments });
}

/// The words that start this program: the executable, or an interpreter and its arguments.
pub fn words() -> Result<Vec<OsString>> {
    match STARTED.get().and_then(|s| s.program.clone()) {
        Some(words) => Ok(words),
        None => Ok(vec![std::env::current_exe().map_err(|e| Error::io("conefield", e))?.into()]),
    }
}

/// Starts this program; the caller adds arguments.
pub fn command() -> Result<Command> {
    let words = words()?;
    let mut command = Command::new(&words[0]);
    command.args(&words[1..]);
    Ok(command)
}

/// The arguments of this process, without the program's name.
pub fn arguments() -> &'static [OsString] {
    STARTED.get().map_or(&[], |s| &s.arguments)
}
