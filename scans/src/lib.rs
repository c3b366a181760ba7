//! What lies between detector and method.
//!
//! - [`import`], [`read_scan`], [`read_data_set`]: scans of every format as line integrals.
//! - [`counts`]: conversion of counts to line integrals; [`Selection`]: part of a scan, with its geometry.
//! - [`corrections`], [`diagnosis`], [`calibration`]: of a scan.

pub mod calibration;
pub mod corrections;
pub mod counts;
pub mod diagnosis;
mod import;
mod provenance;
mod selection;

pub use import::{ImportOptions, Imported, import, read_data_set, read_scan};
pub use selection::{Lines, Selection, ViewChoice};
