//! Solvers: scan in, volume out.
//!
//! - [`gradient`] trains an attenuation field by stochastic gradients, [`training`] is its loop; [`pretrain`] trains one on a
//!   known volume, for weights that other scans reuse.
//! - [`fit`] finds out what a scan has need of, [`support`] where its object can be, [`surround`] what lies beyond the volume.
//! - [`fdk`] filters and back-projects.
//! - [`sequence`] lets one solver go on where another one ended.
//! - [`iterative`] improves voxels pass by pass: SART and its kin, CGLS, ASD-POCS, FISTA with total variation.

pub mod fdk;
pub mod fit;
pub mod gradient;
pub mod iterative;
pub mod pretrain;
pub mod rays;
pub mod refine;
pub mod schedule;
pub mod sequence;
mod shadow;
pub mod support;
pub mod surround;
pub mod training;
mod watched;
