//! Shared helpers of several modules' tests.

use std::path::PathBuf;

/// A file of the shared data, or `None` with a note on why the test is skipped.
pub(crate) fn data(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("CONEFIELD_DATA")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"));
    let path = root.join(name);
    if path.exists() {
        return Some(path);
    }
    eprintln!("skipped: {} is not there; CONEFIELD_DATA names the folder of the shared data", path.display());
    None
}

/// Folder for pictures to inspect, if CONEFIELD_PICTURES names one.
pub(crate) fn folder() -> (Option<tempfile::TempDir>, PathBuf) {
    match std::env::var_os("CONEFIELD_PICTURES") {
        Some(p) => (None, p.into()),
        None => {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().to_path_buf();
            (Some(dir), path)
        }
    }
}
