//! Losses: how far predicted line integrals are from the measured ones.

mod huber;
mod l1;
mod l2;
mod noise_weighted;

pub use huber::Huber;
pub use l1::L1;
pub use l2::L2;
pub use noise_weighted::NoiseWeighted;
