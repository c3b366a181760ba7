//! The error that every crate of conefield returns.
//!
//! A message names the place (a file, a spec, a stage), the field, what was found and what was expected.

use std::path::{Path, PathBuf};

/// Everything that can go wrong, said in words that a user can act on.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A value that cannot be used: its place, what was found and what is expected.
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
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        #[source]
        source: std::io::Error,
    },
    /// Something was asked for that this build or this pipeline cannot do.
    #[error("{what}: {why}")]
    Unsupported {
        /// What was asked for.
        what: String,
        /// Why not, and what to do instead.
        why: String,
    },
    /// The run was interrupted by the user.
    #[error("interrupted after step {step}; where it keeps checkpoints, the same command with --resume continues")]
    Interrupted {
        /// The last finished step.
        step: u64,
    },
    /// The user interrupted a work of several parts.
    #[error("interrupted during {part}; the same command with --resume continues")]
    Stopped {
        /// The part that is not done.
        part: String,
    },
    /// The user interrupted the writing of a file.
    #[error("{place}: interrupted while writing; nothing was replaced")]
    Cancelled {
        /// The file.
        place: String,
    },
    /// The user interrupted a work that leaves nothing behind.
    #[error("interrupted during {part}")]
    Aborted {
        /// What was under way.
        part: String,
    },
    /// A device that computes refused or was lost.
    #[error("{device}: {what}")]
    Device {
        /// Its name.
        device: String,
        /// What happened.
        what: String,
    },
    /// Training left the finite numbers.
    #[error("training diverged at step {step}: {what}")]
    Diverged {
        /// The step at which it was seen.
        step: u64,
        /// What was not finite.
        what: String,
    },
}

/// Result with conefield's [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// A value that cannot be used; see [`Error::Invalid`].
    pub fn invalid(
        place: impl Into<String>,
        field: impl Into<String>,
        found: impl ToString,
        expected: impl Into<String>,
    ) -> Self {
        Self::Invalid { place: place.into(), field: field.into(), found: found.to_string(), expected: expected.into() }
    }

    /// The same error for the owner of the stage that it is about: `key` goes before a field of a spec. A stage does not
    /// know where it stands.
    pub fn within(self, key: &str) -> Self {
        match self {
            Self::Invalid { place, field, found, expected } if place == "spec" => {
                let field = if field.is_empty() { key.to_owned() } else { format!("{key}.{field}") };
                Self::Invalid { place, field, found, expected }
            }
            other => other,
        }
    }

    /// A system error at `path`.
    pub fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Self::Io { path: path.as_ref().to_path_buf(), source }
    }

    /// A thing that cannot be done, with the reason.
    pub fn unsupported(what: impl Into<String>, why: impl Into<String>) -> Self {
        Self::Unsupported { what: what.into(), why: why.into() }
    }
}

/// Returns [`Error::Invalid`] unless `ok`.
pub fn ensure(ok: bool, place: &str, field: &str, found: impl ToString, expected: impl Into<String>) -> Result<()> {
    if ok { Ok(()) } else { Err(Error::invalid(place, field, found, expected)) }
}
