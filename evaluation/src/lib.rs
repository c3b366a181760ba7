//! Evaluation of results: scores, and pictures and pages of them.
//!
//! - [`metrics`]: scores of a volume against its reference.
//! - [`report`]: numbers in words and tables; plots, pictures and pages.

pub mod hounsfield;
pub mod metrics;
pub mod pca;
pub mod report;
