//! Projection of voxel volumes and its adjoint.
//!
//! - [`walk`]: where a ray meets voxels and for how long, by Siddon and by trilinear sampling. One walk serves both
//!   directions, so they are adjoint by construction.
//! - [`rays`]: a walk ray by ray, for any geometry.
//! - [`columns`]: Joseph for views whose detector columns run along z, as those of every untilted orbit do. All rays of
//!   a column then lie in one plane along z, and both interpolations run over neighbouring numbers in memory.
//! - [`bundles`]: Joseph for all other views.
//! - [`backproject`]: the voxel-driven, distance-weighted back-projection of FDK. It is not an adjoint.
//! - [`layout`]: how projections and volumes lie in memory for all of these.

pub mod backproject;
pub mod bundles;
pub mod columns;
pub mod layout;
pub mod rays;
mod stages;
#[cfg(test)]
mod tests;
pub mod walk;

pub use stages::{Joseph, Siddon, Trilinear};
