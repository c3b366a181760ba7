//! Layout of a study's folder.
//!
//! ```text
//! study.toml                a copy of the study's file
//! scans/CASE-seedS/         the simulated scans, one for all methods
//! runs/CASE-seedS/METHOD/   output of "conefield reconstruct"
//! failed/CASE-seedS/METHOD  why a run has no result
//! table.md, table.json      the results; written last
//! slices/CASE.png           middle slices of every method with the first seed
//! curves/CASE.png           PSNR over steps and time
//! ```

use crate::files::is_one_of;
use conefield_core::Result;
use conefield_core::error::ensure;
use conefield_io::{Contents, Progressed};
use std::fs;
use std::path::{Path, PathBuf};

/// The copy of the study's file, which also identifies the folder of a study.
pub const STUDY: &str = "study.toml";
/// The Markdown table.
pub const TABLE: &str = "table.md";
/// The JSON record.
pub const RECORD: &str = "table.json";
const SCANS: &str = "scans";
const RUNS: &str = "runs";
const FAILED: &str = "failed";
const SLICES: &str = "slices";
const CURVES: &str = "curves";
const FILES: [&str; 3] = [STUDY, TABLE, RECORD];
const FOLDERS: [&str; 5] = [SCANS, RUNS, FAILED, SLICES, CURVES];

/// Content of a study's folder.
pub const CONTENTS: Contents = Contents { known, progressed };

/// A study's folder.
pub struct Layout<'a>(pub &'a Path);

impl Layout<'_> {
    /// The copy of the study's file.
    pub fn study(&self) -> PathBuf {
        self.0.join(STUDY)
    }

    /// Folder of the simulated scans.
    pub fn scans(&self) -> PathBuf {
        self.0.join(SCANS)
    }

    /// Folder of the scan of a case, simulated with `seed`.
    pub fn scan(&self, case: &str, seed: u64) -> PathBuf {
        self.scans().join(group(case, seed))
    }

    /// Folder of the run with this [name](crate::study::definition::Study::run_name).
    pub fn run(&self, name: &str) -> PathBuf {
        self.0.join(RUNS).join(name)
    }

    /// File with the error of a failed run.
    pub fn failure(&self, name: &str) -> PathBuf {
        self.0.join(FAILED).join(name)
    }

    /// Picture of the middle slices of a case's volumes.
    pub fn slices(&self, case: &str) -> PathBuf {
        self.0.join(SLICES).join(format!("{case}.png"))
    }

    /// Picture of the curves of a case's runs.
    pub fn curves(&self, case: &str) -> PathBuf {
        self.0.join(CURVES).join(format!("{case}.png"))
    }

    /// Refuses a folder with files that no study writes. Returns whether it contains a study.
    pub fn look(&self) -> Result<bool> {
        // Unfinished files do not count.
        let counts = |path: &PathBuf| !path.file_name().is_some_and(conefield_io::is_unfinished);
        let any = CONTENTS.entries(self.0)?.iter().any(counts);
        // Only a folder with a study's file may be removed with its content.
        let (marked, place) = (!any || self.study().is_file(), self.0.display().to_string());
        ensure(marked, &place, "output", format!("a folder without {STUDY}"), "a new or empty folder, or a study's")?;
        Ok(any)
    }
}

/// A case and a seed, joined to one name.
pub fn group(case: &str, seed: u64) -> String {
    format!("{case}-seed{seed}")
}

/// The name of a run, CASE-seedS/METHOD, which is also its path.
pub fn run_name(case: &str, seed: u64, method: &str) -> String {
    format!("{}/{method}", group(case, seed))
}

/// Whether a study may have written `path`.
fn known(path: &Path) -> bool {
    is_one_of(path, &FOLDERS, &FILES)
}

/// Progress of the study in `folder`.
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
