//! Attenuation fields: MLP, voxel grid

pub mod mlp;
pub mod voxel_grid;
