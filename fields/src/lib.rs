//! Attenuation fields: MLP, line transformer, voxel grid, and voxels with line integrals of their own.

pub mod line_transformer;
mod linear;
pub mod mlp;
#[cfg(test)]
mod testing;
pub mod voxel_grid;
pub mod voxels_joseph;
