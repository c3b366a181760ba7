//! The subcommands.

mod backends;
mod convert;
mod demo;
mod evaluate;
mod explain;
mod export;
mod import;
mod info;
mod pretrain;
mod reconstruct;
mod schema;
mod simulate;

use clap::{Args, Subcommand, ValueEnum};
use conefield_backend_cpu::Cpu;
use conefield_core::Result;
use conefield_core::backend::Backend;
use conefield_core::solver::Limits;
use serde::Serialize;

/// What to do.
#[derive(Subcommand)]
pub enum Command {
    /// Make a scan of a known volume.
    Simulate(simulate::Simulate),
    /// Make a scan of what a scanner gave.
    Import(import::Import),
    /// Reconstruct a volume from a scan.
    Reconstruct(reconstruct::Reconstruct),
    /// Train a field on known volumes, for weights that other scans start from (MCI).
    Pretrain(pretrain::Pretrain),
    /// Score a volume against a reference: PSNR, RMSE and three SSIMs.
    Evaluate(evaluate::Evaluate),
    /// Evaluate the field of a finished run at other voxels.
    Export(export::Export),
    /// Show what a spec builds: stages, widths, parameters, memory, work.
    Explain(explain::Explain),
    /// Say what a scan, volume or weights file holds.
    Info(info::Info),
    /// Rewrite a volume or a scan in another format.
    Convert(convert::Convert),
    /// List what can do the computing here.
    Backends(backends::Backends),
    /// Print the JSON Schema of spec files, for editors.
    Schema(schema::SchemaArgs),
    /// Simulate a small scan, reconstruct it in two ways and compare.
    Demo(demo::Demo),
}

/// Runs a subcommand.
pub fn run(command: Command) -> Result<()> {
    match command {
        Command::Simulate(c) => c.run(),
        Command::Import(c) => c.run(),
        Command::Reconstruct(c) => c.run(),
        Command::Pretrain(c) => c.run(),
        Command::Evaluate(c) => c.run(),
        Command::Export(c) => c.run(),
        Command::Explain(c) => c.run(),
        Command::Info(c) => c.run(),
        Command::Convert(c) => c.run(),
        Command::Backends(c) => c.run(),
        Command::Schema(c) => c.run(),
        Command::Demo(c) => c.run(),
    }
}

/// Which backend computes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum BackendChoice {
    /// The fastest here.
    #[default]
    Auto,
    /// Rayon and SIMD.
    Cpu,
}

impl BackendChoice {
    /// The backend.
    pub fn open(self) -> Box<dyn Backend> {
        match self {
            Self::Auto | Self::Cpu => Box::new(Cpu::new()),
        }
    }
}

/// When training ends, whichever comes first.
#[derive(Debug, Clone, Args, Serialize)]
pub struct Ends {
    /// Stop training after this time, such as 600s or 10m.
    #[arg(long, value_name = "TIME", value_parser = crate::parse::seconds)]
    #[serde(rename = "seconds")]
    pub budget: Option<f64>,
    /// Stop training after this many steps.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: Option<u64>,
}

impl Ends {
    /// As limits of a job.
    pub fn limits(&self) -> Limits {
        Limits { steps: self.steps, seconds: self.budget }
    }
}
