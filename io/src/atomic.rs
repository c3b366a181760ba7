//! Atomic writes: a file or folder appears under its final name only when it is complete.

use crate::folder::folder_of;
use crate::lease;
use crate::lock::{self, Held};
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Prefix and suffix of the names of unfinished files.
const UNFINISHED: [&str; 2] = [".conefield-", ".tmp"];

/// Temporary paths that this process is writing. Holding the lock keeps others from starting a write.
static OPEN: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// Whether `name` is the temporary name of a file that [`write_atomic`] writes, or of a folder, left when the process was
/// killed.
pub fn is_unfinished(name: &OsStr) -> bool {
    name.to_str().is_some_and(|n| n.starts_with(UNFINISHED[0]) && n.ends_with(UNFINISHED[1]))
}

/// Removes unfinished files that killed processes left in `folder`. Files of running processes are locked and stay.
pub fn sweep(folder: &Path) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        let Ok(kind) = entry.file_type() else { continue };
        if !is_unfinished(&entry.file_name()) || !(kind.is_file() || kind.is_dir()) {
            continue;
        }
        // The lock is held until the file is gone: a process that has just created it notices and creates another.
        if let Held::Ours(_lock) = lock::hold(&path) {
            let gone = if kind.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            if let Err(e) = gone {
                tracing::debug!("{}: {e}", path.display());
            }
        }
    }
}

/// Runs [`sweep`] at most once per folder.
fn sweep_once(folder: &Path) {
    static SWEPT: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());
    if SWEPT.lock().unwrap_or_else(PoisonError::into_inner).insert(folder.to_path_buf()) {
        sweep(folder);
    }
}

/// Removes the unfinished files of this process and blocks new writes. Called when a signal ends the process.
pub fn discard_unfinished() {
    let open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
    for path in open.iter() {
        let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    }
    std::mem::forget(open);
}

/// A temporary path registered in [`OPEN`].
struct Noted(PathBuf);

impl Drop for Noted {
    fn drop(&mut self) {
        OPEN.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.0);
    }
}

/// Creates something under a temporary name in `folder` and locks it, so that no other process sweeps it.
fn begin<T>(
    folder: &Path,
    mut make: impl FnMut() -> std::io::Result<T>,
    path: impl Fn(&T) -> &Path,
) -> std::io::Result<(T, Option<File>, Noted)> {
    sweep_once(folder);
    loop {
        let mut open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
        let made = make()?;
        open.insert(path(&made).to_path_buf());
        drop(open);
        let noted = Noted(path(&made).to_path_buf());
        // Another process may have swept the folder between these two lines.
        match lock::hold(path(&made)) {
            Held::Ours(lock) => return Ok((made, Some(lock), noted)),
            Held::Unknown if path(&made).exists() => return Ok((made, None, noted)),
            Held::Unknown | Held::Theirs => {}
        }
    }
}

/// The name of an unfinished file or folder, and its permissions: without them it would be private to its owner, unlike
/// the user's other files.
fn temporary(mode: u32) -> tempfile::Builder<'static, 'static> {
    let mut options = tempfile::Builder::new();
    options.prefix(UNFINISHED[0]).suffix(UNFINISHED[1]);
    #[cfg(unix)]
    options.permissions(<fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(mode));
    #[cfg(not(unix))]
    let _ = mode;
    options
}

/// Writes a file through `fill`: into a temporary file in the same folder, which is flushed, synced and renamed.
///
/// If `fill` or the system fails, an earlier file of that name stays unchanged and the temporary file is removed.
pub fn write_atomic(path: &Path, fill: &mut dyn FnMut(&mut dyn Write) -> Result<()>) -> Result<()> {
    let folder = folder_of(path);
    let at = |e| Error::io(path, e);
    // A rename over a folder fails anyway, but only after all the work is done.
    ensure(!path.is_dir(), &path.display().to_string(), "file", "a folder", "a name for a file")?;
    let made = begin(folder, || temporary(0o666).tempfile_in(folder), |f| f.path());
    let (file, _lock, _noted) = made.map_err(|e| at(without_path(e)))?;
    // Writes to the file itself: errors of its guard would name the temporary path.
    let mut writer = BufWriter::with_capacity(1 << 20, file.as_file());
    fill(&mut writer)?;
    writer.into_inner().map_err(|e| at(e.into_error()))?;
    file.as_file().sync_all().map_err(at)?;
    file.persist(path).map_err(|e| at(e.error))?;
    sync_folder(folder);
    Ok(())
}

/// Writes `text` like [`write_atomic`].
pub fn write_text_atomic(path: impl AsRef<Path>, text: &str) -> Result<()> {
    let path = path.as_ref();
    write_atomic(path, &mut |w| w.write_all(text.as_bytes()).map_err(|e| Error::io(path, e)))
}

