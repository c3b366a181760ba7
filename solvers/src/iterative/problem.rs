//! A scan with its system matrix.

use super::norms::square_sum;
use crate::shadow::{air_level, shadow};
use conefield_core::geometry::Geometry;
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::space::Space;
use conefield_core::voxel::VoxelOperator;
use ndarray::{Array2, Array3, ArrayView3, ArrayViewMut3, Axis, Zip, s};
use rayon::prelude::*;

/// Pixels by which the object's shadow is dilated; pixels outside count as air.
const MARGIN: usize = 4;

/// A scan and its system matrix. Pixel arrays may have room for more views than requested; the first images are then
/// used.
pub struct Problem<'a> {
    /// The measured scan.
    pub scan: &'a Scan,
    /// Its geometry, with the grid of the unknowns as the volume.
    pub geometry: &'a Geometry,
    /// The system matrix.
    pub operator: &'a dyn VoxelOperator<f32>,
    /// Seed of all randomness.
    pub seed: u64,
    /// The voxels that may be nonzero, if not all.
    pub(super) inside: Option<&'a Array3<bool>>,
    /// The object's shadow in each view, if the other pixels count as 0.
    pub(super) shadow: Option<Vec<Array2<bool>>>,
}

impl Problem<'_> {
    /// Makes pixels outside the object's shadow count as 0.
    pub fn clear_air(&mut self) {
        let level = air_level(self.scan);
        let views = self.scan.projections.outer_iter().into_par_iter();
        self.shadow = Some(views.map(|view| shadow(view, level, MARGIN)).collect());
    }

    /// Bytes of the masks of [`Problem::clear_air`].
    pub fn air_bytes(header: &ScanHeader) -> u64 {
        header.pixels()
    }

    /// Share of the pixels outside the shadow, after [`Problem::clear_air`].
    pub fn air_share(&self) -> f64 {
        let Some(shadows) = &self.shadow else { return 0.0 };
        let inside: usize = shadows.iter().map(|s| s.iter().filter(|x| **x).count()).sum();
        1.0 - inside as f64 / self.scan.projections.len().max(1) as f64
    }

    /// Overwrites the first images of `out` with `A·x` for some views.
    pub fn forward(&self, views: &[usize], x: &Array3<f32>, out: &mut Array3<f32>) {
        self.operator.forward(self.geometry, views, x.view(), images_mut(out, views.len()));
    }

    /// Overwrites the first images of `out` with `p − A·x` for some views, with p = 0 in air if requested. Returns
    /// `‖p − A·x‖²`.
    pub fn residual(&self, views: &[usize], x: &Array3<f32>, out: &mut Array3<f32>) -> f64 {
        self.forward(views, x, out);
        self.subtract(views, out)
    }

    /// Overwrites the first images of `out`, `A·x` for some views, with `p − A·x`; see [`Problem::residual`].
    pub(super) fn subtract(&self, views: &[usize], out: &mut Array3<f32>) -> f64 {
        for (mut image, &v) in out.axis_iter_mut(Axis(0)).zip(views) {
            let both = Zip::from(&mut image).and(self.scan.view(v));
            match &self.shadow {
                None => both.par_for_each(|a, p| *a = p - *a),
                Some(shadow) => {
                    both.and(&shadow[v]).par_for_each(|a, p, inside| *a = if *inside { p - *a } else { -*a });
                }
            }
        }
        pixel_norm2(out, views.len())
    }

    /// Overwrites `out` with `Aᵀ·y` for some views, whose images are the first of `y`. `out` is 0 outside the object's
    /// support, so that zeros there stay.
    pub fn back(&self, views: &[usize], y: &Array3<f32>, out: &mut Array3<f32>) {
        out.par_mapv_inplace(|_| 0.0);
        self.add_back(views, y, out);
        self.outside(out, 0.0);
    }

    /// Adds `Aᵀ·y` for some views, whose images are the first of `y`, to `out`.
    pub(super) fn add_back(&self, views: &[usize], y: &Array3<f32>, out: &mut Array3<f32>) {
        self.operator.adjoint(self.geometry, views, images(y, views.len()), out.view_mut());
    }

    /// Calls `work` with each of the first images of `pixels`, its view and its measurement. Returns the results in the
    /// order of the views.
    pub fn each_image<T: Send>(
        &self,
        views: &[usize],
        pixels: &mut Array3<f32>,
        work: impl Fn(usize, &[f32], &mut [f32]) -> T + Sync,
    ) -> Vec<T> {
        let mut images = images_mut(pixels, views.len());
        let images = images.axis_iter_mut(Axis(0)).into_par_iter().zip(views);
        images
            .map(|(image, &view)| {
                let measured = self.scan.view(view);
                let measured = measured.as_standard_layout();
                match (measured.as_slice(), image.into_slice()) {
                    (Some(measured), Some(image)) => work(view, measured, image),
                    _ => unreachable!("images are contiguous"),
                }
            })
            .collect()
    }

    /// Sets the voxels outside the object's support to `value`.
    pub fn outside(&self, x: &mut Array3<f32>, value: f32) {
        if let Some(inside) = self.inside {
            Zip::from(x).and(inside).par_for_each(|x, inside| *x = if *inside { *x } else { value });
        }
    }

    /// Sets the voxels inside the object's support to 1 and the others to 0.
    pub fn ones(&self, x: &mut Array3<f32>) {
        x.fill(1.0);
        self.outside(x, 0.0);
    }

    /// All views.
    pub fn views(&self) -> Vec<usize> {
        (0..self.geometry.views.len()).collect()
    }
}

/// The first `n` images of `pixels`.
pub(super) fn images(pixels: &Array3<f32>, n: usize) -> ArrayView3<'_, f32> {
    pixels.slice(s![..n, .., ..])
}

/// Mutable version of [`images`].
pub(super) fn images_mut(pixels: &mut Array3<f32>, n: usize) -> ArrayViewMut3<'_, f32> {
    pixels.slice_mut(s![..n, .., ..])
}

/// Sum of squares of the first `n` images.
pub(super) fn pixel_norm2(pixels: &Array3<f32>, n: usize) -> f64 {
    images(pixels, n).as_slice().map_or_else(|| unreachable!("images follow each other"), square_sum)
}

/// Buffer for the pixels of the largest of `parts` parts of the views.
pub(super) fn room(space: &Space, parts: usize) -> Array3<f32> {
    space.projections(space.header().views.div_ceil(parts.max(1)))
}

/// Replaces x by `1/x` if it is above a millionth of the largest value, else by 0: excludes rays that miss the volume
/// and voxels that no ray meets.
pub fn invert(x: &mut Array3<f32>) {
    let least = 1e-6 * x.iter().fold(0.0f32, |m, &v| m.max(v));
    x.par_mapv_inplace(|v| if v > least { 1.0 / v } else { 0.0 });
}
