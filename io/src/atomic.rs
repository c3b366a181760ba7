//! Writing so that the final name never holds half a file.

use conefield_core::{Error, Result};
use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// How the names of unfinished files begin and end.
const UNFINISHED: [&str; 2] = [".conefield-", ".tmp"];

/// Whether a file of this name is one that [`write_atomic`] had begun when its process was killed.
pub fn is_unfinished(name: &OsStr) -> bool {
    name.to_str().is_some_and(|n| n.starts_with(UNFINISHED[0]) && n.ends_with(UNFINISHED[1]))
}

/// Writes a file through `fill`: into a temporary file in the same folder, flushed and synced, then renamed.
///
/// If `fill` or the system fails, an earlier file of that name is left as it was and the temporary one is removed.
pub fn write_atomic(path: impl AsRef<Path>, fill: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<()> {
    let path = path.as_ref();
    let folder = parent(path);
    let at = |e| Error::io(path, e);
    // A rename over a folder fails on its own, but only after all the work is done.
    if path.is_dir() {
        return Err(Error::invalid(path.display().to_string(), "file", "a folder", "a name for a file"));
    }
    let mut options = tempfile::Builder::new();
    options.prefix(UNFINISHED[0]).suffix(UNFINISHED[1]);
    // Without this the file would be private to its owner, unlike any other that the user makes.
    #[cfg(unix)]
    options.permissions(<fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o666));
    let file = options.tempfile_in(&folder).map_err(|e| at(without_path(e)))?;
    let mut writer = BufWriter::with_capacity(1 << 20, file);
    fill(&mut writer)?;
    let file = writer.into_inner().map_err(|e| at(e.into_error()))?;
    file.as_file().sync_all().map_err(at)?;
    file.persist(path).map_err(|e| at(e.error))?;
    sync_folder(&folder);
    Ok(())
}

/// Writes `text` as [`write_atomic`] does.
pub fn write_text_atomic(path: impl AsRef<Path>, text: &str) -> Result<()> {
    let path = path.as_ref();
    write_atomic(path, |w| w.write_all(text.as_bytes()).map_err(|e| Error::io(path, e)))
}

/// Fills a temporary folder beside `folder` and renames it into place; what stood there before goes away only then.
///
/// Whether an earlier folder may be replaced at all is for the caller to check.
pub fn write_folder_atomic(folder: impl AsRef<Path>, fill: impl FnOnce(&Path) -> Result<()>) -> Result<()> {
    let folder = folder.as_ref();
    let beside = parent(folder);
    let at = |e| Error::io(folder, e);
    if folder.file_name().is_none() {
        return Err(Error::invalid(folder.display().to_string(), "folder", "no name of its own", "a folder to create"));
    }
    let temporary = |suffix: &str| {
        let mut options = tempfile::Builder::new();
        options.prefix(UNFINISHED[0]).suffix(suffix);
        #[cfg(unix)]
        options.permissions(<fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o777));
        options.tempdir_in(&beside).map_err(|e| at(without_path(e)))
    };
    let new = temporary(".tmp")?;
    fill(new.path())?;
    sync_folder(new.path());
    // rename() replaces only empty folders, so an earlier one steps aside first and comes back if that was in vain.
    let mut aside = None;
    if folder.symlink_metadata().is_ok() {
        let old = temporary(".old.tmp")?;
        fs::rename(folder, old.path().join("old")).map_err(at)?;
        aside = Some(old);
    }
    if let Err(e) = fs::rename(new.path(), folder) {
        if let Some(old) = aside {
            let kept = old.path().join("old");
            if let Err(back) = fs::rename(&kept, folder) {
                tracing::error!("{}: could not be put back: {back}; it is at {}", folder.display(), kept.display());
                let _ = old.keep();
            }
        }
        return Err(at(e));
    }
    // The temporary name is gone with the rename: nothing is left for the guard to remove.
    let _ = new.keep();
    sync_folder(&beside);
    Ok(())
}

/// The system's own words: `tempfile` adds the temporary name, which means nothing to a user.
fn without_path(e: std::io::Error) -> std::io::Error {
    let text = e.to_string();
    match text.split_once(" at path ") {
        Some((words, _)) => std::io::Error::new(e.kind(), words.to_owned()),
        None => e,
    }
}

/// The folder that holds `path`.
fn parent(path: &Path) -> PathBuf {
    match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p.to_path_buf(),
        _ => PathBuf::from("."),
    }
}

/// Makes a rename last through a power cut where the system can do that; the data itself is synced already.
fn sync_folder(folder: &Path) {
    if cfg!(unix)
        && let Ok(f) = File::open(folder)
    {
        let _ = f.sync_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let failed = write_atomic(&path, |w| {
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
        write_folder_atomic(&path, |d| write_text_atomic(d.join("a"), "1")).unwrap();
        let failed = write_folder_atomic(&path, |d| {
            write_text_atomic(d.join("b"), "2")?;
            Err(Error::unsupported("test", "fails on purpose"))
        });
        assert!(failed.is_err());
        assert_eq!((names(dir.path()), names(&path)), (vec!["scan".to_string()], vec!["a".to_string()]));
        write_folder_atomic(&path, |d| write_text_atomic(d.join("b"), "2")).unwrap();
        assert_eq!((names(dir.path()), names(&path)), (vec!["scan".to_string()], vec!["b".to_string()]));
    }

    #[test]
    fn a_missing_folder_and_a_folder_in_the_way_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let e = write_text_atomic(dir.path().join("no/such/a.txt"), "").unwrap_err().to_string();
        assert!(e.contains("a.txt") && !e.contains(UNFINISHED[0]), "{e}");
        let e = write_text_atomic(dir.path(), "").unwrap_err().to_string();
        assert!(e.contains("a folder"), "{e}");
    }
}
