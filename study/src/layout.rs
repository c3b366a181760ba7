//! Where a study's files lie in its folder.
//!
//! ```text
//! study.toml                the study's file, as it was
//! scans/CASE-seedS/         what was simulated, once for all methods
//! runs/CASE-seedS/METHOD/   what "conefield reconstruct" leaves
//! failed/CASE-seedS/METHOD  why a run has no result
//! table.md, table.json      the results; written last
//! slices/CASE.png           middle slices of every method with the first seed
//! curves/CASE.png           PSNR over steps and time
//! ```

use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use conefield_io::{Contents, Progressed};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// The copy of the study's file, which also marks the folder as a study's.
pub const STUDY: &str = "study.toml";
/// The table for people.
pub const TABLE: &str = "table.md";
/// The table for programs.
pub const RECORD: &str = "table.json";
const SCANS: &str = "scans";
const RUNS: &str = "runs";
const FAILED: &str = "failed";
const SLICES: &str = "slices";
const CURVES: &str = "curves";
const FILES: [&str; 3] = [STUDY, TABLE, RECORD];
const FOLDERS: [&str; 5] = [SCANS, RUNS, FAILED, SLICES, CURVES];

/// What the folder of a study holds.
pub const CONTENTS: Contents = Contents { known, progressed };

/// A study's folder.
pub struct Layout<'a>(pub &'a Path);

impl Layout<'_> {
    /// The study's file, as it was.
    pub fn study(&self) -> PathBuf {
        self.0.join(STUDY)
    }

    /// Of simulated scans.
    pub fn scans(&self) -> PathBuf {
        self.0.join(SCANS)
    }

    /// The scan of a case that was simulated with `seed`.
    pub fn scan(&self, case: &str, seed: u64) -> PathBuf {
        self.scans().join(group(case, seed))
    }

    /// The run of a method.
    pub fn run(&self, case: &str, seed: u64, method: &str) -> PathBuf {
        self.0.join(RUNS).join(group(case, seed)).join(method)
    }

    /// The file with the error of a run without result.
    pub fn failure(&self, case: &str, seed: u64, method: &str) -> PathBuf {
        self.0.join(FAILED).join(group(case, seed)).join(method)
    }

    /// The middle slices of a case's volumes.
    pub fn slices(&self, case: &str) -> PathBuf {
        self.0.join(SLICES).join(format!("{case}.png"))
    }

    /// The curves of a case's runs.
    pub fn curves(&self, case: &str) -> PathBuf {
        self.0.join(CURVES).join(format!("{case}.png"))
    }

    /// Refuses a folder with files that no study writes. Returns whether it holds a study.
    pub fn look(&self) -> Result<bool> {
        let place = self.0.display().to_string();
        let entries = match fs::read_dir(self.0) {
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(false),
            entries => entries.map_err(|e| Error::io(self.0, e))?,
        };
        let mut any = false;
        for entry in entries {
            let entry = entry.map_err(|e| Error::io(self.0, e))?;
            let found = format!("a folder with {} in it", entry.file_name().to_string_lossy());
            ensure(known(&entry.path()), &place, "output", found, "a new or empty folder")?;
            // What is being written is nothing yet.
            any |= !conefield_io::is_unfinished(&entry.file_name());
        }
        // Only what bears a study's mark may go with all that is in it.
        let marked = !any || self.study().is_file();
        ensure(marked, &place, "output", format!("a folder without {STUDY}"), "a new or empty folder, or a study's")?;
        Ok(any)
    }
}

/// A case and a seed in one name.
pub fn group(case: &str, seed: u64) -> String {
    format!("{case}-seed{seed}")
}

/// Whether a study may have left this.
fn known(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default();
    let names = if path.is_dir() { &FOLDERS[..] } else { &FILES[..] };
    names.iter().any(|f| name == *f) || conefield_io::is_unfinished(name)
}

/// How far the study in `folder` came.
fn progressed(folder: &Path) -> Progressed {
    let has = |name: &str| fs::read_dir(folder.join(name)).is_ok_and(|mut all| all.next().is_some());
    if folder.join(RECORD).exists() {
        Progressed::Complete
    } else if has(SCANS) || has(RUNS) {
        Progressed::Begun
    } else {
        Progressed::Nothing
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_study_s_folder_is_taken() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        assert!(!Layout(&at("none")).look().unwrap());
        assert!(!Layout(dir.path()).look().unwrap());
        fs::create_dir(at(RUNS)).unwrap();
        let e = Layout(dir.path()).look().unwrap_err().to_string();
        assert!(e.contains("without study.toml"), "{e}");
        fs::write(at(STUDY), "").unwrap();
        assert!(Layout(dir.path()).look().unwrap());
        assert_eq!(progressed(dir.path()), Progressed::Nothing);
        fs::create_dir(at(RUNS).join("a-seed0")).unwrap();
        assert_eq!(progressed(dir.path()), Progressed::Begun);
        fs::write(at(RECORD), "").unwrap();
        assert_eq!(progressed(dir.path()), Progressed::Complete);
        fs::write(at("mine.txt"), "").unwrap();
        let e = Layout(dir.path()).look().unwrap_err().to_string();
        assert!(e.contains("mine.txt in it"), "{e}");
    }
}
