//! Total variation: attenuation is piecewise constant with few edges.

use crate::iterative::tv::{TvProx, anisotropy};
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::VoxelGrid;
use conefield_core::regularizer::{Penalty, Regularizer, RegularizerSpec, Weight};
use conefield_core::space::Space;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `total-variation`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TotalVariation {
    /// Strength of the prior.
    pub weight: Weight,
    /// Dual steps per update.
    pub inner: usize,
    /// Factors of differences along x, y and z, for voxels of any shape. With a larger one, edges across that axis cost
    /// more.
    #[serde(skip_serializing_if = "are_equal")]
    pub weights: [f64; 3],
    /// Factor of slopes along the middle of an arc of less than half a turn, whatever its angle. Edges across it are the
    /// ones that the views do not show; with a smaller factor they cost less. Wider arcs ignore it.
    #[serde(skip_serializing_if = "is_one")]
    pub arc: f64,
}

/// Whether a factor changes nothing.
pub(super) fn is_one(factor: &f64) -> bool {
    *factor == 1.0
}

/// Whether all axes have the factor 1.
pub(super) fn are_equal(weights: &[f64; 3]) -> bool {
    *weights == [1.0; 3]
}

/// Weights of differences along x, y and z on `grid`, with factors for the axes.
pub(super) fn weighted(grid: &VoxelGrid, weights: [f64; 3]) -> [f32; 3] {
    let g = anisotropy(grid);
    std::array::from_fn(|k| weights[k] as f32 * g[k])
}

/// Refuses an invalid weight, number of dual steps, or factor.
pub(super) fn validate(weight: Weight, inner: usize, weights: [f64; 3], arc: f64) -> Result<()> {
    ensure((1e-3..=1.0).contains(&arc), "spec", "arc", arc, "a number from 0.001 to 1")?;
    let some = weights.iter().any(|w| *w > 0.0);
    for w in weights {
        let expected = "three numbers from 0.001 to 1000 or 0, not all 0";
        ensure(some && (w == 0.0 || (1e-3..=1e3).contains(&w)), "spec", "weights", w, expected)?;
    }
    ensure((1..=1000).contains(&inner), "spec", "inner", inner, "1 to 1000")?;
    weight.validate()
}

/// λ on `grid`. Attenuation per voxel is x̂ = x·h and lengths in voxels are Â = A/h, so that λ̂·TV(x̂) = λ̂·h·TV(x).
pub(super) fn lambda(weight: Weight, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> f64 {
    weight.lambda(grid.spacing.iter().product::<f64>().cbrt(), noise)
}

impl Default for TotalVariation {
    fn default() -> Self {
        Self { weight: Weight::Noise(1.2), inner: 4, weights: [1.0; 3], arc: 1.0 }
    }
}

conefield_core::stage_type!(RegularizerSpec, "total-variation", TotalVariation, "flat attenuation with few edges");

impl RegularizerSpec for TotalVariation {
    fn build(&self) -> Result<Box<dyn Regularizer>> {
        validate(self.weight, self.inner, self.weights, self.arc)?;
        Ok(Box::new(*self))
    }
}

impl Regularizer for TotalVariation {
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
        Ok(Box::new(TvProx::new(grid.shape, weighted(grid, self.weights), self.inner, self.arc, space)?))
    }

    fn weight(&self, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(lambda(self.weight, grid, noise))
    }

    fn halo(&self) -> Option<usize> {
        Some(halo(self.inner))
    }

    fn describe(&self) -> String {
        let axes = said(self.weights, self.arc);
        format!("total-variation: weight {}{axes}, {} dual steps per update", self.weight, self.inner)
    }
}

/// Planes beyond a slab that `inner` dual steps reach, one per step, with the dual's before the first and the slopes by
/// which edges are found.
pub(super) fn halo(inner: usize) -> usize {
    inner + 2
}

/// The factors for `explain`, if they are not 1.
pub(super) fn said(weights: [f64; 3], arc: f64) -> String {
    let axes = if are_equal(&weights) { String::new() } else { format!(" times {weights:?} along x, y, z") };
    if is_one(&arc) { axes } else { format!("{axes} times {arc} along the middle of a limited arc") }
}
