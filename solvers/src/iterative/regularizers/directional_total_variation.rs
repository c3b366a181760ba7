//! Directional total variation: attenuation is piecewise constant with smooth edges.
//!
//! Slopes across an edge cost less than slopes along it (Ehrhardt and Betcke, SIAM J. Imaging Sci. 9(3), 2016). There
//! the edges come from another image of the object. Here they come from the volume itself and are updated before each
//! pass.

use super::total_variation::{Variation, are_equal, is_one};
use conefield_core::error::{Result, ensure};
use conefield_core::regularizer::{Regularizer, RegularizerSpec, Weight};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `directional-total-variation`: `Σ_j |(I − n·nᵀ)·∇x_j|`, `n = √γ·s/√(|s|² + η²)`, s the volume's slope at
/// voxel j.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DirectionalTotalVariation {
    /// Strength of the prior.
    pub weight: Weight,
    /// Dual steps per update.
    pub inner: usize,
    /// γ: how much less a slope across a clear edge costs. 0 is `total-variation`.
    pub strength: f64,
    /// Threshold of a clear edge: η, as a multiple of the root mean square of all slopes.
    pub edge: f64,
    /// Factors of differences along x, y and z, for voxels of any shape. With a larger one, edges across that axis cost
    /// more.
    #[serde(skip_serializing_if = "are_equal")]
    pub weights: [f64; 3],
    /// Factor of differences along the middle of an arc of less than half a turn; see `total-variation`.
    #[serde(skip_serializing_if = "is_one")]
    pub arc: f64,
}

impl Default for DirectionalTotalVariation {
    fn default() -> Self {
        Self { weight: Weight::Noise(0.7), inner: 4, strength: 0.97, edge: 1.0, weights: [1.0; 3], arc: 1.0 }
    }
}

conefield_core::stage_type!(
    RegularizerSpec,
    "directional-total-variation",
    DirectionalTotalVariation,
    "flat regions with few, smooth edges"
);

impl RegularizerSpec for DirectionalTotalVariation {
    fn build(&self) -> Result<Box<dyn Regularizer>> {
        let Self { weight, inner, strength, edge, weights, arc } = *self;
        let edges = Some([strength, edge]);
        let built = Variation { name: "directional-total-variation", weight, inner, weights, arc, edges };
        built.validate()?;
        ensure((0.0..=0.999).contains(&strength), "spec", "strength", strength, "0 to 0.999")?;
        ensure((1e-3..=1e3).contains(&edge), "spec", "edge", edge, "0.001 to 1000")?;
        Ok(Box::new(built))
    }
}
