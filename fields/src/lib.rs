//! All of a neural field but its encoder.
//!
//! - [`mlp`], [`line_transformer`], [`voxel_grid`]: attenuation fields.
//! - [`normalizers`]: between encoder and field; [`initializers`]: of the parameters.

pub mod initializers;
pub mod line_transformer;
mod linear;
pub mod mlp;
pub mod normalizers;
mod passes;
pub mod voxel_grid;
