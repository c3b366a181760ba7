//! Locks on files and folders that distinguish the work of a running process from the remains of a dead one: the system
//! releases them when their process ends, however it ends.

use same_file::Handle;
use std::fs::{File, TryLockError};
use std::path::Path;

/// Result of an attempt to lock.
pub(crate) enum Held {
    /// Locked until this is dropped.
    Ours(File),
    /// Another process, or another part of this one, holds the lock.
    Theirs,
    /// The path is gone or cannot be locked: some network file systems have no locks, and folders can be locked only on
    /// Unix.
    Unknown,
}

/// Locks `path`, a file or a folder, without waiting.
pub(crate) fn hold(path: &Path) -> Held {
    lock(path, File::try_lock)
}

/// Takes a shared lock: it excludes only [`hold`].
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
    // The name may have come to refer to something else between opening and locking.
    if is_at(&file, path) { Held::Ours(file) } else { Held::Unknown }
}

/// Whether `path` is a name of the open `file`.
pub(crate) fn is_at(file: &File, path: &Path) -> bool {
    let open = file.try_clone().and_then(Handle::from_file).ok();
    open.zip(Handle::from_path(path).ok()).is_some_and(|(a, b)| a == b)
}
