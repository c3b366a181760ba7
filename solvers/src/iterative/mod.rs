//! Iterative methods on voxels: one driver, and an [`Iteration`] per method.
//!
//! A step is one pass over all views. After each, the driver records, checkpoints and checks the stopping criteria.
//!
//! - [`sart`], [`mlem`], [`cgls`], [`lsqr`], [`asd_pocs`], [`fista`]: the methods. [`shared`]: their common settings.
//! - [`data`], [`regularizers`], [`bases`]: the parts of FISTA. [`noise`]: estimation of a scan's noise.
//! - [`tv`], [`edges`]: total variation, and the edges that it may follow.
//! - [`problem`]: a scan with its system matrix, in a place. [`drive`]: the passes of a run. [`monitor`]: metrics during a run.

pub mod asd_pocs;
pub mod bases;
pub mod cgls;
pub mod data;
pub mod drive;
pub mod edges;
pub mod fista;
pub mod lsqr;
pub mod mlem;
mod model;
pub mod monitor;
pub mod noise;
pub mod order;
mod plan;
pub mod problem;
pub mod regions;
pub mod regularizers;
pub mod sart;
pub mod shared;
pub mod stop;
pub mod tv;

pub use drive::{Iteration, Pass};
pub use problem::Problem;
pub use shared::known_volume;
pub use stop::Stop;
