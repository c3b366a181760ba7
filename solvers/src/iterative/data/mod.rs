//! Data terms that a method may name.

pub mod least_squares;
pub mod noise_weighted;

pub use least_squares::LeastSquares;
pub use noise_weighted::NoiseWeighted;
