//! Ray sampling and Beer-Lambert integration for fields; line integrals of voxels with their adjoint; simulation of
//! scans.
pub mod ray_march;
pub mod simulate;
pub mod voxel;
