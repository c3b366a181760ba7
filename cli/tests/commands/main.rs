//! Tests of every command in one program, because linking each one costs seconds.

#[path = "../common/mod.rs"]
mod common;

mod backends;
#[cfg(unix)]
mod boundary;
mod budget;
mod calibrate;
mod chain;
mod compare;
mod corrections;
#[cfg(target_os = "linux")]
mod durability;
mod experiments;
mod explain;
#[cfg(unix)]
mod guide;
mod help;
mod hounsfield;
mod import;
mod memory;
mod peak;
mod project;
mod quality;
mod refusals;
mod report;
#[cfg(unix)]
mod resume;
mod schema;
mod scratch;
mod selection;
mod study;
mod tradeoff;
mod unusual;
