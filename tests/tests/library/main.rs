//! Stages, methods and backends together, through the library. One program for all: each program that is linked costs seconds.

#[path = "../common/mod.rs"]
#[allow(dead_code)]
mod common;
#[path = "../device/mod.rs"]
mod device;

mod by_row;
mod coarse_to_fine;
mod composition;
mod core_modules;
mod crates;
mod drift;
mod gaussians;
mod gaussians_on_device;
mod guard;
mod live;
mod masks;
mod patience;
mod pipeline;
mod places;
mod ranks;
mod regions;
mod wgpu;
