//! The folder of a run: `metrics.jsonl`, `spec.toml`, `live.png` and `events.out.tfevents.conefield` if requested, and
//! `checkpoint.safetensors` during the run. At the end `volume.nii.gz`, `volume-hu.nii.gz` if requested,
//! `weights.safetensors`, `slices.png` and, last and only for a finished run, `record.json`.

use crate::commands::EndOptions;
use conefield::plugins::Used;
use conefield::record::ScanRecord;
use conefield::scratch;
use conefield::tradeoff::json::{LONGEST, read_json};
use conefield_core::error::ensure;
use conefield_core::files::read_text;
use conefield_core::method::Record;
use conefield_core::{Error, Result};
use conefield_evaluation::report::text::bytes;
use conefield_io::{Contents, Lease, Progressed, folder_of};
use serde::Deserialize;
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// All files that a run writes.
pub const FILES: [&str; 10] = [
    "volume.nii.gz",
    "volume-hu.nii.gz",
    "metrics.jsonl",
    "spec.toml",
    "weights.safetensors",
    "slices.png",
    "live.png",
    "events.out.tfevents.conefield",
    "record.json",
    "checkpoint.safetensors",
];

/// The contents of a run's folder.
pub const CONTENTS: Contents = Contents { known, progressed };

/// Whether a run may have written this path.
pub fn known(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default();
    FILES.iter().any(|f| name == *f) || conefield_io::is_unfinished(name)
}

/// Whether `path` is the volume of a finished run, which is attenuation.
pub fn is_result(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name == FILES[0]) && folder_of(path).join("record.json").is_file()
}

/// The progress of the run in `folder`.
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

/// A folder reserved for this run.
pub struct RunFolder(pub Lease);

impl RunFolder {
    /// Reserves the folder, which need not exist yet, without changing it.
    pub fn take(path: &Path) -> Result<Self> {
        Lease::take(path, CONTENTS).map(Self)
    }

    /// Refuses a folder with other content than a run, and a run with progress unless `force`.
    pub fn may_begin(&self, force: bool) -> Result<()> {
        let place = self.0.path().display().to_string();
        CONTENTS.entries(self.0.path())?;
        // A spec without a record beside it is the user's.
        let has = |name: &str| self.file(name).symlink_metadata().is_ok();
        let own = has("spec.toml") && !has("metrics.jsonl");
        ensure(!own, &place, "output", "a folder with spec.toml in it", "a new or empty folder")?;
        let expected = "a new or empty folder, or --force to replace the run";
        ensure(force || self.0.progressed() == Progressed::Nothing, &place, "output", "an earlier run", expected)
    }

    /// Warns if the disk has less room than a volume of `volume` bytes may take.
    pub fn warn_without_room(&self, volume: u64) {
        let path = self.0.path();
        let place = if path.is_dir() { path } else { conefield_io::folder_of(path) };
        if let Some(free) = scratch::free(place).filter(|free| *free < volume) {
            tracing::warn!("{}: {} are free; the volume takes up to {}", place.display(), bytes(free), bytes(volume));
        }
    }

    /// Begins a run in the folder, emptying it; an earlier run is set aside until this one is complete. Writes the text
    /// `spec` and opens `metrics.jsonl`, which is written line by line.
    pub fn begin(&mut self, spec: &str) -> Result<(PathBuf, File)> {
        self.0.replace()?;
        let path = self.file("metrics.jsonl");
        // Before the spec: a spec alone is the user's, and a killed run must not look like one.
        let file = File::create(&path).map_err(|e| Error::io(&path, e))?;
        conefield_io::write_text_atomic(self.file("spec.toml"), spec)?;
        Ok((path, file))
    }

    /// The path of one of [`FILES`].
    pub fn file(&self, name: &str) -> PathBuf {
        debug_assert!(FILES.contains(&name));
        self.0.path().join(name)
    }

    /// Opens `metrics.jsonl` of an interrupted run without the records after `step`, which will be repeated. Also returns
    /// loss and held-out error of the last record that stays.
    pub fn metrics_until(&self, step: u64) -> Result<((PathBuf, File), Option<Record>)> {
        let path = self.file("metrics.jsonl");
        let io = |e| Error::io(&path, e);
        let text = fs::read(&path).map_err(io)?;
        let text = String::from_utf8_lossy(&text);
        // The last line may be incomplete.
        let records = text.lines().filter_map(|line| Some((line, serde_json::from_str::<Value>(line).ok()?)));
        let before: Vec<_> = records.filter(|(_, r)| r["step"].as_u64().is_some_and(|s| s <= step)).collect();
        let kept: String = before.iter().flat_map(|(line, _)| [line, "\n"]).collect();
        let [loss, held_out] = ["loss", "held_out"].map(|key| before.last().and_then(|(_, r)| r[key].as_f64()));
        let last = before.last().map(|_| Record { loss, held_out, ..Record::default() });
        conefield_io::write_text_atomic(&path, &kept)?;
        let file = File::options().append(true).open(&path).map_err(io)?;
        Ok(((path, file), last))
    }

