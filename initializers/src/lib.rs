//! Initializers: random, mapping-consistency (MCI), checkpoint

pub mod checkpoint;
pub mod mci;
pub mod random;
