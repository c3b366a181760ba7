//! A lease on an output folder: one command at a time writes it, and it may replace an earlier folder.
//!
//! When the command has validated its input, it moves the earlier folder aside, under a hidden name next to it. If the
//! command ends without a result, the earlier folder returns; if the new one is complete, the earlier one is removed. A
//! killed process leaves both; the next command on that folder cleans up.

use crate::atomic::{exchange, sweep, sync_folder};
use crate::folder::{entries, file_name, folder_of, is_folder};
use crate::lock::{self, Held};
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use std::ffi::{OsStr, OsString};
use std::fs::{self, File, TryLockError};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Polling interval for a folder that another process writes.
const LOOK: Duration = Duration::from_millis(20);
/// How long to wait for the parts of a killed process to end: a pass over a large volume.
const ENDING: Duration = Duration::from_secs(120);
/// Nesting depth of part folders: a search has one folder per budget.
const PARTS_WITHIN: usize = 3;

/// Progress of the work in a folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progressed {
    /// The folder holds no result and nothing to resume.
    Nothing,
    /// The folder holds part of the result, or a checkpoint.
    Begun,
    /// The result is complete.
    Complete,
}

/// Describes the content of a kind of folder.
#[derive(Debug, Clone, Copy)]
pub struct Contents {
    /// Whether its commands write a path of this name. Nothing else is ever removed.
    pub known: fn(&Path) -> bool,
    /// Progress of the work in a folder.
    pub progressed: fn(&Path) -> Progressed,
}

impl Contents {
    /// The paths in `folder`, sorted; none if there is no folder. Refuses a folder with anything that its commands do not
    /// write.
    pub fn entries(&self, folder: &Path) -> Result<Vec<PathBuf>> {
        let all = entries(folder)?;
        if let Some(other) = all.iter().find(|path| !(self.known)(path)) {
            let found = format!("a folder with {} in it", file_name(other));
            return Err(Error::invalid(folder.display().to_string(), "output", found, "a new or empty folder"));
        }
        Ok(all)
    }
}

/// A folder that only this process writes.
pub struct Lease {
    path: PathBuf,
    contents: Contents,
    locks: Vec<File>,
    /// Whether there was no folder when it was taken.
    missing: bool,
    /// Whether this process has begun to write.
    writing: bool,
    /// Whether this process created the folder.
    made: bool,
}

const ASIDE: [&str; 2] = [".conefield-", ".old"];

/// Whether `name` is the hidden name under which earlier folders are kept.
pub fn is_aside(name: &OsStr) -> bool {
    name.to_str().is_some_and(|n| n.starts_with(ASIDE[0]) && n.ends_with(ASIDE[1]))
}

/// The hidden folder that keeps the earlier versions of `folder`, the earliest as `0`.
fn aside(folder: &Path) -> PathBuf {
    let mut name = OsString::from(ASIDE[0]);
    name.push(folder.file_name().unwrap_or_default());
    name.push(ASIDE[1]);
    folder_of(folder).join(name)
}

/// The folders in `aside`, the latest last. Removes an empty one that a killed process has only just created.
fn waiting(aside: &Path) -> Result<Vec<PathBuf>> {
    let number = |path: &Path| path.file_name()?.to_str()?.parse::<u64>().ok();
    let mut all = entries(aside)?;
    all.retain(|path| fs::remove_dir(path).is_err() && number(path).is_some());
    all.sort_by_key(|path| number(path));
    Ok(all)
}

