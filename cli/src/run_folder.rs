//! The folder of a run: `metrics.jsonl`, `spec.toml`, `live.png` if asked for, while it lasts `checkpoint.safetensors`, at the end
//! `volume.nii.gz`, `weights.safetensors`, `slices.png` and, last and only of a finished run, `record.json`.

use conefield_core::{Error, Result};
use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Every file that a run writes.
pub const FILES: [&str; 8] = [
    "volume.nii.gz",
    "metrics.jsonl",
    "spec.toml",
    "weights.safetensors",
    "slices.png",
    "live.png",
    "record.json",
    "checkpoint.safetensors",
];

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
            let name = entry.map_err(io)?.file_name();
            if !conefield_io::is_unfinished(&name) {
                found.push(name.to_string_lossy().into_owned());
            }
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
        // Not before: in a folder that is refused, another command may be about to finish such a file.
        sweep(path)?;
        for old in found {
            fs::remove_file(path.join(&old)).map_err(|e| Error::io(path.join(&old), e))?;
        }
        Ok(Self { path: path.to_path_buf() })
    }

    /// The folder of a run that was interrupted.
    pub fn reopen(path: &Path) -> Result<Self> {
        if path.is_dir() {
            sweep(path)?;
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

    /// Opens `metrics.jsonl` of an interrupted run without the records after `step`, which come again.
    pub fn metrics_until(&self, step: u64) -> Result<(PathBuf, File)> {
        let path = self.file("metrics.jsonl");
        let io = |e| Error::io(&path, e);
        let before = |line: &&str| {
            let record: Option<serde_json::Value> = serde_json::from_str(line).ok();
            record.and_then(|r| r["step"].as_u64()).is_some_and(|s| s <= step)
        };
        // The last line may be half written.
        let text = fs::read(&path).map_err(io)?;
        let kept: String = String::from_utf8_lossy(&text).lines().filter(before).flat_map(|l| [l, "\n"]).collect();
        conefield_io::write_text_atomic(&path, &kept)?;
        let file = File::options().append(true).open(&path).map_err(io)?;
        Ok((path, file))
    }

    /// Removes the checkpoint of a finished run.
    pub fn finish(&self) -> Result<()> {
        let path = self.file("checkpoint.safetensors");
        match fs::remove_file(&path) {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(Error::io(&path, e)),
            _ => Ok(()),
        }
    }
}

/// Removes what a killed run was about to write: files that never got their final name.
fn sweep(folder: &Path) -> Result<()> {
    let io = |e| Error::io(folder, e);
    for entry in fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        if conefield_io::is_unfinished(&entry.file_name()) && entry.path().is_file() {
            fs::remove_file(entry.path()).map_err(|e| Error::io(entry.path(), e))?;
        }
    }
    Ok(())
}
