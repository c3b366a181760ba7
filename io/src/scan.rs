//! Entry points for scans: they recognize the format of a folder or file.

use crate::text::format_of;
use crate::{Stored, folder, foreign, naf, pickle, r2, scan_folder, scanner};
use conefield_core::scan::{Scan, Unit, Volume};
use conefield_core::{Error, Result};
use std::path::{Path, PathBuf};

/// File name of a scanner's description in its folder.
pub(crate) const SCANNER: &str = "scanner.toml";

/// Everything a file or folder holds of one scan.
#[derive(Debug, Clone)]
pub struct DataSet<S = Scan> {
    /// The views to reconstruct from.
    pub train: S,
    /// Views held out for testing.
    pub test: Option<Scan>,
    /// The volume from which the scan was simulated, in `1/unit` of the scan.
    pub volume: Option<Volume>,
}

/// A scan on disk.
pub(crate) enum ScanFile {
    /// conefield's own folder, with its description.
    Own(PathBuf),
    /// R2-Gaussian's folder.
    R2(PathBuf),
    /// NAF's file.
    Naf(PathBuf),
    /// A description of a scanner's files.
    Scanner(PathBuf),
}

/// Reads a scan from conefield's own folder (`scan.toml` or `scan.json`), R2-Gaussian's folder (`meta_data.json`, the
/// training views), NAF's pickle of any name (the training views), or a scanner's files through their description
/// (`scanner.toml` or a vendor's file, see [`read_scanner`](crate::read_scanner)). For folders, the path may also
/// name the description file.
pub fn read_scan(path: impl AsRef<Path>) -> Result<Stored> {
    read_data_set(path.as_ref(), Parts { tests: false, volume: false }).map(|set| set.train)
}

/// What to read beside the training views.
#[derive(Debug, Clone, Copy)]
pub struct Parts {
    /// The test views.
    pub tests: bool,
    /// The volume.
    pub volume: bool,
}

impl Parts {
    /// Everything.
    pub const ALL: Self = Self { tests: true, volume: true };
}

/// Reads a scan and the `parts` that its file or folder holds. Some formats give the volume unasked.
pub fn read_data_set(path: impl AsRef<Path>, parts: Parts) -> Result<DataSet<Stored>> {
    let DataSet { train, test, volume } = match find(path.as_ref())? {
        ScanFile::R2(folder) => r2::read(&folder, parts.tests)?,
        ScanFile::Naf(file) => naf::read(&file, parts.tests)?,
        ScanFile::Own(file) => {
            let volume = if parts.volume { scan_folder::read_truth(&file)? } else { None };
            DataSet { train: scan_folder::read(&file)?, test: None, volume }
        }
        ScanFile::Scanner(file) => {
            return Ok(DataSet { train: scanner::read_scanner(&file, None, None)?, test: None, volume: None });
        }
    };
    Ok(DataSet { train: Stored::Scan(train), test, volume })
}

/// Reads the volume from which a scan was simulated, if it has one. Values are in `1/unit` of the scan.
pub fn read_truth(path: impl AsRef<Path>) -> Result<Option<Volume>> {
    match find(path.as_ref())? {
        ScanFile::Own(file) => scan_folder::read_truth(&file),
        ScanFile::R2(folder) => r2::read_truth(&folder),
        ScanFile::Naf(file) => naf::read_truth(&file),
        ScanFile::Scanner(_) => Ok(None),
    }
}

/// The file with the volume from which a scan was simulated, if its description names one.
pub fn truth_file(path: impl AsRef<Path>) -> Result<Option<PathBuf>> {
    match find(path.as_ref())? {
        ScanFile::Own(file) => scan_folder::truth_file(&file),
        ScanFile::R2(folder) => r2::truth_file(&folder),
        ScanFile::Naf(file) => Ok(Some(file)),
        ScanFile::Scanner(_) => Ok(None),
    }
}

/// The unit that the description of conefield's own scan in `folder` states; `None` if there is no such scan.
pub fn scan_unit(folder: impl AsRef<Path>) -> Result<Option<Unit>> {
    let folder = folder.as_ref();
    let file = ["scan.toml", "scan.json"].map(|name| folder.join(name)).into_iter().find(|file| file.is_file());
    file.map(|file| scan_folder::unit(&file)).transpose()
}

/// The description of a scanner that `path` names: in a folder its `scanner.toml`, if there is one.
pub fn scanner_file(path: &Path) -> PathBuf {
    let file = path.join(SCANNER);
    if file.is_file() { file } else { path.to_path_buf() }
}

pub(crate) fn find(path: &Path) -> Result<ScanFile> {
    let place = path.display().to_string();
    let understood = "a folder with scan.toml or scan.json (conefield), scanner.toml (a scanner's images) or \
                      meta_data.json (R2-Gaussian), a pickle (NAF) or a vendor's file (.xtekct, .log, .xml, .txrm)";
    let info = path.metadata().map_err(|e| Error::io(path, e))?;
    if !info.is_dir() {
        if pickle::is_pickle(path)? {
            return Ok(ScanFile::Naf(path.to_path_buf()));
        }
        if scanner::is_vendors(path) {
            return Ok(ScanFile::Scanner(path.to_path_buf()));
        }
        return match (path.file_name().and_then(|n| n.to_str()), path.extension().and_then(|e| e.to_str())) {
            (Some("scan.toml" | "scan.json"), _) => Ok(ScanFile::Own(path.to_path_buf())),
            (Some(r2::META), _) => Ok(ScanFile::R2(folder::folder_of(path).to_path_buf())),
            (_, Some("toml" | "json")) => match format_of(path).as_deref() {
                Some(scan_folder::FORMAT) => Ok(ScanFile::Own(path.to_path_buf())),
                // The description's reader reports what is missing.
                _ => Ok(ScanFile::Scanner(path.to_path_buf())),
            },
            _ => {
                foreign::refuse_file(path)?;
                Err(Error::invalid(place, "scan", "a file of another kind", understood))
            }
        };
    }
    let has = |name: &str| path.join(name).is_file();
    match (has("scan.toml"), has("scan.json"), has(r2::META)) {
        (true, true, _) => Err(Error::invalid(place, "scan", "both scan.toml and scan.json", "one of them")),
        (true, ..) => Ok(ScanFile::Own(path.join("scan.toml"))),
        (_, true, _) => Ok(ScanFile::Own(path.join("scan.json"))),
        (.., true) => Ok(ScanFile::R2(path.to_path_buf())),
        _ if has(SCANNER) => Ok(ScanFile::Scanner(path.join(SCANNER))),
        _ => {
            // Files in a folder without permission look as if they did not exist.
            let file = path.join("scan.toml");
            file.try_exists().map_err(|e| Error::io(&file, e))?;
            foreign::refuse_folder(path)?;
            Err(Error::invalid(place, "scan", "none of the files that describe one", understood))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn a_description_that_cannot_be_reached_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("scan.toml");
        // A loop stands for a folder without permission, which root may read.
        std::os::unix::fs::symlink(&file, &file).unwrap();
        let e = read_scan(dir.path()).unwrap_err();
        assert!(matches!(&e, Error::Io { path, .. } if *path == file), "{e}");
    }
}