/// Fills a temporary folder beside `folder` and exchanges the two in one step; only then is the earlier folder removed.
///
/// The caller checks whether an earlier folder may be replaced.
pub fn write_folder_atomic(folder: &Path, fill: &mut dyn FnMut(&Path) -> Result<()>) -> Result<()> {
    let beside = folder_of(folder);
    let at = |e| Error::io(folder, e);
    let expected = "a folder to create";
    ensure(folder.file_name().is_some(), &folder.display().to_string(), "folder", "no name of its own", expected)?;
    lease::put_back_missing(folder)?;
    let made = begin(beside, || temporary(0o777).tempdir_in(beside), |d| d.path());
    let (new, _lock, _noted) = made.map_err(|e| at(without_path(e)))?;
    fill(new.path()).map_err(|e| renamed(e, new.path(), folder))?;
    sync_folder(new.path());
    if folder.symlink_metadata().is_err() {
        fs::rename(new.path(), folder).map_err(at)?;
        // The temporary name is gone, so the guard has nothing to remove.
        let _ = new.keep();
    } else if exchange(new.path(), folder).map_err(at)? {
        // The temporary name now belongs to the earlier folder, which the guard removes.
    } else {
        lease::replace_in_two_steps(new.path(), folder)?;
        let _ = new.keep();
    }
    sync_folder(beside);
    Ok(())
}

/// Exchanges two names in one step; false where the system cannot do that.
pub(crate) fn exchange(a: &Path, b: &Path) -> std::io::Result<bool> {
    #[cfg(any(target_os = "linux", target_os = "android", target_vendor = "apple"))]
    {
        use rustix::fs::{CWD, RenameFlags, renameat_with};
        use rustix::io::Errno;
        match renameat_with(CWD, a, CWD, b, RenameFlags::EXCHANGE) {
            Ok(()) => Ok(true),
            Err(Errno::NOSYS | Errno::INVAL | Errno::NOTSUP | Errno::PERM) => Ok(false),
            Err(e) => Err(e.into()),
        }
    }
    #[cfg(not(any(target_os = "linux", target_os = "android", target_vendor = "apple")))]
    {
        let _ = (a, b);
        Ok(false)
    }
}

/// An error about a file in the temporary folder `from`, reported under the final name `to`.
fn renamed(e: Error, from: &Path, to: &Path) -> Error {
    match e {
        Error::Io { path, source } => {
            let path = path.strip_prefix(from).map_or(path.clone(), |rest| to.join(rest));
            Error::Io { path, source }
        }
        Error::Invalid { place, field, found, expected } => {
            let place = place.replace(&from.display().to_string(), &to.display().to_string());
            Error::Invalid { place, field, found, expected }
        }
        other => other,
    }
}

/// The system's own message: `tempfile` adds the temporary name, which means nothing to a user.
fn without_path(e: std::io::Error) -> std::io::Error {
    let text = e.to_string();
    match text.split_once(" at path ") {
        Some((words, _)) => std::io::Error::new(e.kind(), words.to_owned()),
        None => e,
    }
}

/// Syncs the folder, so that a rename survives a power cut where the system supports that. The data is already synced.
pub(crate) fn sync_folder(folder: &Path) {
    if cfg!(unix)
        && let Ok(f) = File::open(folder)
    {
        let _ = f.sync_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::says;

    fn names(folder: &Path) -> Vec<String> {
        let mut all: Vec<String> =
            fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        all.sort();
        all
    }

    #[test]
    fn a_failed_write_leaves_the_earlier_file_whole() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        write_text_atomic(&path, "first").unwrap();
        let failed = write_atomic(&path, &mut |w| {
            w.write_all(b"half of the sec").unwrap();
            Err(Error::unsupported("test", "fails on purpose"))
        });
        assert!(failed.is_err());
        assert_eq!(fs::read_to_string(&path).unwrap(), "first");
        assert_eq!(names(dir.path()), ["a.txt"]);
        write_text_atomic(&path, "second").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "second");
    }

    #[test]
    fn a_failed_folder_leaves_the_earlier_folder_whole() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scan");
        write_folder_atomic(&path, &mut |d| write_text_atomic(d.join("a"), "1")).unwrap();
        let failed = write_folder_atomic(&path, &mut |d| {
            write_text_atomic(d.join("b"), "2")?;
            Err(Error::unsupported("test", "fails on purpose"))
        });
        assert!(failed.is_err());
        assert_eq!((names(dir.path()), names(&path)), (vec!["scan".to_string()], vec!["a".to_string()]));
        write_folder_atomic(&path, &mut |d| write_text_atomic(d.join("b"), "2")).unwrap();
        assert_eq!((names(dir.path()), names(&path)), (vec!["scan".to_string()], vec!["b".to_string()]));
    }

    #[test]
    fn a_missing_folder_and_a_folder_in_the_way_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let e = write_text_atomic(dir.path().join("no/such/a.txt"), "").unwrap_err().to_string();
        assert!(e.contains("a.txt") && !e.contains(UNFINISHED[0]), "{e}");
        says(write_text_atomic(dir.path(), ""), &["a folder"]);
    }
}
