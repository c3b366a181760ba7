//! Methods: scan in, volume out.
//!
//! - [`neural_field`] trains an attenuation field by stochastic gradients. [`training`] is its loop,
//!   with callbacks; [`pretrain`] trains a field on known volumes, for weights that other scans reuse.
//!   [`losses`], [`priors`] and [`optimizer`] hold the parts of training.
//! - [`gaussians`] trains a sum of Gaussians on whole views, in the same loop.
//! - [`fit`] adapts a pipeline to a scan, [`support`] and [`solid`] find the object's support, [`surround`] models
//!   attenuation beyond the volume.
//! - [`fdk`] is filtered back-projection.
//! - [`iterative`] refines voxels pass by pass: SART, CGLS, ASD-POCS, FISTA.
//! - [`chain`] runs methods one after the other.

pub mod chain;
pub mod fdk;
mod field_parts;
pub mod field_plan;
pub mod fit;
pub mod gaussians;
pub mod iterative;
pub mod losses;
pub mod neural_field;
pub mod optimizer;
pub mod pretrain;
pub mod priors;
pub mod rays;
pub mod schedule;
mod shadow;
pub mod solid;
pub mod support;
pub mod surround;
pub mod training;
mod waiting;
mod watched;
