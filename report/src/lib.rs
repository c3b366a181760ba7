//! Pictures of results, as PNG.
//!
//! - [`slices_png`], [`compare_png`], [`features_png`]: the middle slices of volumes.
//! - [`curves_png`], [`panels_png`]: line plots.
//! - [`survey_png`]: a scan's geometry.
//!
//! The font is part of the program: a picture does not depend on what the system has.

mod canvas;
mod curves;
mod slices;
mod survey;

#[cfg(test)]
mod testing;

pub use curves::{Corner, CurveOptions, Panel, curves_png, curves_png_with, panels_png};
pub use slices::{MiddleSlices, compare_png, features_png, slices_png};
pub use survey::survey_png;
