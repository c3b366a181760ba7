//! Regularizers: penalties of a volume with their proximal maps.

use crate::error::{Result, ensure};
use crate::geometry::VoxelGrid;
use crate::place::Host;
pub use crate::place::{Bounds, Confines, Dual, Guide, Kernels, Penalty, Update};
use crate::registry::Registered;
use crate::space::Space;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt::{Display, Formatter};
use std::sync::Arc;

/// Settings of a regularizer.
pub trait RegularizerSpec: Registered + Send + Sync {
    /// Builds the regularizer.
    ///
    /// # Errors
    /// Invalid settings.
    fn build(&self) -> Result<Box<dyn Regularizer>>;
}

crate::settings_of!(Regularizer, RegularizerSpec);

/// Strength of a regularizer.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Weight {
    /// λ, for attenuation counted per voxel (geometric mean of its sides) and the projector's lengths in voxels.
    Fixed(f64),
    /// A multiple of the root mean square of back-projected noise, estimated from the scan.
    Noise(f64),
}

impl Weight {
    /// Refuses a negative or infinite weight.
    pub fn validate(self) -> Result<()> {
        let (Self::Fixed(w) | Self::Noise(w)) = self;
        ensure(w.is_finite() && w >= 0.0, "spec", "weight", w, "a finite number, 0 or more")
    }

    /// λ for attenuation in 1/mm and lengths in mm ([`Regularizer::weight`]); `unit` is the value for a fixed weight of
    /// 1.
    pub fn lambda(self, unit: f64, noise: &mut dyn FnMut(f64) -> f64) -> f64 {
        match self {
            Self::Fixed(w) => w * unit,
            Self::Noise(k) => noise(k),
        }
    }
}

impl Display for Weight {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Fixed(w) => write!(f, "{w}"),
            Self::Noise(k) => write!(f, "{k} times the noise"),
        }
    }
}

/// A convex penalty of coefficients, for any grid.
pub trait Regularizer: Send + Sync {
    /// The penalty on `grid`, with its arrays from `space`.
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>>;

    /// The weight λ for attenuation in 1/mm and lengths in mm. `noise(k)` returns k times the root mean square over the
    /// coefficients of the scan's noise in the gradient of the data term. It takes a back-projection.
    fn weight(&self, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64>;

    /// The weights of the priors that it is a sum of; that of [`Regularizer::weight`] if it is none.
    fn weights(&self, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<Vec<f64>> {
        Ok(vec![self.weight(grid, noise)?])
    }

    /// Planes on both sides of a slab on which an update of the slab depends, with their own state. `None` if a penalty
    /// needs the whole volume.
    fn halo(&self) -> Option<usize> {
        None
    }

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// The penalty of `regularizer` for arrays of `space`. If several processes share them, it is a penalty of a slab, or one
/// of the whole volume in each process.
pub fn penalty(regularizer: &dyn Regularizer, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
    let halo = regularizer.halo();
    let Some(slab) = space.place().slab(grid.shape[0], halo.unwrap_or(0)) else {
        return regularizer.on(grid, space);
    };
    if halo.is_none() {
        return regularizer.on(grid, &Space::new(*space.header(), Arc::new(Host)));
    }
    let mut penalty = regularizer.on(&grid.slab(slab.planes.clone()), &space.within(&slab))?;
    penalty.divide(slab);
    Ok(penalty)
}
