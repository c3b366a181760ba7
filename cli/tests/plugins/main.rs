//! Plugins, built and loaded as third parties would: by cargo and cc, from folders outside the workspace.
#![cfg(unix)]

mod bits;
mod build;
#[path = "../common/mod.rs"]
mod common;
mod examples;
mod faulty;
mod new;
mod trust;
