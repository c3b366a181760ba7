//! The folder of a run: `metrics.jsonl`, `spec.toml`, `live.png` if asked for, while it lasts `checkpoint.safetensors`, at the end
//! `volume.nii.gz`, `weights.safetensors`, `slices.png` and, last and only of a finished run, `record.json`.

use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use conefield_io::{Contents, Lease, Progressed};
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

/// What such a folder holds.
pub const CONTENTS: Contents = Contents { known, progressed };

/// Whether a run may have left this.
pub fn known(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default();
    FILES.iter().any(|f| name == *f) || conefield_io::is_unfinished(name)
}

/// How far the run in `folder` came.
pub fn progressed(folder: &Path) -> Progressed {
    let has = |name: &str| folder.join(name).exists();
    if has("record.json") {
        Progressed::Complete
    } else if ["checkpoint.safetensors", "volume.nii.gz", "weights.safetensors"].into_iter().any(has) {
        Progressed::Begun
    } else {
        Progressed::Nothing
    }
}

/// A folder that belongs to this run alone.
pub struct RunFolder(Lease);

impl RunFolder {
    /// Takes the folder, which need not be there yet. Nothing changes in it.
    pub fn take(path: &Path) -> Result<Self> {
        Lease::take(path, CONTENTS).map(Self)
    }

    /// Refuses a folder that holds something else than a run, and a run that came to something unless `force`.
    pub fn may_begin(&self, force: bool) -> Result<()> {
        let path = self.0.path();
        let place = path.display().to_string();
        let entries = match fs::read_dir(path) {
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(()),
            entries => entries.map_err(|e| Error::io(path, e))?,
        };
        let mut strange = vec![];
        for entry in entries {
            let path = entry.map_err(|e| Error::io(path, e))?.path();
            strange
                .extend((!known(&path)).then(|| path.file_name().unwrap_or_default().to_string_lossy().into_owned()));
        }
        if let Some(other) = strange.iter().min() {
            let found = format!("a folder with {other} in it");
            return Err(Error::invalid(place, "output", found, "a new or empty folder"));
        }
        let expected = "a new or empty folder, or --force to replace the run";
        ensure(force || self.0.progressed() == Progressed::Nothing, &place, "output", "an earlier run", expected)
    }

    /// Begins a run in the folder, which is empty then; an earlier run waits until this one is complete.
    pub fn begin(&mut self) -> Result<()> {
        self.0.replace()
    }

    /// Goes on with the run that is there.
    pub fn go_on(&self) {
        self.0.go_on();
    }

    /// The path of one of [`FILES`].
    pub fn file(&self, name: &str) -> PathBuf {
        debug_assert!(FILES.contains(&name));
        self.0.path().join(name)
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

    /// The run is done: its checkpoint goes, and what it replaced.
    pub fn finish(self) -> Result<()> {
        let path = self.file("checkpoint.safetensors");
        match fs::remove_file(&path) {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(Error::io(&path, e)),
            _ => self.0.complete(),
        }
    }
}
