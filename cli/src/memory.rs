//! What a run will hold in memory.

use conefield_core::backend::Explain;
use conefield_core::pipeline::Pipeline;
use conefield_core::scan::Scan;
use serde::Serialize;

/// Bytes by what holds them.
#[derive(Debug, Clone, Serialize)]
pub struct Memory {
    /// The projections.
    pub projections: u64,
    /// The volume that comes out.
    pub volume: u64,
    /// The reference volume, where there is one.
    pub reference: u64,
    /// Parameters, gradients and both moments.
    pub model: u64,
    /// What the backend works in.
    pub scratch: u64,
    /// All of it.
    pub total: u64,
}

impl Memory {
    /// What reconstructing `scan` with `pipeline` takes.
    pub fn of(pipeline: &Pipeline, scan: &Scan, backend: &Explain, with_reference: bool) -> Self {
        let volume = 4 * scan.geometry.volume.len().unwrap_or(0) as u64;
        let projections = 4 * scan.projections.len() as u64;
        let reference = if with_reference { volume } else { 0 };
        let model = 16 * pipeline.layout().len() as u64;
        let scratch = backend.scratch_bytes as u64;
        let total = projections + volume + reference + model + scratch;
        Self { projections, volume, reference, model, scratch, total }
    }

    /// In words.
    pub fn line(&self) -> String {
        let b = crate::out::bytes;
        let reference = if self.reference > 0 { format!(", reference {}", b(self.reference)) } else { String::new() };
        format!(
            "{} (projections {}, volume {}{reference}, model and optimizer {}, backend {})",
            b(self.total),
            b(self.projections),
            b(self.volume),
            b(self.model),
            b(self.scratch),
        )
    }
}
