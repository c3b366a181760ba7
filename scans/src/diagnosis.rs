//! Diagnosis of a scan: its geometry in millimetres, and problems for a reconstruction.
//!
//! - [`survey`] needs only a [`Scan`](conefield_core::scan::Scan). It reports the positions of source, detector and
//!   axis, the voxel size that the detector supports and the part of the volume that the views see, and gives warnings
//!   with figures and advice.
//! - [`check_line_integrals`]: whether projections look like line integrals.

mod arc;
pub(crate) mod bad_pixels;
pub(crate) mod border;
mod coverage;
pub(crate) mod line_integrals;
pub mod quantiles;
mod repeated;
pub(crate) mod setup;
mod shadow;
mod survey;
pub(crate) mod truncation;
mod warnings;

pub use arc::ScanArc;
pub use coverage::{VolumeCoverage, share_of_views};
pub use line_integrals::{LineIntegralCheck, check_line_integrals};
pub use setup::{FieldOfView, Setup, setup};
pub use survey::{Survey, survey};
pub use truncation::Truncation;
pub use warnings::{Warning, WarningKind};
