//! Projection of voxel volumes and its adjoint.
//!
//! - [`walk`]: where a ray meets voxels and for how long, by Siddon and by trilinear sampling. One walk serves both
//!   directions, so they are adjoint by construction.
//! - [`rays`]: a walk ray by ray, for any geometry.
//! - [`columns`]: Joseph for views whose detector columns run along z, or nearly so, as those of every circular orbit do.
//!   The rows of a column then read lines of voxels upwards, where voxels are neighbours in memory.
//! - [`bundles`]: Joseph for all other views.
//! - [`backproject`]: the voxel-driven, distance-weighted back-projection of FDK. It is not an adjoint.
//! - [`layout`]: how projections and volumes lie in memory for all of these.

pub mod backproject;
pub mod bundles;
pub mod columns;
pub mod layout;
pub mod rays;
mod readers;
mod stages;
#[cfg(test)]
mod tests;
pub mod walk;

pub use stages::{Joseph, Siddon, Trilinear};
