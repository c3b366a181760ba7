//! Pictures of results as PNG, and numbers in words and tables.
//!
//! - [`slices_png`], [`compare_png`], [`features_png`]: the middle slices of volumes.
//! - [`curves_png`], [`panels_png`]: line plots.
//! - [`survey_png`]: a scan's geometry.
//! - [`page`]: runs in one HTML file, with a viewer.
//! - [`Table`] and [`text`]: human-readable numbers.
//!
//! The font is part of the program, so that pictures do not depend on system fonts.

mod canvas;
mod curves;
pub mod page;
mod pixels;
mod slices;
mod survey;
mod table;
pub mod text;

#[cfg(test)]
mod testing;

pub use curves::{Band, Corner, CurveOptions, Panel, curves_png, curves_png_with, panels_png};
pub use pixels::{Pixels, Rgb};
pub use slices::{MiddleSlices, compare_png, features_png, result_png, slices_png};
pub use survey::survey_png;
pub use table::Table;
