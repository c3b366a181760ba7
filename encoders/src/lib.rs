//! Position encoders: hash grid, dense grid, frequency, identity, concat.

pub mod concat;
pub mod dense_grid;
pub mod frequency;
pub mod hash_grid;
pub mod identity;
mod levels;
