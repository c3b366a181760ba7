//! The error that every crate of conefield returns.
//!
//! A message names the place (file, spec or stage), the field, the value found and the value expected.

use std::path::{Path, PathBuf};

/// All errors, in words that a user can act on.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// An unusable value: its place, the value and what is expected.
    #[error("{place}: {field}: found {found}, expected {expected}")]
    Invalid {
        /// File, spec or stage that holds the value.
        place: String,
        /// Name of the field, or path to it.
        field: String,
        /// What was found.
        found: String,
        /// What would be accepted.
        expected: String,
    },
    /// An error of the operating system.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        #[source]
        source: std::io::Error,
    },
    /// A request that this build or this pipeline cannot fulfil.
    #[error("{what}: {why}")]
    Unsupported {
        /// The request.
        what: String,
        /// The reason, and the alternative.
        why: String,
    },
    /// The run was interrupted by the user.
    #[error("interrupted after step {step}")]
    Interrupted {
        /// The last finished step.
        step: u64,
    },
    /// The user interrupted a task of several parts.
    #[error("interrupted during {part}; the same command with --resume continues")]
    Stopped {
        /// The unfinished part.
        part: String,
    },
    /// The user interrupted writing a file.
    #[error("{place}: interrupted while writing; nothing was replaced")]
    Cancelled {
        /// The file.
        place: String,
    },
    /// The user interrupted a task that leaves nothing behind.
    #[error("interrupted during {part}")]
    Aborted {
        /// The interrupted part.
        part: String,
    },
    /// A compute device failed or was lost.
    #[error("{device}: {what}")]
    Device {
        /// Its name.
        device: String,
        /// What happened.
        what: String,
    },
    /// Training produced non-finite numbers.
    #[error("training diverged at step {step}: {what}")]
    Diverged {
        /// The step at which it was detected.
        step: u64,
        /// What was not finite.
        what: String,
    },
}

/// Result with conefield's [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// An unusable value; see [`Error::Invalid`].
    pub fn invalid(place: impl ToString, field: impl ToString, found: impl ToString, expected: impl ToString) -> Self {
        Self::of([&place, &field, &found, &expected])
    }

    /// [`Error::invalid`], compiled once for all types of its parts.
    #[cold]
    fn of(parts: [&dyn ToString; 4]) -> Self {
        let [place, field, found, expected] = parts.map(|part| part.to_string());
        Self::Invalid { place, field, found, expected }
    }

    /// The same error with `key` prepended to the field of a spec. The owner of a stage calls this, as a stage does not
    /// know its own path.
    pub fn within(self, key: &str) -> Self {
        if matches!(&self, Self::Invalid { place, .. } if place == "spec") { self.below(key) } else { self }
    }

    /// The error of a value at `step` of a table or list, wherever that is.
    pub(crate) fn below(mut self, step: &str) -> Self {
        if let Self::Invalid { field, .. } = &mut self {
            *field = if field.is_empty() { step.to_owned() } else { format!("{step}.{field}") };
        }
        self
    }

    /// A system error at `path`.
    pub fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Self::Io { path: path.as_ref().to_path_buf(), source }
    }

    /// An unsupported request, with the reason.
    pub fn unsupported(what: impl ToString, why: impl ToString) -> Self {
        Self::Unsupported { what: what.to_string(), why: why.to_string() }
    }
}

/// Returns [`Error::Invalid`] unless `ok`.
pub fn ensure(ok: bool, place: &str, field: &str, found: impl ToString, expected: impl ToString) -> Result<()> {
    if ok { Ok(()) } else { Err(Error::invalid(place, field, found, expected)) }
}
