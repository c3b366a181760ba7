//! The folder of a run: `volume.nii.gz`, `metrics.jsonl`, `spec.toml`, `weights.safetensors`, `slices.png` and, last
//! and only of a finished run, `record.json`.

use conefield_core::{Error, Result};
use std::fs::{self, File};
use std::path::{Path, PathBuf};

/// Every file that a run writes.
pub const FILES: [&str; 6] =
    ["volume.nii.gz", "metrics.jsonl", "spec.toml", "weights.safetensors", "slices.png", "record.json"];

/// A folder that belongs to this run alone.
pub struct RunFolder {
    path: PathBuf,
}

impl RunFolder {
    /// Makes the folder, or takes an empty one. Of a folder with files in it only those of an earlier run go, and
    /// only with `force`.
    pub fn create(path: &Path, force: bool) -> Result<Self> {
        let io = |e| Error::io(path, e);
        fs::create_dir_all(path).map_err(io)?;
        let mut found = vec![];
        for entry in fs::read_dir(path).map_err(io)? {
            found.push(entry.map_err(io)?.file_name().to_string_lossy().into_owned());
        }
        found.sort();
        let place = path.display().to_string();
        if let Some(other) = found.iter().find(|f| !FILES.contains(&f.as_str())) {
            let found = format!("a folder with {other} in it");
            return Err(Error::invalid(place, "output", found, "a new or empty folder"));
        }
        if !found.is_empty() && !force {
            let found = "an earlier run";
            return Err(Error::invalid(place, "output", found, "a new or empty folder, or --force to replace the run"));
        }
        for old in found {
            fs::remove_file(path.join(&old)).map_err(|e| Error::io(path.join(&old), e))?;
        }
        Ok(Self { path: path.to_path_buf() })
    }

    /// The path of one of [`FILES`].
    pub fn file(&self, name: &str) -> PathBuf {
        debug_assert!(FILES.contains(&name));
        self.path.join(name)
    }

    /// Opens `metrics.jsonl`, which grows a line at a time.
    pub fn metrics(&self) -> Result<(PathBuf, File)> {
        let path = self.file("metrics.jsonl");
        let file = File::create(&path).map_err(|e| Error::io(&path, e))?;
        Ok((path, file))
    }
}
