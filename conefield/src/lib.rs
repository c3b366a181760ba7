//! Reconstruction of CT volumes from few cone-beam X-ray views.
//!
//! [`read_scan`] reads a scan, [`Reconstruct`] turns it into a volume, [`io`] writes both, and [`simulate`] makes scans
//! of known volumes.
//!
//! ```no_run
//! # fn main() -> conefield::Result<()> {
//! let scan = conefield::read_scan("scan")?;
//! let result = conefield::Reconstruct::with("smooth-tv").run(scan)?;
//! conefield::io::write_volume("volume.nii.gz", &result.volume)?;
//! # Ok(())
//! # }
//! ```
//!
//! The command and the Python package use the other modules:
//!
//! - [`specs`]: the shipped specs by name; [`method`]: a spec, built, with its memory.
//! - [`files`]: volumes, scans and weights by file name; [`plugins`]: libraries with stages; [`parse`]: parsers of
//!   values.
//! - [`backend`]: backends; [`memory`]: a run's memory and the available memory; [`scratch`]: arrays beyond it;
//!   [`machine`]: the current machine.
//! - [`session`]: every run, from its inputs ([`input`]) to its [`record`].
//! - [`ranks`]: several processes for one run.
//! - [`hounsfield`]: Hounsfield units of a written volume.
//! - [`explain`]: explanation of a spec; [`score`]: comparison of a volume with its reference.
//! - [`simulation`], [`pretraining`], [`projection`]: the work of the commands of these names.
//! - `study`: many runs under one protocol; [`tradeoff`]: time, memory and accuracy of methods.
//!
//! The feature `wgpu` adds GPUs, and `mpi` adds runs of several processes. The feature `plots` adds pictures, plots and
//! pages, and the studies and searches that draw them.

pub mod backend;
mod devices;
pub mod explain;
pub mod files;
pub mod input;
pub mod machine;
pub mod memory;
pub mod method;
pub mod parse;
pub mod plugins;
pub mod pretraining;
pub mod projection;
pub mod ranks;
pub mod reconstruct;
pub mod record;
mod rehearsal;
pub mod score;
pub mod session;
pub mod shipped;
pub mod simulation;
pub mod specs;
#[cfg(feature = "plots")]
pub mod study;
pub mod tradeoff;

pub use conefield_core::{Error, Result, geometry, scan, scratch, spec};
pub use conefield_evaluation::{hounsfield, metrics};
pub use conefield_io as io;
pub use conefield_projectors::simulate;
pub use conefield_scans::read_scan;
pub use reconstruct::{Reconstruct, Reconstructed};

// Stage types register themselves when their crate is linked.
use {conefield_encoders as _, conefield_fields as _, conefield_projectors as _, conefield_solvers as _};
