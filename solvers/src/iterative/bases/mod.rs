//! Bases that a method may name.

pub mod cubic;
pub mod voxels;

pub use cubic::Cubic;
pub use voxels::Voxels;
