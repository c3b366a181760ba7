//! A whole run in a search or a comparison: its inputs and its figures.

use crate::input::Input;
use crate::machine::Machine;
use crate::record::ScanRecord;
use conefield_evaluation::report::MiddleSlices;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// What is known about the input after it has been read.
pub struct TrialInput {
    /// The whole scan.
    pub scan: ScanRecord,
    /// Indices of the held-out views.
    pub held: Vec<usize>,
    /// The middle slices of the reference volume.
    pub reference: Option<MiddleSlices>,
    /// Checksum of the voxels of the reference volume.
    pub reference_fnv1a64: Option<String>,
    /// The data range of the scores.
    pub peak: f64,
}

impl TrialInput {
    /// The parts of `input` that are kept; `scan` is the record of its scan.
    pub fn of(input: Input, scan: ScanRecord) -> Self {
        let Input { held, reference, reference_fnv1a64, peak, .. } = input;
        Self { scan, held, reference: reference.as_ref().map(MiddleSlices::of), reference_fnv1a64, peak }
    }
}

/// The figures in a run's `record.json`, by the same names.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Figures {
    /// Steps or passes.
    pub steps: u64,
    /// Time for all steps in seconds.
    pub train_s: f64,
    /// Time for writing weights and voxels in seconds.
    pub export_s: f64,
    /// Time of the whole run in seconds.
    pub total_s: f64,
    /// Peak memory.
    pub peak_bytes: Option<u64>,
    /// Number of threads.
    pub threads: usize,
    /// Number of parameters of a field.
    pub parameters: usize,
    /// Samples evaluated in training.
    pub samples: u64,
    /// For solvers that use samples.
    pub samples_per_s: Option<f64>,
    /// The last loss.
    pub loss: Option<f64>,
    /// Error of held-out views, relative to the largest line integral.
    pub held_out: Option<f64>,
    /// Scores as recorded, with the reasons for missing ones.
    pub scores: Option<Value>,
    /// The machine, which tables do not repeat beside them.
    #[serde(default, skip_serializing)]
    pub machine: Option<Machine>,
    /// The backend, as the machine.
    #[serde(default, skip_serializing)]
    pub backend: Option<Computing>,
}

/// The part of a record on its backend that figures have.
#[derive(Debug, Clone, Deserialize)]
pub struct Computing {
    /// Name of the backend, with the instruction set or device.
    pub backend: String,
}

impl Figures {
    /// PSNR in dB; infinite, which JSON cannot represent, if the result equals the reference.
    pub fn psnr(&self) -> Option<f64> {
        self.scores.as_ref().map(|s| s["psnr"].as_f64().unwrap_or(f64::INFINITY))
    }

    /// A score, if defined.
    pub fn score(&self, name: &str) -> Option<f64> {
        self.scores.as_ref().and_then(|s| s[name].as_f64())
    }
}
