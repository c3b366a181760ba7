//! Attenuation fields: MLP, voxel grid
pub mod mlp;
