//! Projectors of voxel volumes and their adjoints.
//!
//! - [`walk`]: the voxels along a ray and their lengths, by Siddon and by trilinear sampling. One walk serves both
//!   directions, so they are adjoint by construction.
//! - [`rays`]: projection ray by ray, for any geometry.
//! - [`columns`]: Joseph for views whose detector columns run along z, or nearly so, as on every circular orbit. The
//!   rows of a column then read lines of voxels upwards, which are contiguous in memory.
//! - [`bundles`]: Joseph for all other views.
//! - [`backproject`]: the voxel-driven, distance-weighted back-projection of FDK. It is not an adjoint. `upright`: the
//!   same for detector columns along z.
//! - [`layout`]: memory layouts of projections and volumes for all of these.

pub mod backproject;
pub mod bundles;
pub mod columns;
pub mod layout;
pub mod rays;
mod readers;
mod stages;
#[cfg(test)]
mod tests;
mod upright;
pub mod walk;

pub use stages::{Joseph, Siddon, Trilinear};
