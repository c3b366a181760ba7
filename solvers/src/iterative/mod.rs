//! Iterative methods on voxels: one driver, and an [`Iteration`] each.
//!
//! A step is one pass over all views. After each the driver reports, checkpoints, and looks at what ends the run.
//!
//! - [`sart`], [`cgls`], [`asd_pocs`], [`fista`]: the methods. [`shared`]: what all of them are given.
//! - [`data`], [`regularizers`], [`bases`]: what FISTA is put together from. [`noise`]: what a scan says of its noise.
//! - [`tv`], [`edges`]: total variation, and the edges that it may follow.
//! - [`problem`]: a scan with its system matrix. [`drive`]: the passes of a run. [`monitor`]: what is looked at meanwhile.

pub mod asd_pocs;
pub mod bases;
pub mod cgls;
pub mod data;
pub mod drive;
pub mod edges;
pub mod fista;
mod model;
pub mod monitor;
pub mod noise;
pub mod norms;
pub mod order;
mod plan;
pub mod problem;
pub mod regularizers;
pub mod sart;
pub mod shared;
pub mod stop;
pub mod tv;

use conefield_core::scan::ScanHeader;
use conefield_core::scene::SupportRule;
use ndarray::Array3;

pub use drive::{Iteration, Pass};
pub use problem::Problem;
pub use shared::known_volume;
pub use stop::Stop;

/// Bytes of the mask that says where the object can be.
pub fn mask_bytes(rule: SupportRule, header: &ScanHeader) -> u64 {
    match rule {
        SupportRule::Box => 0,
        SupportRule::Carve => header.voxels(),
    }
}

/// All of an array that this crate made.
pub(crate) fn flat(x: &Array3<f32>) -> &[f32] {
    x.as_slice().unwrap_or_else(|| unreachable!("arrays of this crate are contiguous"))
}

/// Like [`flat`], to be written.
pub(crate) fn flat_mut(x: &mut Array3<f32>) -> &mut [f32] {
    x.as_slice_mut().unwrap_or_else(|| unreachable!("arrays of this crate are contiguous"))
}
