//! A plugin with two stages: a field of sines, and a normalizer that smooths features along each ray.

pub mod sine;
pub mod smooth;

conefield_plugin::export!();
