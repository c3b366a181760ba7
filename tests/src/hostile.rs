//! Hostile input: what every reader of the project is fed, by the mutation test of this package and by `fuzz/`.
//!
//! [`seeds`] writes a small valid input of every format with the project's own writers, [`PARSERS`] lists the readers,
//! [`mutate`] damages bytes, and [`watch`] runs a reader over them and reports panics, excessive memory use and hangs.

mod dicom;
pub mod mutate;
mod parsers;
pub mod seeds;
pub mod watch;

pub use parsers::{PARSERS, Parser, find};
