//! Ray sampling and Beer-Lambert integration; projection of voxel volumes.
pub mod ray_march;
pub mod simulate;
pub mod voxel;
