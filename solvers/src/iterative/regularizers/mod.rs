//! Regularizers that a method may name.

pub mod none;
pub mod total_variation;

pub use none::Nonnegative;
pub use total_variation::TotalVariation;