impl Lease {
    /// Takes the folder at `path`, which may not exist yet. Refuses it while another process holds it. First waits for
    /// part processes of a killed command to end, then cleans up what it left.
    pub fn take(path: &Path, contents: Contents) -> Result<Self> {
        // A symbolic link stays one; the folder that it points to is replaced.
        let plain: PathBuf = path.components().collect();
        let path = if plain.is_symlink() { plain.canonicalize().map_err(|e| Error::io(path, e))? } else { plain };
        let path = path.as_path();
        let locks = own(path)?;
        await_parts(path, contents)?;
        let missing = !path.is_dir();
        let mut lease = Self { path: path.to_path_buf(), contents, locks, missing, writing: false, made: false };
        lease.settle()?;
        // A folder that was put back has its own lock.
        if !lease.locks.iter().any(|held| lock::is_at(held, path)) {
            lease.locks.extend(own(path)?);
        }
        Ok(lease)
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Progress of the work in the folder.
    pub fn progressed(&self) -> Progressed {
        (self.contents.progressed)(&self.path)
    }

    /// Makes the folder empty: moves its content aside until [`Lease::complete`]. Removes the files of work without a
    /// result.
    pub fn replace(&mut self) -> Result<()> {
        let at = |e| Error::io(&self.path, e);
        fs::create_dir_all(folder_of(&self.path)).map_err(at)?;
        if self.missing && self.path.is_dir() {
            // Another process has made it since, and may still write.
            self.locks = own(&self.path)?;
            let place = self.path.display().to_string();
            let expected = "a new folder";
            ensure(self.progressed() == Progressed::Nothing, &place, "output", "what another command wrote", expected)?;
        }
        if !self.path.is_dir() {
            fs::create_dir(&self.path).map_err(at)?;
            self.locks = own(&self.path)?;
            self.made = true;
        } else if self.progressed() == Progressed::Nothing {
            self.clear(&self.path)?;
        } else {
            let found = "a folder without a name of its own";
            let expected = "the name that it has in the folder above";
            ensure(self.path.file_name().is_some(), &self.path.display().to_string(), "output", found, expected)?;
            let aside = aside(&self.path);
            let slot = aside.join(waiting(&aside)?.len().to_string());
            fs::create_dir_all(&slot).map_err(at)?;
            let new = own(&slot)?;
            swap(&self.path, &slot, &aside).map_err(|e| {
                // A folder that may not be moved is where it was, and the place for it is empty.
                let _ = fs::remove_dir(&slot).and_then(|()| fs::remove_dir(&aside));
                at(e)
            })?;
            sync_folder(folder_of(&self.path));
            self.locks.extend(new);
        }
        self.writing = true;
        Ok(())
    }

    /// Resumes in the existing folder: removes the unfinished files of a killed process.
    pub fn go_on(&self) {
        sweep(&self.path);
    }

    /// Ends the work: removes the replaced folder.
    pub fn complete(mut self) -> Result<()> {
        self.writing = false;
        self.settle()
    }

    /// Settles which folder stays: an earlier folder returns if there is nothing new, and is removed if the new one is
    /// complete.
    fn settle(&self) -> Result<()> {
        let aside = aside(&self.path);
        let mut all = waiting(&aside)?;
        let gone = |path: &Path| match fs::remove_dir_all(path) {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(Error::io(path, e)),
            _ => Ok(()),
        };
        let progressed = if self.path.is_dir() { self.progressed() } else { Progressed::Nothing };
        match (progressed, all.pop()) {
            (Progressed::Complete, _) | (Progressed::Nothing, None) => gone(&aside),
            (Progressed::Begun, None) => {
                let _ = fs::remove_dir(&aside);
                Ok(())
            }
            (Progressed::Begun, Some(_)) => Ok(()),
            (Progressed::Nothing, Some(earlier)) => {
                put_back(&earlier, &self.path)?;
                if earlier.is_dir() {
                    self.clear(&earlier)?;
                }
                // Files that someone else put there stay where they can be found.
                let _ = fs::remove_dir(&earlier).and_then(|()| fs::remove_dir(&aside));
                sync_folder(folder_of(&self.path));
                Ok(())
            }
        }
    }

    /// Removes the known files of work without a result.
    fn clear(&self, folder: &Path) -> Result<()> {
        // Backwards, so that an interruption does not leave a spec alone, which is taken for the user's.
        for path in entries(folder)?.into_iter().rev() {
            if (self.contents.known)(&path) {
                let gone = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
                gone.map_err(|e| Error::io(&path, e))?;
            }
        }
        Ok(())
    }
}

impl Drop for Lease {
    /// Handles work that ended early.
    fn drop(&mut self) {
        if !self.writing {
            return;
        }
        let aside = aside(&self.path);
        let settled = self.settle().and_then(|()| {
            if self.progressed() == Progressed::Nothing {
                self.clear(&self.path)?;
                if self.made {
                    let _ = fs::remove_dir(&self.path);
                }
            }
            Ok(())
        });
        match settled {
            Err(e) => tracing::error!("{e}"),
            Ok(()) if aside.is_dir() => tracing::info!(
                "{}: the earlier content is kept in {} until the work is complete",
                self.path.display(),
                aside.display()
            ),
            Ok(()) => {}
        }
    }
}

/// A folder that several processes write at once, each its own parts.
pub struct SharedLease {
    path: PathBuf,
    /// `None` where folders cannot be locked.
    lock: Option<File>,
}

impl SharedLease {
    /// Takes a share in the folder at `path`, creating it if needed. Refuses it while another process holds it alone.
    pub fn take(path: &Path) -> Result<Self> {
        fs::create_dir_all(path).map_err(|e| Error::io(path, e))?;
        match lock::share(path) {
            Held::Ours(lock) => Ok(Self { path: path.to_path_buf(), lock: Some(lock) }),
            Held::Theirs => Err(taken(path)),
            Held::Unknown => Ok(Self { path: path.to_path_buf(), lock: None }),
        }
    }

