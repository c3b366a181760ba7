//! From a scan and the name of a spec to a volume with its scores: what the command and the Python package share.
//!
//! - [`specs`]: the specs that come with the program, found by name; [`method`]: a spec built and priced.
//! - [`files`]: volumes, scans and weights as users name them; [`plugins`]: libraries with stages; [`parse`]: values as
//!   users write them.
//! - [`backend`]: what computes; [`memory`]: what a run will hold, and what there is; [`machine`]: where it runs.
//! - [`reconstruct`]: all of it in a few lines of Rust.
//! - [`input`]: what a run reads; [`choose`]: the method for it, within a budget of time too.
//! - [`explain`]: what a spec builds; [`score`]: how far a volume is from its reference.
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
