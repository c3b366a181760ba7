//! Attenuation fields: MLP, voxel grid, voxels with line integrals of their own.

pub mod mlp;
pub mod voxel_grid;
pub mod voxels_joseph;
