//! Attenuation fields: MLP, voxel grid
