//! The option that asks for corrections.

use clap::Args;
use conefield_core::Result;
use conefield_corrections::{Applied, Corrections};
use conefield_io::ScanSize;
use std::path::Path;

/// What is mended in a scan.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Corrections")]
pub struct CorrectionOptions {
    /// Mend a fault: pixels, flux, rings, low-counts.photons=N, scatter.share=S, hardening.water.kvp=N,
    /// hardening.polynomial=[1.0, ...] or truncation. Further settings alike, as rings.window=21; docs/guide/corrections.md has all. May be
    /// repeated; the order is fixed: that of this list.
    #[arg(long, value_name = "NAME")]
    correct: Vec<String>,
}

impl CorrectionOptions {
    /// What they ask for.
    pub fn corrections(&self) -> Result<Corrections> {
        Corrections::parse(&self.correct)
    }
}

/// The size of a scan with what the corrections take beside it.
pub fn corrected_size(size: ScanSize, corrections: &Corrections) -> ScanSize {
    let pixels = size.pixels.max(size.test_pixels);
    ScanSize { reading: size.reading.max(corrections.bytes(pixels)), ..size }
}

/// Tells what was done to the scan at `path`.
pub fn tell(path: &Path, applied: &[Applied]) {
    for Applied { name, found, .. } in applied {
        tracing::info!("{}: {name}: {found}", path.display());
    }
}
