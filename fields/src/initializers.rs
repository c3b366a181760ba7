//! Initializers of a field's parameters: random numbers, a trained model (MCI), a checkpoint, a known volume.

pub mod checkpoint;
pub mod mci;
pub mod random;
pub mod volume;
