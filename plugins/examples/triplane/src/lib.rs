//! A plugin with an encoder of three planes and three lines.

pub mod planes;

conefield_plugin::export!();
