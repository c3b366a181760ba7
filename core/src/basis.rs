//! What a volume is made of: coefficients, and the linear map that expands them to voxels.

use crate::error::Result;
use crate::geometry::VoxelGrid;
use crate::simd::Real;
use ndarray::{ArrayView3, ArrayViewMut3};

/// Settings of a basis.
#[typetag::serde(tag = "type")]
pub trait BasisSpec: Send + Sync {
    /// The basis, or why the settings make none.
    fn build(&self) -> Result<Box<dyn Basis>>;
}

/// A basis of volumes on any grid of voxels.
pub trait Basis: Send + Sync {
    /// The basis for the voxels of `grid`. The number of coefficients follows from the grid's shape alone, so that memory
    /// can be told before a scan is read.
    fn on(&self, grid: &VoxelGrid) -> Result<Box<dyn Expansion>>;

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// The basis of one grid of voxels: a matrix `B`. Its entries are not negative, so that coefficients of 0 and more give voxels
/// of 0 and more, unless coefficients are samples.
pub trait Expansion: Send + Sync {
    /// Where the coefficients stand. A prior acts on this grid, with its spacing.
    fn coefficients(&self) -> VoxelGrid;

    /// Whether coefficients are the volume's values where they stand, on a grid that fills the same box. A projector then
    /// takes them for voxels of that grid, and only the volume that comes out is expanded, with what falls below 0 set to 0.
    fn are_samples(&self) -> bool {
        false
    }

    /// Bytes that either direction of the operator takes while it works.
    fn scratch(&self) -> u64 {
        0
    }

    /// The operator that works.
    fn operator(&self) -> &dyn BasisOperator<f32>;

    /// The same formula in double precision, by which it is checked.
    fn reference(&self) -> Option<&dyn BasisOperator<f64>> {
        None
    }

    /// What the operator could not do since this was last asked, as [`crate::stage::Stage::fault`].
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
