//! The built-in data terms.

pub mod least_squares;
pub mod noise_weighted;

pub use noise_weighted::NoiseWeighted;
