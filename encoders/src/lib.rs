//! Position encoders: hash grid, dense grid, frequency, concat
pub mod hash_grid;
