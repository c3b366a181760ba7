//! Attenuation fields: MLP, line transformer, voxel grid, and voxels with line integrals of their own.

pub mod line_transformer;
mod linear;
pub mod mlp;
pub mod voxel_grid;
pub mod voxels_joseph;
