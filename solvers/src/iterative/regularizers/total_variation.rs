//! Total variation: attenuation is piecewise constant with few edges.

use crate::iterative::edges::Edges;
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
        let Self { weight, inner, weights, arc } = *self;
        let built = Variation { name: "total-variation", weight, inner, weights, arc, edges: None };
        built.validate()?;
        Ok(Box::new(built))
    }
}

/// Total variation, or directional total variation with the `strength` and `edge` of its settings.
pub(super) struct Variation {
    pub(super) name: &'static str,
    pub(super) weight: Weight,
    pub(super) inner: usize,
    pub(super) weights: [f64; 3],
    pub(super) arc: f64,
    pub(super) edges: Option<[f64; 2]>,
}

impl Variation {
    /// Refuses an invalid weight, number of dual steps, or factor.
    pub(super) fn validate(&self) -> Result<()> {
        ensure((1e-3..=1.0).contains(&self.arc), "spec", "arc", self.arc, "a number from 0.001 to 1")?;
        let some = self.weights.iter().any(|w| *w > 0.0);
        for w in self.weights {
            let expected = "three numbers from 0.001 to 1000 or 0, not all 0";
            ensure(some && (w == 0.0 || (1e-3..=1e3).contains(&w)), "spec", "weights", w, expected)?;
        }
        ensure((1..=1000).contains(&self.inner), "spec", "inner", self.inner, "1 to 1000")?;
        self.weight.validate()
    }
}

impl Regularizer for Variation {
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
        let g = anisotropy(grid);
        let g = std::array::from_fn(|k| self.weights[k] as f32 * g[k]);
        let edges = self.edges.map(|[strength, edge]| Edges::new(grid.shape, strength as f32, edge, space));
        let mut prox = TvProx::new(grid.shape, g, self.inner, self.arc, space)?;
        prox.edges = edges.transpose()?;
        Ok(Box::new(prox))
    }

    fn weight(&self, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(lambda(self.weight, grid, noise))
    }

    /// One plane per dual step, with the dual's before the first and the slopes by which edges are found.
    fn halo(&self) -> Option<usize> {
        Some(self.inner + 2)
    }

    fn describe(&self) -> String {
        let Self { name, weight, inner, weights, arc, edges } = self;
        let axes = if are_equal(weights) { String::new() } else { format!(" times {weights:?} along x, y, z") };
        let arc = if is_one(arc) { String::new() } else { format!(" times {arc} along the middle of a limited arc") };
        let edges = edges.map_or(String::new(), |[strength, edge]| format!(", strength {strength}, edge {edge}"));
        format!("{name}: weight {weight}{axes}{arc}, {inner} dual steps per update{edges}")
    }
}
