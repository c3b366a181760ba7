//! The record of a run.

use crate::machine::Machine;
use crate::memory::Memory;
use crate::plugins::Used;
use crate::tradeoff::json::to_json;
use crate::tradeoff::schedule::{Reason, Schedule};
use conefield_core::backend::Explain;
use conefield_core::method::Limits;
use conefield_core::place::Moved;
use conefield_core::scan::{Scan, Unit};
use conefield_core::words::counted;
use conefield_core::{Result, checksum};
use conefield_evaluation::hounsfield::Levels;
use conefield_evaluation::metrics::Scores;
use conefield_evaluation::report::text::stem;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Everything needed to repeat a run, and its result.
#[derive(Debug, Serialize)]
pub struct RunRecord {
    /// The version of conefield.
    pub version: &'static str,
    /// The name of the spec.
    pub spec: String,
    /// The seed of all random numbers.
    pub seed: u64,
    /// The scan, if it was read from files.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scan: Option<ScanRecord>,
    /// Indices of the held-out views.
    pub held_out_views: Vec<usize>,
    /// Ends of training; the first one reached ends it.
    pub limits: Limits,
    /// Seconds of the budget.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub budget_s: Option<f64>,
    /// The plan of a budget.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub plan: Option<Schedule>,
    /// Weights or volume to start from.
    pub init: Option<String>,
    /// The reference.
    pub reference: Option<String>,
    /// Checksum of the voxels of the reference.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reference_fnv1a64: Option<String>,
    /// Checksums of the files that the spec names.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub files: BTreeMap<String, String>,
    /// Water and air of volume-hu.nii.gz, per unit of the scan.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hounsfield: Option<Levels>,
    /// The plugins whose stages the spec names.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub plugins: Vec<Used>,
    /// The backend, and what it compiled.
    pub backend: Explain,
    /// All backends of a run that was resumed on another one.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub backends: Vec<Stretch>,
    /// Bytes that crossed between the host and the backend's device; 0 on the CPU.
    pub moved: Moved,
    /// Number of processes.
    pub processes: usize,
    /// The instruction set.
    pub simd: String,
    /// Number of threads.
    pub threads: usize,
    /// The machine.
    pub machine: Machine,
    /// The memory estimate.
    pub memory: Memory,
    /// Bytes at the peak, measured.
    pub peak_bytes: Option<u64>,
    /// Steps or passes.
    pub steps: u64,
    /// Number of returns to an earlier state after training diverged.
    pub rollbacks: u64,
    /// Seconds to read the inputs.
    pub load_s: f64,
    /// Seconds of solving without training: before the first step, and for metrics.
    pub prepare_s: f64,
    /// Seconds of training.
    pub train_s: f64,
    /// Written files and the time for them.
    #[serde(flatten)]
    pub written: Written,
    /// Seconds from the start of the command to this record. Before a --resume only training counts.
    pub total_s: f64,
    /// Training samples.
    pub samples: u64,
    /// For methods that take samples.
    pub samples_per_s: Option<f64>,
    /// The last loss.
    pub loss: Option<f64>,
    /// Held-out error of the result.
    pub held_out: Option<f64>,
    /// The step of the result, if held-out views selected it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best_step: Option<u64>,
    /// The data range of scores.
    pub peak: f64,
}

/// The steps of a run on one backend, up to the next one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Stretch {
    /// The backend.
    pub backend: String,
    /// Steps before.
    pub from_step: u64,
}

/// What the record of a resumed run takes from the run before, through the checkpoint.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct History {
    /// The backends, in order.
    pub backends: Vec<Stretch>,
    /// Why the run has its method, within a budget.
    pub reason: Option<Reason>,
}

/// Written files and the time for them.
#[derive(Debug, Serialize)]
pub struct Written {
    /// Number of parameters of a field.
    pub parameters: usize,
    /// Seconds to write weights and voxels.
    pub export_s: f64,
    /// Seconds to draw the slices.
    pub picture_s: f64,
    /// Seconds to compute the scores.
    pub score_s: f64,
    /// Scores against the reference.
    pub scores: Option<Scores>,
}

/// Identifies a scan.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ScanRecord {
    /// Path from which it was read.
    pub path: String,
    /// Number of views.
    pub views: usize,
    /// Rows and columns of the detector.
    pub detector: [usize; 2],
    /// Shape of the volume.
    pub volume: [usize; 3],
    /// Checksum of all line integrals.
    pub projections_fnv1a64: String,
    /// Checksum of geometry and unit.
    pub geometry_fnv1a64: String,
    /// The unit of the volume's values, per unit; records of earlier versions do not have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<Unit>,
}

impl ScanRecord {
    /// The record of the whole scan read from `path`.
    pub fn of(path: &Path, scan: &Scan) -> Result<Self> {
        let placed = to_json(&(&scan.geometry, &scan.unit))?;
        Ok(Self {
            path: path.display().to_string(),
            views: scan.geometry.views.len(),
            detector: scan.geometry.detector,
            volume: scan.geometry.volume.shape,
            projections_fnv1a64: checksum::of_numbers(&scan.projections),
            geometry_fnv1a64: checksum::of_text(&placed),
            unit: Some(scan.unit.clone()),
        })
    }

    /// The name of its file or folder.
    pub fn name(&self) -> String {
        stem(&self.path)
    }

    /// Text for people.
    pub fn line(&self) -> String {
        let (views, [rows, columns], [x, y, z]) = (counted(self.views, "view"), self.detector, self.volume);
        format!("{}: {views} of {rows} x {columns} pixels, {x} x {y} x {z} voxels", self.path)
    }
}
