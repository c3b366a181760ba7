//! Methods: scan in, volume out.
//!
//! - [`neural_field`] and [`line_field`] train an attenuation field by stochastic gradients. [`training`] is their loop, with
//!   its callbacks; [`pretrain`] trains a field on known volumes, for weights that other scans reuse. [`losses`] say what a
//!   difference costs, [`priors`] what the field is to be like, [`optimizer`] how gradients change parameters.
//! - [`gaussians`] trains a sum of Gaussians on whole views, in the same loop.
//! - [`fit`] finds out what a scan has need of, [`support`] where its object can be, [`surround`] what lies beyond the volume.
//! - [`fdk`] filters and back-projects.
//! - [`iterative`] improves voxels pass by pass: SART, CGLS, ASD-POCS, FISTA.
//! - [`chain`] runs methods one after the other.

pub mod chain;
pub mod fdk;
pub mod field_plan;
pub mod fit;
pub mod gaussians;
pub mod iterative;
pub mod line_field;
pub mod losses;
pub mod neural_field;
pub mod optimizer;
pub mod pretrain;
pub mod priors;
pub mod rays;
pub mod schedule;
mod shadow;
pub mod support;
pub mod surround;
pub mod training;
mod watched;
