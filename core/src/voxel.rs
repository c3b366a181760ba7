//! Line integrals of a voxel volume for iterative methods: a linear operator and its exact adjoint.

use crate::error::Result;
use crate::geometry::Geometry;
use crate::registry::Registered;
use crate::scan::ScanHeader;
use crate::simd::Real;
use crate::wgsl::Fragment;
use ndarray::{ArrayView3, ArrayViewMut3};

/// Settings of a projector of voxel volumes.
pub trait VoxelProjectorSpec: Registered + Send + Sync {
    /// Builds the projector; fails on invalid settings.
    fn build(&self) -> Result<Box<dyn VoxelProjector>>;
}

crate::settings_of!(VoxelProjector, VoxelProjectorSpec);

/// A projector of voxel volumes, in single precision for work and in double precision for checks.
pub trait VoxelProjector: Send + Sync {
    /// The operator in single precision.
    fn operator(&self) -> &dyn VoxelOperator<f32>;

    /// The same formula in double precision.
    fn reference(&self) -> &dyn VoxelOperator<f64>;

    /// The same formula for a GPU: `stage_walk`; see [`crate::wgsl`].
    fn wgsl(&self) -> Option<Fragment> {
        None
    }

    /// Working memory of either direction for `views` views of a scan of this size on the CPU, in bytes.
    fn scratch(&self, header: &ScanHeader, views: usize) -> u64 {
        let _ = (header, views);
        0
    }

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// The system matrix `A` of a geometry: `(Aμ)_i = Σ_j a_ij μ_j`, where `a_ij` is the weight in mm of voxel `j` for ray
/// `i`. Neither direction depends on the number of threads.
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

    /// Whether the line integrals of slabs, each a volume of its own, add up to those of the whole.
    fn is_additive(&self) -> bool {
        false
    }

    /// Returns and clears the first error since the last call; see [`crate::stage::Stage::fault`].
    fn fault(&self) -> Result<()> {
        Ok(())
    }
}

/// A view for voxel-driven back-projection: depth, row and column of a voxel `(x, y, z)`, each
/// `n[0] + n[1]·x + n[2]·y + n[3]·z`, row and column after division by the depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VoxelView {
    /// Distance from the source along the detector's normal, mm.
    pub depth: [f64; 4],
    /// Row times depth; whole rows are pixel centres.
    pub row: [f64; 4],
    /// Column times depth.
    pub column: [f64; 4],
    /// Factor of the view in mm², besides the inverse square of the depth.
    pub scale: f64,
}
