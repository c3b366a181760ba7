//! Position encoders: grids of features (hash, permutohedral, dense, B-spline, planes), frequency, identity, concat.

pub mod b_spline_grid;
pub mod concat;
pub mod dense_grid;
pub mod frequency;
pub mod hash_grid;
pub mod identity;
mod levels;
pub mod permutohedral;
pub mod planes;