    /// Exchanges the share for the whole folder; `None` while another process has a share. If several processes call
    /// this at the end, the last one gets the folder: each releases its share before it checks for others.
    pub fn alone(self, contents: Contents) -> Result<Option<Lease>> {
        let Self { path, lock } = self;
        let mut locks = vec![];
        if let Some(lock) = lock {
            let at = |e| Error::io(&path, e);
            lock.unlock().map_err(at)?;
            match lock.try_lock() {
                Ok(()) => locks.push(lock),
                Err(TryLockError::WouldBlock) => return Ok(None),
                Err(TryLockError::Error(e)) => return Err(at(e)),
            }
        }
        Ok(Some(Lease { path, contents, locks, missing: false, writing: false, made: false }))
    }
}

/// A lock on a folder, held until dropped.
pub struct FolderLock {
    _lock: Option<File>,
}

/// Locks `folder` for this process alone; `None` while another process holds it. Always succeeds where folders cannot
/// be locked.
pub fn try_alone(folder: &Path) -> Option<FolderLock> {
    match lock::hold(folder) {
        Held::Ours(lock) => Some(FolderLock { _lock: Some(lock) }),
        Held::Theirs => None,
        Held::Unknown => Some(FolderLock { _lock: None }),
    }
}

/// Locks the folder if it exists.
fn own(path: &Path) -> Result<Vec<File>> {
    loop {
        if !path.is_dir() {
            return Ok(vec![]);
        }
        match lock::hold(path) {
            Held::Ours(lock) => return Ok(vec![lock]),
            Held::Theirs => return Err(taken(path)),
            // A folder that cannot be locked at all stays unlocked; if it was just renamed, trying again helps.
            Held::Unknown if File::open(path).is_ok_and(|f| f.try_lock().is_ok()) => {}
            Held::Unknown => return Ok(vec![]),
        }
    }
}

fn taken(path: &Path) -> Error {
    let expected = "a folder that no other command writes, or to wait until that one is done";
    Error::invalid(path.display().to_string(), "output", "a folder that another conefield is writing", expected)
}

/// Waits until no process writes a folder within `path`. A command that works in parts starts a process per part and
/// locks the whole. If the whole was free, its command has died, and its part processes end after their current step.
fn await_parts(path: &Path, contents: Contents) -> Result<()> {
    let mut parts = vec![];
    folders(path, PARTS_WITHIN, contents.known, &mut parts)?;
    let begin = Instant::now();
    for part in parts {
        let mut reported = false;
        while matches!(lock::hold(&part), Held::Theirs) {
            if !reported {
                tracing::info!("{}: waiting for another conefield process that is writing to it", part.display());
                reported = true;
            }
            if begin.elapsed() > ENDING {
                return Err(taken(&part));
            }
            std::thread::sleep(LOOK);
        }
    }
    Ok(())
}

/// Collects the folders within `path` that are `wanted`, down to `depth`.
fn folders(path: &Path, depth: usize, wanted: fn(&Path) -> bool, found: &mut Vec<PathBuf>) -> Result<()> {
    if depth == 0 {
        return Ok(());
    }
    match path.metadata() {
        Ok(info) if info.is_dir() => {}
        Err(e) if !matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
            return Err(Error::io(path, e));
        }
        _ => return Ok(()),
    }
    for inner in entries(path)?.into_iter().filter(|inner| is_folder(inner) && wanted(inner)) {
        folders(&inner, depth - 1, |_| true, found)?;
        found.push(inner);
    }
    Ok(())
}

