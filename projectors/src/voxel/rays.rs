//! Projection ray by ray: in the forward projection every ray sums over its voxels; in the adjoint every slab of voxels
//! gathers from all rays.

use super::walk::{VoxelRay, Walk};
use conefield_core::geometry::Geometry;
use conefield_core::parallel;
use conefield_core::simd::Real;
use ndarray::{ArrayView3, ArrayViewMut3, Axis};

/// Planes of voxels along x per task of [`adjoint`].
const SLAB: usize = 8;

/// Line integrals of `volume` along the pixels of `views`; sums are in double precision.
pub fn forward<R: Real, W: Walk>(
    walk: &W,
    geometry: &Geometry,
    views: &[usize],
    volume: ArrayView3<'_, R>,
    mut projections: ArrayViewMut3<'_, R>,
) {
    let whole = 0..geometry.volume.shape[0];
    parallel::over(projections.axis_iter_mut(Axis(0)).zip(views), |_, (mut view, &v)| {
        parallel::over(view.axis_iter_mut(Axis(0)), |row, mut line| {
            for (column, out) in line.iter_mut().enumerate() {
                let mut sum = 0.0;
                let ray = VoxelRay::of(geometry, v, row, column);
                walk.walk(&ray, &geometry.volume, &whole, |at, mm| sum += volume[at].f64() * mm);
                *out = R::of(sum);
            }
        });
    });
}

/// Adds the adjoint of [`forward`] to `volume`. Each task owns some planes of voxels and processes the rays in order,
/// so that there are no conflicting writes and the order of summation is fixed.
pub fn adjoint<R: Real, W: Walk>(
    walk: &W,
    geometry: &Geometry,
    views: &[usize],
    projections: ArrayView3<'_, R>,
    mut volume: ArrayViewMut3<'_, R>,
) {
    parallel::over(volume.axis_chunks_iter_mut(Axis(0), SLAB), |n, mut planes| {
        let slab = n * SLAB..n * SLAB + planes.shape()[0];
        for ((i, row, column), &value) in projections.indexed_iter().filter(|(_, v)| **v != R::ZERO) {
            let ray = VoxelRay::of(geometry, views[i], row, column);
            walk.walk(&ray, &geometry.volume, &slab, |[x, y, z], mm| {
                planes[[x - slab.start, y, z]] += R::of(value.f64() * mm);
            });
        }
    });
}
