//! The built-in bases.

pub mod cubic;
pub mod voxels;

pub use cubic::Cubic;
pub use voxels::Voxels;
