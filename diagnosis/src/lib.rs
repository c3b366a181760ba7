//! What a scan's geometry means in millimetres, and what in a scan troubles a reconstruction.
//!
//! - [`survey`] needs nothing but a [`Scan`](conefield_core::scan::Scan). It tells where source, detector and axis
//!   stand, which voxels the detector supports and which part of the volume the views see, and warns with figures and
//!   a way out.
//! - [`check_line_integrals`]: whether projections look like line integrals.
//! - [`bad_pixels`]: which pixels do not measure.

mod arc;
pub mod bad_pixels;
pub mod border;
mod coverage;
mod line_integrals;
pub mod quantiles;
mod setup;
mod shadow;
mod survey;
mod truncation;
mod warnings;

pub use arc::ScanArc;
pub use coverage::{VolumeCoverage, share_of_views};
pub use line_integrals::{LineIntegralCheck, check_line_integrals};
pub use setup::{FieldOfView, Setup, setup};
pub use survey::{Survey, survey};
pub use truncation::Truncation;
pub use warnings::{Warning, WarningKind};
