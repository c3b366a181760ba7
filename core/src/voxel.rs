//! Line integrals of a voxel volume, as classical solvers need them: a linear operator and its exact adjoint.

use crate::geometry::Geometry;
use crate::simd::Real;
use ndarray::{ArrayView3, ArrayViewMut3};

/// A projector of voxel volumes, in single precision for work and in double precision to be checked by.
pub trait VoxelProjector: Send + Sync {
    /// The operator that works.
    fn operator(&self) -> &dyn VoxelOperator<f32>;

    /// The same formula in double precision.
    fn reference(&self) -> &dyn VoxelOperator<f64>;

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// The system matrix `A` of a geometry: `(Aμ)_i = Σ_j a_ij μ_j`, where `a_ij` is the length in mm over which voxel
/// `j` counts for ray `i`. Neither direction depends on the number of threads.
pub trait VoxelOperator<R: Real>: Send + Sync {
    /// Overwrites `projections`, `[views.len(), row, column]`, with the line integrals of `volume`, `[x, y, z]` in
    /// 1/mm, for the views `views` of `geometry`.
    fn forward(
        &self,
        geometry: &Geometry,
        views: &[usize],
        volume: ArrayView3<'_, R>,
        projections: ArrayViewMut3<'_, R>,
    );

    /// The adjoint of [`VoxelOperator::forward`]: *adds* `Aᵀ·projections` to `volume`.
    fn adjoint(
        &self,
        geometry: &Geometry,
        views: &[usize],
        projections: ArrayView3<'_, R>,
        volume: ArrayViewMut3<'_, R>,
    );
}
