//! Plugins: shared libraries with stages, found, verified and loaded at run time.
//!
//! [`library`] reads a library's tables and trusts nothing in them that can be checked; [`stage`] makes ordinary stages of
//! theirs, tried out between guard zones and under a time limit ([`trial`]) before any real work is handed to them;
//! [`spec`] registers their types, so that a spec names them like any other; [`search`] says where libraries are looked
//! for. A library that was loaded is never unloaded.
//!
//! What no process can survive: a library that calls `abort`, that writes far outside what it was handed, or whose
//! constructors, which the system runs before anything can be checked, do harm. A library is code, and loading it is
//! running it: only files that the user names, or puts where plugins are looked for, are ever loaded.

mod examine;
pub mod library;
pub mod search;
pub mod spec;
pub mod stage;
pub mod trial;

pub use library::Library;
pub use search::{Found, Place, Plugins};
