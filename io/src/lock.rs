//! Locks on files and folders that tell the work of a living process from what a dead one left: the system gives them back
//! when their process ends, however it ends.

use same_file::Handle;
use std::fs::{File, TryLockError};
use std::path::Path;

/// What came of the wish to hold something.
pub(crate) enum Held {
    /// It is held until this is dropped.
    Ours(File),
    /// Another process, or another part of this one, holds it.
    Theirs,
    /// It is gone, or cannot be locked here: some network file systems keep no locks, and only on Unix can a folder be.
    Unknown,
}

/// Locks what stands under `path`, a file or a folder, without waiting.
pub(crate) fn hold(path: &Path) -> Held {
    lock(path, File::try_lock)
}

/// The same beside others that do so: only [`hold`] is kept out, and keeps out.
pub(crate) fn share(path: &Path) -> Held {
    lock(path, File::try_lock_shared)
}

fn lock(path: &Path, way: fn(&File) -> Result<(), TryLockError>) -> Held {
    let Ok(file) = File::open(path) else { return Held::Unknown };
    match way(&file) {
        Err(TryLockError::WouldBlock) => return Held::Theirs,
        Err(TryLockError::Error(_)) => return Held::Unknown,
        Ok(()) => {}
    }
    // Between the two steps the name may have come to stand for something else.
    let same = file.try_clone().and_then(Handle::from_file).ok().zip(Handle::from_path(path).ok());
    if same.is_some_and(|(a, b)| a == b) { Held::Ours(file) } else { Held::Unknown }
}
