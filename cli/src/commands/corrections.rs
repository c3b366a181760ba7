//! The option for corrections.

use clap::Args;
use conefield_core::Result;
use conefield_io::ScanSize;
use conefield_scans::corrections::{Applied, Corrections};
use std::path::Path;

/// Corrections of a scan.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Corrections")]
pub struct CorrectionOptions {
    /// Correct a fault: pixels, flux, rings, low-counts.photons=N, scatter.share=S, hardening.water.kvp=N,
    /// hardening.polynomial=[1.0, ...] or truncation. Settings are written like rings.window=21;
    /// docs/guide/corrections.md lists them. May be repeated; corrections run in the order of this list.
    #[arg(long, value_name = "NAME")]
    correct: Vec<String>,
}

impl CorrectionOptions {
    /// The corrections selected by the options.
    pub fn corrections(&self) -> Result<Corrections> {
        Corrections::parse(&self.correct)
    }
}

/// The size of a scan, with the memory that the corrections need.
pub fn corrected_size(size: ScanSize, corrections: &Corrections) -> ScanSize {
    let pixels = size.pixels.max(size.test_pixels);
    ScanSize { reading: size.reading.max(corrections.bytes(pixels)), ..size }
}

/// Logs the corrections applied to the scan at `path`.
pub fn log_applied(path: &Path, applied: &[Applied]) {
    for Applied { name, found, .. } in applied {
        tracing::info!("{}: {name}: {found}", path.display());
    }
}
