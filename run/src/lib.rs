//! From a scan and the name of a spec to a scored volume: the common code of command line and Python package.
//!
//! - [`specs`]: the built-in specs by name; [`method`]: a spec, built, with its memory.
//! - [`files`]: volumes, scans and weights by file name; [`plugins`]: libraries with stages; [`parse`]: parsers of
//!   values.
//! - [`backend`]: backends; [`memory`]: a run's memory and the available memory; [`machine`]: the current machine.
//! - [`reconstruct`]: a complete reconstruction in a few lines of Rust.
//! - [`input`]: inputs of a run; [`choose`]: choice of the method, also for a time budget.
//! - [`explain`]: explanation of a spec; [`score`]: comparison of a volume with its reference.
//! - [`simulation`], [`pretraining`], [`projection`]: the work of the commands of these names.

pub mod backend;
pub mod choose;
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
pub mod reconstruct;
pub mod score;
pub mod simulation;
pub mod specs;

// Stage types register themselves when their crate is linked.
use {
    conefield_encoders as _, conefield_fields as _, conefield_initializers as _, conefield_normalizers as _,
    conefield_projectors as _, conefield_solvers as _,
};
