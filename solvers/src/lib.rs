//! Solvers: scan in, volume out.
//!
//! [`gradient`] trains an attenuation field by stochastic gradients; [`pretrain`] trains one on a known volume, for
//! weights that other scans reuse.

pub mod gradient;
pub mod pretrain;
pub mod rays;
pub mod schedule;
