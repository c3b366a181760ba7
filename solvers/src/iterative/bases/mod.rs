//! The built-in bases.

pub mod cubic;
pub mod voxels;

pub use voxels::Voxels;
