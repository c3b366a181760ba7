//! The voxel basis: coefficients are the voxels themselves.

use conefield_core::basis::{Basis, BasisOperator, BasisSpec, Expansion};
use conefield_core::error::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::simd::Real;
use ndarray::{ArrayView3, ArrayViewMut3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `voxels`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Voxels {}

conefield_core::stage_type!(BasisSpec, "voxels", Voxels, "the voxels themselves");

impl BasisSpec for Voxels {
    fn build(&self) -> Result<Box<dyn Basis>> {
        Ok(Box::new(*self))
    }
}

impl Basis for Voxels {
    fn on(&self, grid: &VoxelGrid) -> Result<Box<dyn Expansion>> {
        Ok(Box::new(Identity { grid: *grid }))
    }

    fn describe(&self) -> String {
        "voxels: one coefficient per voxel".into()
    }
}

struct Identity {
    grid: VoxelGrid,
}

impl Expansion for Identity {
    fn coefficients(&self) -> VoxelGrid {
        self.grid
    }
    fn are_samples(&self) -> bool {
        true
    }
    fn operator(&self) -> &dyn BasisOperator<f32> {
        self
    }
    fn reference(&self) -> Option<&dyn BasisOperator<f64>> {
        Some(self)
    }
}

impl<R: Real> BasisOperator<R> for Identity {
    fn expand(&self, coefficients: ArrayView3<'_, R>, mut voxels: ArrayViewMut3<'_, R>) {
        voxels.assign(&coefficients);
    }
    fn adjoint(&self, voxels: ArrayView3<'_, R>, mut coefficients: ArrayViewMut3<'_, R>) {
        coefficients.assign(&voxels);
    }
}
