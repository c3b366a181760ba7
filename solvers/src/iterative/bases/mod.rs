//! Bases that a method may name.

pub mod voxels;

pub use voxels::Voxels;
