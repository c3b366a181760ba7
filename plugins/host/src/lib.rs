//! Plugins: shared libraries of stages, found, verified and loaded at run time.
//!
//! [`library`] reads a library's tables and checks everything that can be checked; [`stage`] wraps its stages as
//! ordinary ones, after trial runs between guard zones and under a time limit ([`trial`]); [`spec`] registers their
//! types, so that a spec can name them; [`search`] defines where libraries are searched. Loaded libraries are never
//! unloaded.
//!
//! No process survives a library that calls `abort`, writes far outside its buffers, or has harmful constructors, which
//! the system runs before any check. Loading a library means running its code: only files that the user names, or puts
//! into the search locations, are loaded.

mod examine;
mod exit;
pub mod library;
pub mod search;
pub mod spec;
pub mod stage;
pub mod trial;

pub use library::Library;
pub use search::{Found, Place, Plugins};
