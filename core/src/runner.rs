//! Single stages on a device.

use crate::error::Result;
use crate::loss::Loss;
use crate::prior::Prior;
use crate::stage::{Projector, Samples, Stage, UnitRay};

/// Runs single stages on a device, to compare their WGSL with their Rust.
pub trait Runner {
    /// Runs a stage forward and backward on `x` and `dy`, channel-major with `rows` rows. Returns its outputs, the
    /// gradients of its parameters and those of its inputs.
    fn pass(&self, stage: &dyn Stage, params: &[f32], x: &[f32], dy: &[f32], rows: usize) -> Result<[Vec<f32>; 3]>;

    /// The samples of `rays`, each with its seed where positions are random.
    fn samples(&self, projector: &dyn Projector, rays: &[(UnitRay, Option<u64>)]) -> Result<Vec<Samples>>;

    /// A loss and its derivative at pairs of a predicted and a measured value.
    fn losses(&self, loss: &dyn Loss, pairs: &[[f32; 2]]) -> Result<Vec<[f32; 2]>>;

    /// A prior's penalty of one block with these values, and its derivative by each of them.
    fn penalty(&self, prior: &dyn Prior, values: &[f32]) -> Result<(f32, Vec<f32>)>;
}
