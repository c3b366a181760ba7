//! Plugins, built and loaded as by third parties: with cargo and cc, from folders outside the workspace.
#![cfg(unix)]

mod bits;
mod build;
#[path = "../common/mod.rs"]
mod common;
mod examples;
mod faulty;
mod new;
mod trust;
