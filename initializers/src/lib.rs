//! Initializers: random, mapping-consistency (MCI), checkpoint, a known volume

pub mod checkpoint;
pub mod mci;
pub mod random;
pub mod volume;
