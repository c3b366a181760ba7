//! Studies: many reconstructions under one protocol, every method on every scan with every seed, and their statistics.
//!
//! - [`definition`]: a study, parsed and validated before anything runs; [`schema`](definition::schema) is for editors.
//! - [`method`]: a named spec with its plan; [`outcome`]: the outcome of its run, and its table columns.
//! - [`simulation`]: the scans that a study simulates; [`layout`]: the layout of a study's folder.
//! - [`report`]: means, spreads and paired differences as table and JSON; [`pictures`]: slices and curves.
//! - [`slurm`]: the script of a job array.
//!
//! Single comparisons use the methods and outcomes too. The caller starts the runs.

pub mod definition;
pub mod layout;
pub mod method;
pub mod outcome;
pub mod pictures;
pub mod report;
pub mod simulation;
pub mod slurm;
mod spread;
mod written;

pub use spread::Spread;
