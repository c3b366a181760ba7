//! The door for scans: which format a folder or file is in.

use crate::{naf, pickle, r2, scan_folder};
use conefield_core::scan::{Scan, Volume};
use conefield_core::{Error, Result};
use std::path::{Path, PathBuf};

/// A scan on disk.
pub(crate) enum Found {
    /// conefield's own folder, with its description.
    Own(PathBuf),
    /// R2-Gaussian's folder.
    R2(PathBuf),
    /// NAF's file.
    Naf(PathBuf),
}

/// Reads a scan from conefield's own folder (`scan.toml` or `scan.json`), R2-Gaussian's (`meta_data.json`, the training
/// views) or NAF's pickle (the training views), whatever that is called. For folders, the file that describes them may
/// be named as well.
pub fn read_scan(path: impl AsRef<Path>) -> Result<Scan> {
    match find(path.as_ref())? {
        Found::Own(file) => scan_folder::read(&file),
        Found::R2(folder) => r2::read_train(&folder).map(|r| r.train),
        Found::Naf(file) => naf::read_train(&file),
    }
}

/// Reads the volume that a scan was simulated from, if it carries one. Values are in `1/unit` of the scan.
pub fn read_truth(path: impl AsRef<Path>) -> Result<Option<Volume>> {
    match find(path.as_ref())? {
        Found::Own(file) => scan_folder::read_truth(&file),
        Found::R2(folder) => r2::read_train(&folder).map(|r| r.volume),
        Found::Naf(file) => naf::read_truth(&file),
    }
}

pub(crate) fn find(path: &Path) -> Result<Found> {
    let place = path.display().to_string();
    let understood = "a folder with scan.toml or scan.json (conefield) or with meta_data.json (R2-Gaussian), \
                      or a pickle (NAF)";
    let info = path.metadata().map_err(|e| Error::io(path, e))?;
    if !info.is_dir() {
        if info.is_file() && pickle::is_pickle(path)? {
            return Ok(Found::Naf(path.to_path_buf()));
        }
        let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        return match name {
            "scan.toml" | "scan.json" => Ok(Found::Own(path.to_path_buf())),
            "meta_data.json" => Ok(Found::R2(folder.to_path_buf())),
            _ => Err(Error::invalid(place, "scan", "a file of another kind", understood)),
        };
    }
    let has = |name: &str| path.join(name).is_file();
    match (has("scan.toml"), has("scan.json"), has(r2::META)) {
        (true, true, _) => Err(Error::invalid(place, "scan", "both scan.toml and scan.json", "one of them")),
        (true, ..) => Ok(Found::Own(path.join("scan.toml"))),
        (_, true, _) => Ok(Found::Own(path.join("scan.json"))),
        (.., true) => Ok(Found::R2(path.to_path_buf())),
        _ => Err(Error::invalid(place, "scan", "none of the files that describe one", understood)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_scan_is_told_what_would_be() {
        let dir = tempfile::tempdir().unwrap();
        let e = read_scan(dir.path()).unwrap_err().to_string();
        assert!(e.contains("scan.toml") && e.contains("scan.json") && e.contains("meta_data.json"), "{e}");
        let e = read_scan(dir.path().join("none")).unwrap_err().to_string();
        assert!(e.contains("none"), "{e}");
        std::fs::write(dir.path().join("scan.toml"), "").unwrap();
        std::fs::write(dir.path().join("scan.json"), "").unwrap();
        assert!(read_scan(dir.path()).unwrap_err().to_string().contains("both"));
        assert!(read_truth(dir.path()).unwrap_err().to_string().contains("both"));
    }
}