    /// Finishes the run: removes its checkpoint and the run it replaced.
    pub fn finish(self) -> Result<()> {
        let path = self.file("checkpoint.safetensors");
        match fs::remove_file(&path) {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(Error::io(&path, e)),
            _ => self.0.complete(),
        }
    }
}

/// A run read from its folder.
pub struct RunOnDisk {
    /// Its folder.
    pub folder: PathBuf,
    /// The spec with all settings; empty if it is missing.
    pub spec: String,
    /// The lines of `metrics.jsonl`.
    pub curves: Vec<Value>,
    /// `record.json` of a finished run.
    pub record: Option<Value>,
    known: Option<Recorded>,
}

/// What other commands need of `record.json`.
/// A record of an earlier version may lack some of it.
#[derive(Deserialize)]
pub struct Recorded {
    #[serde(default)]
    pub version: String,
    pub spec: String,
    #[serde(default)]
    pub seed: u64,
    pub scan: ScanRecord,
    pub held_out_views: Vec<usize>,
    #[serde(default)]
    pub limits: EndOptions,
    #[serde(default)]
    pub budget_s: Option<f64>,
    pub reference: Option<String>,
    #[serde(default)]
    pub reference_fnv1a64: Option<String>,
    #[serde(default)]
    pub files: BTreeMap<String, String>,
    #[serde(default)]
    pub plugins: Vec<Used>,
    #[serde(default)]
    pub backend: Value,
    #[serde(default)]
    pub peak: f64,
}

impl Recorded {
    /// Reads the record in `folder`.
    pub fn read(folder: &Path) -> Result<Self> {
        read_json(&folder.join("record.json"))
    }
}

impl RunOnDisk {
    /// Whether `folder` is the folder of a run, judging by its files.
    pub fn is(folder: &Path) -> bool {
        let has = |name: &str| folder.join(name).is_file();
        has("record.json") || (has("spec.toml") && has("metrics.jsonl"))
    }

    /// Reads everything but the large files.
    pub fn read(folder: &Path) -> Result<Self> {
        let file = folder.join("record.json");
        let there = file.exists();
        let known = there.then(|| Recorded::read(folder)).transpose()?;
        let record = there.then(|| read_json(&file)).transpose()?;
        let text = |name: &str| match folder.join(name) {
            path if path.exists() => read_text(&path, LONGEST),
            _ => Ok(String::new()),
        };
        // The last line of a killed run may be incomplete.
        let curves = text("metrics.jsonl")?.lines().filter_map(|l| serde_json::from_str(l).ok()).collect();
        Ok(Self { folder: folder.to_path_buf(), spec: text("spec.toml")?, curves, record, known })
    }

    /// Whether the run is finished.
    pub fn is_complete(&self) -> bool {
        self.record.is_some()
    }

    /// The progress in words.
    pub fn status(&self) -> &'static str {
        match progressed(&self.folder) {
            Progressed::Complete => "complete",
            Progressed::Begun if self.folder.join("checkpoint.safetensors").exists() => {
                "interrupted: the same command with --resume continues"
            }
            Progressed::Begun => "interrupted before its record was written",
            Progressed::Nothing => "interrupted before its first checkpoint",
        }
    }

    /// The result of a finished run.
    pub fn volume(&self) -> Option<PathBuf> {
        Some(self.folder.join("volume.nii.gz")).filter(|v| self.is_complete() && v.exists())
    }

    /// The name in the spec.
    pub fn spec_name(&self) -> Option<&str> {
        self.known.as_ref().map(|k| &k.spec[..]).filter(|n| !n.is_empty())
    }

    /// The path from which it read the scan.
    pub fn scan_path(&self) -> Option<&Path> {
        self.known.as_ref().map(|k| Path::new(&k.scan.path))
    }

    /// The reference volume, as named on the command line.
    pub fn reference(&self) -> Option<&Path> {
        self.known.as_ref()?.reference.as_ref().map(Path::new)
    }

    /// Held-out views.
    pub fn held_out(&self) -> &[usize] {
        self.known.as_ref().map_or(&[], |k| &k.held_out_views)
    }

    /// Whether `scan` is the one it used, as far as known.
    pub fn is_of(&self, scan: &ScanRecord) -> bool {
        self.known.as_ref().is_none_or(|k| {
            (&k.scan.projections_fnv1a64, &k.scan.geometry_fnv1a64)
                == (&scan.projections_fnv1a64, &scan.geometry_fnv1a64)
        })
    }

    /// Whether `other` used the same scan.
    pub fn same_scan(&self, other: &Self) -> bool {
        other.known.as_ref().is_none_or(|k| self.is_of(&k.scan))
    }
}
