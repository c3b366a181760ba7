//! Many reconstructions under one protocol: every method on every scan, with every seed, and what they come to.
//!
//! - [`study`]: a study, read from its file and checked whole before anything runs; [`schema`](study::schema) is for editors.
//! - [`method`]: a spec that is built, under a name of its own; [`outcome`]: what became of its run, and the columns for it.
//! - [`simulation`]: the scans that a study simulates; [`layout`]: where all of it lies in a study's folder.
//! - [`report`]: means, spreads and paired differences as table and JSON; [`pictures`]: slices and curves.
//! - [`slurm`]: the script of an array of jobs.
//!
//! A single comparison has its methods and outcomes from here too. How a run is started is the caller's matter.

pub mod layout;
pub mod method;
pub mod outcome;
pub mod pictures;
pub mod report;
pub mod simulation;
pub mod slurm;
mod spread;
pub mod study;
mod written;

pub use spread::Spread;
