//! Total variation: attenuation is flat but for a few edges.

use crate::iterative::tv::{TvProx, anisotropy, total_variation};
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::VoxelGrid;
use conefield_core::regularizer::{Penalty, Regularizer, RegularizerSpec};
use conefield_core::space::Space;
use ndarray::ArrayView3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `total-variation`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TotalVariation {
    /// How strong it is.
    pub weight: Weight,
    /// Dual steps for each update.
    pub inner: usize,
}

/// How strong a prior is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Weight {
    /// λ, for attenuation counted per voxel (geometric mean of its sides) and the projector's lengths in voxels.
    Fixed(f64),
    /// Times the root mean square of back-projected noise, whose strength is read from the scan.
    Noise(f64),
}

impl Default for TotalVariation {
    fn default() -> Self {
        Self { weight: Weight::Noise(1.2), inner: 4 }
    }
}

conefield_core::stage_type!(Regularizer, "total-variation", TotalVariation, "flat attenuation with few edges");

#[typetag::serde(name = "total-variation")]
impl RegularizerSpec for TotalVariation {
    fn build(&self) -> Result<Box<dyn Regularizer>> {
        ensure((1..=1000).contains(&self.inner), "spec", "inner", self.inner, "1 to 1000")?;
        let (Weight::Fixed(w) | Weight::Noise(w)) = self.weight;
        ensure(w.is_finite() && w >= 0.0, "spec", "weight", w, "a finite number, 0 or more")?;
        Ok(Box::new(*self))
    }
}

impl Regularizer for TotalVariation {
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
        let g = anisotropy(grid);
        Ok(Box::new(On { prox: TvProx::new(grid.shape, g, space), g, inner: self.inner }))
    }

    /// Attenuation a voxel is x̂ = x·h and lengths in voxels are Â = A/h, so that λ̂·TV(x̂) = λ̂·h·TV(x).
    fn weight(&self, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(match self.weight {
            Weight::Fixed(w) => w * grid.spacing.iter().product::<f64>().cbrt(),
            Weight::Noise(k) => noise(k),
        })
    }

    fn describe(&self) -> String {
        let weight = match self.weight {
            Weight::Fixed(w) => format!("weight {w}"),
            Weight::Noise(k) => format!("weight {k} times the noise"),
        };
        format!("total-variation: {weight}, {} dual steps an update", self.inner)
    }
}

/// Total variation on one grid.
struct On {
    prox: TvProx,
    g: [f32; 3],
    inner: usize,
}

impl Penalty for On {
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        total_variation(x, self.g)
    }

    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        self.prox.apply(v, tau, self.inner, u);
    }

    fn state(&mut self) -> Vec<(&str, &mut [f32])> {
        let [x, y, z] = self.prox.state();
        vec![("dual.x", x), ("dual.y", y), ("dual.z", z)]
    }
}
