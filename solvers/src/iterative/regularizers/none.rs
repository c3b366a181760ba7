//! No regularizer except the bounds of attenuation.

use conefield_core::error::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::regularizer::{Confines, Kernels, Penalty, Regularizer, RegularizerSpec};
use conefield_core::space::Space;
use ndarray::ArrayView3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `none`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Nonnegative {}

conefield_core::stage_type!(RegularizerSpec, "none", Nonnegative, "non-negative attenuation, no other prior");

impl RegularizerSpec for Nonnegative {
    fn build(&self) -> Result<Box<dyn Regularizer>> {
        Ok(Box::new(*self))
    }
}

impl Regularizer for Nonnegative {
    fn on(&self, _: &VoxelGrid, _: &Space) -> Result<Box<dyn Penalty>> {
        Ok(Box::<BoundsPenalty>::default())
    }

    fn halo(&self) -> Option<usize> {
        Some(0)
    }

    fn weight(&self, _: &VoxelGrid, _: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(0.0)
    }

    fn describe(&self) -> String {
        "none: non-negative attenuation".into()
    }
}

/// The bounds alone.
#[derive(Default)]
struct BoundsPenalty {
    confines: Confines,
}

impl Penalty for BoundsPenalty {
    fn value(&self, _: ArrayView3<'_, f32>) -> f64 {
        0.0
    }

    fn prox(&mut self, v: &[f32], _: f32, u: &mut [f32]) {
        self.confines.bounds.clip_to(u, v);
        self.confines.clip_each(u);
    }

    fn confines(&mut self) -> Option<&mut Confines> {
        Some(&mut self.confines)
    }

    fn kernels(&mut self) -> Option<Kernels<'_>> {
        self.confines.each.is_none().then_some(Kernels::Clip(self.confines.bounds))
    }
}
