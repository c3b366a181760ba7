//! A whole run as a part of a search or a comparison: what goes in, and which figures come out.

use crate::json::{read_json, to_json};
use conefield_core::Result;
use conefield_core::scan::{Scan, Volume};
use conefield_report::MiddleSlices;
use conefield_report::text::stem;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;

/// Which scan it was.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ScanRecord {
    /// Where it was read from.
    pub path: String,
    /// How many views it has.
    pub views: usize,
    /// Rows and columns of its detector.
    pub detector: [usize; 2],
    /// Voxels that it asks for.
    pub volume: [usize; 3],
    /// Of all line integrals.
    pub projections_fnv1a64: String,
    /// Of where everything stood, and of the unit.
    pub geometry_fnv1a64: String,
}

impl ScanRecord {
    /// The whole scan that was read from `path`.
    pub fn of(path: &Path, scan: &Scan) -> Result<Self> {
        let placed = to_json(&(&scan.geometry, &scan.unit))?;
        Ok(Self {
            path: path.display().to_string(),
            views: scan.geometry.views.len(),
            detector: scan.geometry.detector,
            volume: scan.geometry.volume.shape,
            projections_fnv1a64: checksum(scan.projections.iter().flat_map(|x| x.to_le_bytes())),
            geometry_fnv1a64: checksum(placed.into_bytes().into_iter()),
        })
    }

    /// The name of its file or folder.
    pub fn name(&self) -> String {
        stem(&self.path)
    }

    /// In words.
    pub fn line(&self) -> String {
        let (views, [rows, columns], [x, y, z]) = (self.views, self.detector, self.volume);
        format!("{}: {views} views of {rows} x {columns} pixels, {x} x {y} x {z} voxels", self.path)
    }
}

/// FNV-1a, to recognise a scan by.
fn checksum(bytes: impl Iterator<Item = u8>) -> String {
    let hash = bytes.fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3));
    format!("{hash:016x}")
}

/// What is known of the input once all of it was looked at.
pub struct TrialInput {
    /// The whole scan.
    pub scan: ScanRecord,
    /// Indices of the held-out views.
    pub held: Vec<usize>,
    /// What is known of the volume sought.
    pub reference: Option<MiddleSlices>,
    /// The data range that scores refer to.
    pub peak: f64,
}

impl TrialInput {
    /// Of the scan that was read from `path`; little of it is kept. Views to hold out that leave none to work with are
    /// refused.
    pub fn of(path: &Path, scan: Scan, reference: Option<&Volume>, peak: f64, held: Vec<usize>) -> Result<Self> {
        let record = ScanRecord::of(path, &scan)?;
        if !held.is_empty() {
            scan.split(&held)?;
        }
        Ok(Self { scan: record, held, reference: reference.map(MiddleSlices::of), peak })
    }
}

/// What a table takes from a run's `record.json`, under the names that it has there.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Figures {
    /// Steps or passes.
    pub steps: u64,
    /// Seconds of them all.
    pub train_s: f64,
    /// Seconds of writing weights and voxels.
    pub export_s: f64,
    /// Seconds of the whole run.
    pub total_s: f64,
    /// The most memory that it held.
    pub peak_bytes: Option<u64>,
    /// Threads that it worked in.
    pub threads: usize,
    /// Of a field.
    pub parameters: usize,
    /// Samples that were evaluated in training.
    pub samples: u64,
    /// Of solvers that take samples.
    pub samples_per_s: Option<f64>,
    /// The last one.
    pub loss: Option<f64>,
    /// Error of held-out views, over the largest line integral.
    pub held_out: Option<f64>,
    /// Kept as it stands, with the reasons for what is missing.
    pub scores: Option<Value>,
}

impl Figures {
    /// Of the finished run in `folder`.
    pub fn of_run(folder: &Path) -> Result<Self> {
        read_json(&folder.join("record.json"))
    }

    /// dB; infinite, which JSON has no number for, where the result is the reference.
    pub fn psnr(&self) -> Option<f64> {
        self.scores.as_ref().map(|s| s["psnr"].as_f64().unwrap_or(f64::INFINITY))
    }

    /// One of the scores, where it is defined.
    pub fn score(&self, name: &str) -> Option<f64> {
        self.scores.as_ref().and_then(|s| s[name].as_f64())
    }
}
