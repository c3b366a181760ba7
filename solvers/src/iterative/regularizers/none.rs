//! No regularizer except the bounds of attenuation.

use crate::iterative::tv::clip_each;
use conefield_core::error::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::place::Slab;
use conefield_core::regularizer::{Bounds, Kernels, Penalty, Regularizer, RegularizerSpec};
use conefield_core::space::Space;
use ndarray::ArrayView3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

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
        Ok(Box::new(BoundsPenalty { bounds: Bounds::default(), each: None, slab: None }))
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
struct BoundsPenalty {
    bounds: Bounds,
    /// The bounds of each coefficient, if they differ.
    each: Option<Arc<[Vec<f32>; 2]>>,
    /// Its part of a volume that several processes share.
    slab: Option<Slab>,
}

impl Penalty for BoundsPenalty {
    fn value(&self, _: ArrayView3<'_, f32>) -> f64 {
        0.0
    }

    fn prox(&mut self, v: &[f32], _: f32, u: &mut [f32]) {
        self.bounds.clip_to(u, v);
        clip_each(u, self.each.as_deref());
    }

    fn divide(&mut self, slab: Slab) {
        self.slab = Some(slab);
    }

    fn slab(&self) -> Option<&Slab> {
        self.slab.as_ref()
    }

    fn confine(&mut self, bounds: Bounds) -> Result<()> {
        self.bounds = bounds;
        Ok(())
    }

    fn confine_each(&mut self, bounds: Arc<[Vec<f32>; 2]>) -> Result<()> {
        self.each = Some(bounds);
        Ok(())
    }

    fn kernels(&mut self) -> Option<Kernels<'_>> {
        self.each.is_none().then_some(Kernels::Clip(self.bounds))
    }
}
