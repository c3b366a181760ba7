//! What every conefield stage must do, as a library: [`conformance::check`] takes any stage, built in or loaded.

pub mod conformance;
