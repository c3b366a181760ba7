//! Priors of a field: penalties on small blocks of neighbouring points.

use crate::error::{Result, ensure};
use crate::wgsl::Fragment;

/// Penalizes the values of a field in cubes of neighbouring points at random positions.
pub trait Prior: Send + Sync {
    /// The blocks and their weight.
    fn blocks(&self) -> Blocks;

    /// The penalty of one block, non-negative. `values` are those of its `edge³` points, z fastest. Adds `scale` times
    /// the derivative by each of them to `gradient`.
    fn block(&self, values: &[f64], scale: f64, gradient: &mut [f64]) -> f64;

    /// The same in WGSL, see [`crate::wgsl`]; `None` if the prior runs on the CPU only.
    fn wgsl(&self) -> Option<Fragment> {
        None
    }

    /// Returns an error of the calls so far, such as a panic in a plugin.
    fn fault(&self) -> Result<()> {
        Ok(())
    }

    /// A short description.
    fn describe(&self) -> String;
}

/// The blocks of a prior.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Blocks {
    /// Points along a block's edge.
    pub edge: usize,
    /// Blocks per step.
    pub count: usize,
    /// Distance between neighbouring points, in voxels.
    pub spacing: f64,
    /// Weight of the mean over all points relative to the mean loss of a ray.
    pub weight: f64,
}

impl Blocks {
    /// Refuses invalid numbers; errors name the keys of the settings.
    pub fn validate(&self) -> Result<()> {
        let positive = |x: f64| x.is_finite() && x > 0.0;
        ensure((2..=32).contains(&self.edge), "spec", "edge", self.edge, "2 to 32")?;
        ensure(self.weight.is_finite() && self.weight >= 0.0, "spec", "weight", self.weight, "0 or more")?;
        ensure(positive(self.spacing), "spec", "spacing", self.spacing, "a positive finite number")?;
        ensure((1..=1 << 16).contains(&self.count), "spec", "blocks", self.count, "1 to 65536")
    }

    /// Points of a block.
    pub fn points(&self) -> usize {
        self.edge.pow(3)
    }
}
