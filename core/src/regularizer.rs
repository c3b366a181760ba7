//! What is known of a volume before its scan: a penalty with its proximal map.

use crate::error::Result;
use crate::geometry::VoxelGrid;
use crate::space::Space;
use ndarray::ArrayView3;

/// Settings of a regularizer.
#[typetag::serde(tag = "type")]
pub trait RegularizerSpec: Send + Sync {
    /// The regularizer, or why the settings make none.
    fn build(&self) -> Result<Box<dyn Regularizer>>;
}

/// A convex penalty of coefficients on any grid.
pub trait Regularizer: Send + Sync {
    /// The penalty on `grid`, with its arrays from `space`.
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>>;

    /// The weight λ for attenuation in 1/mm and lengths in mm. `noise(k)` measures what the scan's noise comes to in the
    /// gradient of the data term: k times its root mean square over the coefficients. That takes a back-projection.
    fn weight(&self, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64>;

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// A penalty `R` on one grid. It keeps what the next call of [`Penalty::prox`] starts from.
pub trait Penalty: Send {
    /// `R(x)`, without weight.
    fn value(&self, x: ArrayView3<'_, f32>) -> f64;

    /// Overwrites `u` with `argmin_{u ≥ 0} ½‖u − v‖² + tau·R(u)`, or comes nearer to it with each call for the same `v`. Both
    /// lie as the grid's coefficients in standard order. The result does not depend on the number of threads.
    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]);

    /// What the next call starts from, by name, for checkpoints.
    fn state(&mut self) -> Vec<(&str, &mut [f32])> {
        vec![]
    }

    /// What it could not do since this was last asked, as [`crate::stage::Stage::fault`].
    fn fault(&self) -> Result<()> {
        Ok(())
    }
}