/// Puts `earlier` back to `path`. If `path` exists, it holds work without a result and moves to `earlier`.
fn put_back(earlier: &Path, path: &Path) -> Result<()> {
    let back = match path.symlink_metadata() {
        Ok(_) => swap(earlier, path, folder_of(earlier)),
        Err(_) => fs::rename(earlier, path),
    };
    back.map_err(|e| Error::io(path, e))
}

/// Exchanges the folder `earlier`, which must not be lost, and `other`. Where the system cannot do that in one step,
/// `other` waits in the folder `aside`: what ends the process meanwhile leaves `earlier` under one of the two names.
fn swap(earlier: &Path, other: &Path, aside: &Path) -> std::io::Result<()> {
    if exchange(earlier, other)? {
        return Ok(());
    }
    let between = aside.join("new");
    fs::rename(other, &between)?;
    fs::rename(earlier, other)?;
    fs::rename(&between, earlier)
}

/// Replaces `folder` by `new` where two names cannot be exchanged in one step: moves `folder` aside, then renames
/// `new`.
pub(crate) fn replace_in_two_steps(new: &Path, folder: &Path) -> Result<()> {
    let at = |e| Error::io(folder, e);
    let aside = aside(folder);
    let slot = aside.join(waiting(&aside)?.len().to_string());
    fs::create_dir_all(&aside).map_err(at)?;
    fs::rename(folder, &slot).map_err(at)?;
    if let Err(e) = fs::rename(new, folder) {
        put_back(&slot, folder)?;
        return Err(at(e));
    }
    fs::remove_dir_all(&aside).map_err(at)
}

/// Puts back a folder that a process killed between the two steps left aside.
pub(crate) fn put_back_missing(folder: &Path) -> Result<()> {
    if folder.symlink_metadata().is_ok() {
        return Ok(());
    }
    let aside = aside(folder);
    match waiting(&aside)?.pop() {
        None => Ok(()),
        Some(earlier) => {
            put_back(&earlier, folder)?;
            let _ = fs::remove_dir(&aside);
            Ok(())
        }
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    const ANY: Contents = Contents { known: |_| true, progressed: |_| Progressed::Begun };

    #[test]
    fn shares_keep_out_who_wants_all_and_the_last_one_gets_it() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("shared");
        let [a, b] = [0, 1].map(|_| SharedLease::take(&folder).unwrap());
        assert!(Lease::take(&folder, ANY).err().unwrap().to_string().contains("another conefield"));
        assert!(try_alone(&folder).is_none());
        assert!(a.alone(ANY).unwrap().is_none(), "the other one works on");
        let all = b.alone(ANY).unwrap().expect("the last one");
        assert!(SharedLease::take(&folder).err().unwrap().to_string().contains("another conefield"));
        drop(all);
        let lock = try_alone(&folder).unwrap();
        assert!(SharedLease::take(&folder).is_err());
        drop(lock);
        Lease::take(&folder, ANY).unwrap();
    }
}
