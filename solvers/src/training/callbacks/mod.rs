//! The callbacks: those that a spec may name, and those of every run.

pub mod coarse_to_fine;
pub mod drift;
pub mod fft_mask;
pub mod field_monitor;
pub mod live_slices;
pub mod patience;
pub mod rollback;

pub use coarse_to_fine::CoarseToFine;
pub use drift::Drift;
pub use fft_mask::FftMask;
pub use field_monitor::FieldMonitor;
pub use live_slices::LiveSlices;
pub use patience::Patience;
pub use rollback::Rollback;
