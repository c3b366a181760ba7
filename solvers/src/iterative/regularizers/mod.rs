//! The built-in regularizers.

pub mod directional_total_variation;
pub mod none;
pub mod patches;
pub mod sum;
pub mod total_variation;

pub use none::Nonnegative;
pub use total_variation::TotalVariation;
