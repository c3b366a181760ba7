//! Solvers: scan in, volume out.
//!
//! - [`gradient`] trains an attenuation field by stochastic gradients; [`pretrain`] trains one on a known volume, for
//!   weights that other scans reuse.
//! - [`fit`] finds out what a scan has need of, [`support`] where its object can be, [`refine`] where the field that is
//!   trained has nothing in it, [`surround`] what lies beyond the volume.
//! - [`drift`] measures how much of a field changes while it trains.
//! - [`guard`] takes a run that goes astray back, [`patience`] ends one that no longer gets better.
//! - [`fdk`] filters and back-projects.
//! - [`sequence`] lets one solver go on where another one ended.
//! - [`iterative`] improves voxels pass by pass: SART, CGLS, ASD-POCS, FISTA.

pub mod drift;
pub mod fdk;
pub mod fit;
pub mod gradient;
pub mod guard;
pub mod iterative;
pub mod patience;
pub mod pretrain;
pub mod rays;
pub mod refine;
pub mod schedule;
pub mod sequence;
mod shadow;
pub mod support;
pub mod surround;
mod watched;
