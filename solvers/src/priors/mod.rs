//! Priors of a field, and the sampling of their blocks.

mod total_variation;

pub use total_variation::TotalVariation;

use conefield_core::backend::BlockWork;
use conefield_core::prior::{Blocks, Prior};
use conefield_core::random::stream;
use conefield_core::scene::Scene;
use rand::RngExt;

/// Draws the blocks of a run's priors.
pub(crate) struct Places<'a> {
    priors: &'a [Box<dyn Prior>],
    /// Corners of each prior's blocks.
    corners: Vec<Vec<[f32; 3]>>,
}

impl<'a> Places<'a> {
    pub(crate) fn new(priors: &'a [Box<dyn Prior>]) -> Self {
        Self { priors, corners: vec![vec![]; priors.len()] }
    }

    /// The blocks of step `step`: at random positions in the volume, reproducible by the seed.
    pub(crate) fn draw(&mut self, scene: &Scene, seed: u64, step: u64) -> Vec<BlockWork<'_>> {
        let voxel = scene.unit_spacing();
        let (lo, hi) = (scene.to_unit(scene.bounds[0]), scene.to_unit(scene.bounds[1]));
        let mut work = vec![];
        for (i, (prior, corners)) in self.priors.iter().zip(&mut self.corners).enumerate() {
            let Blocks { edge, count, spacing, .. } = prior.blocks();
            let spacing = voxel.map(|s| s * spacing as f32);
            // Each prior has its own random stream.
            let mut rng = stream(seed ^ 0x7e57_b10c ^ (i as u64) << 32, step);
            corners.clear();
            for _ in 0..count {
                corners.push(std::array::from_fn(|k| {
                    let room = (hi[k] - lo[k] - spacing[k] * (edge - 1) as f32).max(0.0);
                    lo[k] + room * rng.random::<f32>()
                }));
            }
            work.push(BlockWork { prior: prior.as_ref(), corners, spacing });
        }
        work
    }
}
