//! Pictures of results as PNG, and numbers in words and tables.
//!
//! - `slices_png`, `compare_png`, `features_png`: the middle slices of volumes.
//! - `curves_png`, `panels_png`: line plots.
//! - `survey_png`: a scan's geometry.
//! - `page`: runs in one HTML file, with a viewer.
//! - [`Table`] and [`text`]: human-readable numbers.
//!
//! All that draws needs the feature `plots`. The font is part of the program, so that pictures do not depend on system
//! fonts.

#[cfg(feature = "plots")]
mod canvas;
#[cfg(feature = "plots")]
mod curves;
mod middle;
#[cfg(feature = "plots")]
pub mod page;
#[cfg(feature = "plots")]
mod pixels;
#[cfg(feature = "plots")]
mod slices;
#[cfg(feature = "plots")]
mod survey;
mod table;
pub mod text;

#[cfg(feature = "plots")]
pub use curves::{Band, CurveOptions, Panel, curves_png, panels_png};
pub use middle::MiddleSlices;
#[cfg(feature = "plots")]
pub use pixels::{Pixels, Rgb};
#[cfg(feature = "plots")]
pub use slices::{compare_png, features_png, result_png, slices_png};
#[cfg(feature = "plots")]
pub use survey::survey_png;
pub use table::Table;
