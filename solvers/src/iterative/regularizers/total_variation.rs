//! Total variation: attenuation is piecewise constant with few edges.

use crate::iterative::tv::{TvProx, anisotropy};
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::VoxelGrid;
use conefield_core::place::StatePart;
use conefield_core::regularizer::{Kernels, Penalty, Regularizer, RegularizerSpec, Update, Weight};
use conefield_core::space::Space;
use ndarray::ArrayView3;
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
}

/// Refuses an invalid weight or number of dual steps.
pub(super) fn validate(weight: Weight, inner: usize) -> Result<()> {
    ensure((1..=1000).contains(&inner), "spec", "inner", inner, "1 to 1000")?;
    weight.validate()
}

/// λ on `grid`. Attenuation per voxel is x̂ = x·h and lengths in voxels are Â = A/h, so that λ̂·TV(x̂) = λ̂·h·TV(x).
pub(super) fn lambda(weight: Weight, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> f64 {
    weight.lambda(grid.spacing.iter().product::<f64>().cbrt(), noise)
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
        validate(self.weight, self.inner)?;
        Ok(Box::new(*self))
    }
}

impl Regularizer for TotalVariation {
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
        Ok(Box::new(On { prox: TvProx::new(grid.shape, anisotropy(grid), space)?, inner: self.inner }))
    }

    fn weight(&self, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(lambda(self.weight, grid, noise))
    }

    fn describe(&self) -> String {
        format!("total-variation: weight {}, {} dual steps per update", self.weight, self.inner)
    }
}

/// Total variation on one grid.
pub(super) struct On {
    pub(super) prox: TvProx,
    pub(super) inner: usize,
}

impl Penalty for On {
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        self.prox.value(x)
    }

    fn adapts(&self) -> bool {
        self.prox.adapts()
    }

    fn adapt(&mut self, x: ArrayView3<'_, f32>) -> Option<f64> {
        self.prox.adapt(x)
    }

    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        self.prox.apply(v, tau, self.inner, u);
    }

    fn update(&mut self, update: Update<'_>, tau: f32) {
        if let Some(update) = self.prox.update(update, tau, self.inner) {
            update.around(|v, u| self.prox.apply(v, tau, self.inner, u));
        }
    }

    fn kernels(&mut self) -> Option<Kernels<'_>> {
        Some(Kernels::Dual(self.prox.kernels(self.inner)))
    }

    fn state(&mut self) -> Vec<(&str, StatePart<'_>)> {
        let [x, y, z] = self.prox.state().map(StatePart::Placed);
        vec![("dual.x", x), ("dual.y", y), ("dual.z", z)]
    }
}
