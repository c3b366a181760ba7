//! Losses between predicted and measured line integrals.

mod huber;
mod l1;
mod l2;
mod noise_weighted;

pub use huber::Huber;
pub use l1::L1;
pub use l2::L2;
pub use noise_weighted::NoiseWeighted;
