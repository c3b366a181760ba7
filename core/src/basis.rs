//! Representations of a volume: coefficients and the linear map that expands them to voxels.

use crate::error::Result;
use crate::geometry::VoxelGrid;
use crate::registry::Registered;
use crate::simd::Real;
use ndarray::{ArrayView3, ArrayViewMut3};

/// Settings of a basis.
pub trait BasisSpec: Registered + Send + Sync {
    /// Builds the basis; fails on invalid settings.
    fn build(&self) -> Result<Box<dyn Basis>>;
}

crate::settings_of!(Basis, BasisSpec);

/// A basis of volumes on any grid of voxels.
pub trait Basis: Send + Sync {
    /// The basis for the voxels of `grid`. The number of coefficients depends on the grid's shape only, so that memory
    /// can be estimated before a scan is read.
    fn on(&self, grid: &VoxelGrid) -> Result<Box<dyn Expansion>>;

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// The basis of one voxel grid: a matrix `B`. Its entries are non-negative, so that non-negative coefficients give
/// non-negative voxels, unless coefficients are samples.
pub trait Expansion: Send + Sync {
    /// Positions of the coefficients. A regularizer acts on this grid, with its spacing.
    fn coefficients(&self) -> VoxelGrid;

    /// Whether coefficients are samples of the volume on a grid that fills the same box. A projector then treats them
    /// as voxels of that grid. Only the final volume is expanded, with negative values set to 0.
    fn are_samples(&self) -> bool {
        false
    }

    /// Working memory of either direction of the operator, in bytes.
    fn scratch(&self) -> u64 {
        0
    }

    /// The operator in single precision.
    fn operator(&self) -> &dyn BasisOperator<f32>;

    /// The same formula in double precision, for checks.
    fn reference(&self) -> Option<&dyn BasisOperator<f64>> {
        None
    }

    /// Returns and clears the first error since the last call; see [`crate::stage::Stage::fault`].
    fn fault(&self) -> Result<()> {
        Ok(())
    }
}

/// The matrix `B` and its adjoint. Neither direction depends on the number of threads.
pub trait BasisOperator<R: Real>: Send + Sync {
    /// Overwrites `voxels` with `B·coefficients`.
    fn expand(&self, coefficients: ArrayView3<'_, R>, voxels: ArrayViewMut3<'_, R>);

    /// Overwrites `coefficients` with `Bᵀ·voxels`.
    fn adjoint(&self, voxels: ArrayView3<'_, R>, coefficients: ArrayViewMut3<'_, R>);
}
