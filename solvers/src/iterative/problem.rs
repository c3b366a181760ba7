//! A scan with its system matrix, in a place.

use super::regions::Regions;
use crate::shadow::{air_level, shadow};
use conefield_core::data_term::Misfit;
use conefield_core::error::Result;
use conefield_core::geometry::Geometry;
use conefield_core::parallel;
use conefield_core::place::{
    ADD, Array, Bounds, CLIP, INVERT, Mask, MeasuredViews, Place, Reduction, ViewRays, Weighing,
};
use conefield_core::scan::Scan;
use conefield_core::space::Space;
use conefield_core::voxel::VoxelProjector;
use ndarray::{Array3, Axis};

/// Pixels by which the object's shadow is dilated; pixels outside count as air.
const MARGIN: usize = 4;

/// A scan and its system matrix. Pixel arrays may have room for more views than requested; the first images are then
/// used.
pub struct Problem<'a> {
    /// The measured scan.
    pub scan: &'a Scan,
    /// Its geometry, with the grid of the unknowns as the volume.
    pub geometry: &'a Geometry,
    /// Where the arrays live.
    pub place: &'a dyn Place,
    /// The system matrix.
    pub projector: &'a dyn VoxelProjector,
    /// Seed of all randomness.
    pub seed: u64,
    /// Whether a known volume is the start.
    pub(super) started: bool,
    /// Bounds of the attenuation, in 1/mm.
    pub bounds: Bounds,
    /// Regions with other bounds.
    pub regions: &'a Regions,
    /// The voxels that may be nonzero, if not all.
    pub(super) inside: Option<&'a Mask>,
    /// The object's shadow, if the other pixels count as 0.
    pub(super) shadow: Option<Mask>,
    /// The measured images.
    pub(super) views: MeasuredViews<'a>,
}

impl Problem<'_> {
    /// Makes pixels outside the object's shadow count as 0. Returns their share.
    pub fn clear_air(&mut self) -> Result<f64> {
        let level = air_level(self.scan);
        let mut inside = Array3::from_elem(self.scan.projections.raw_dim(), false);
        let views = inside.axis_iter_mut(Axis(0)).zip(self.scan.projections.outer_iter());
        parallel::over(views, |_, (mut inside, view)| inside.assign(&shadow(view, level, MARGIN)));
        let seen = inside.iter().filter(|x| **x).count();
        let share = 1.0 - seen as f64 / inside.len().max(1) as f64;
        self.shadow = Some(self.place.mask(inside)?);
        Ok(share)
    }

    /// Takes the measured images to the place, if they fit beside what is there.
    pub fn settle(&mut self) -> Result<()> {
        self.views = self.place.views(&self.scan.projections)?;
        Ok(())
    }

    /// How line integrals are compared with the measured ones.
    pub(super) fn by<'a>(&'a self, term: Option<&'a dyn Misfit>, weights: Option<&'a Array>) -> Weighing<'a> {
        Weighing { views: &self.views, shadow: self.shadow.as_ref(), weights, term }
    }

    /// Overwrites the first images of `out` with `A·x` for some views.
    pub fn forward(&self, views: &[usize], x: &Array, out: &mut Array) -> Result<()> {
        self.place.forward(self.rays(views), x, out)
    }

    fn rays<'a>(&'a self, views: &'a [usize]) -> ViewRays<'a> {
        ViewRays { projector: self.projector, geometry: self.geometry, views }
    }

    /// Overwrites the first images of `out` with `W·(p − A·x)` for some views, with p = 0 in air if requested; W is 1 or
    /// `weights`. Returns `‖p − A·x‖²`.
    pub fn residual(&self, views: &[usize], x: &Array, weights: Option<&Array>, out: &mut Array) -> Result<f64> {
        self.forward(views, x, out)?;
        Ok(self.place.compare(&self.by(None, weights), views, out)?[0])
    }

    /// Overwrites `out` with `Aᵀ·y` for some views, whose images are the first of `y`. `out` is 0 outside the object's
    /// support, so that zeros there stay.
    pub fn back(&self, views: &[usize], y: &Array, out: &mut Array) -> Result<()> {
        self.place.fill(out, 0.0)?;
        self.add_back(views, y, out)?;
        self.outside(out, 0.0)
    }

    /// Adds `Aᵀ·y` for some views, whose images are the first of `y`, to `out`.
    pub(super) fn add_back(&self, views: &[usize], y: &Array, out: &mut Array) -> Result<()> {
        self.place.adjoint(self.rays(views), y, out)
    }

    /// Sets the voxels outside the object's support to `value`.
    pub fn outside(&self, x: &mut Array, value: f32) -> Result<()> {
        self.inside.map_or(Ok(()), |inside| self.place.keep(x, inside, value))
    }

    /// Clips a volume to `bounds`, and regions to theirs.
    pub fn clip(&self, x: &mut Array, bounds: Bounds) -> Result<()> {
        if self.regions.is_empty() {
            let Bounds { low, high } = bounds;
            return self.place.map(&CLIP, [low, high].map(f64::from), x, &[]);
        }
        let grid = &self.scan.geometry.volume;
        self.place.change(x, &mut |x| self.regions.clip(x, grid, bounds, 1.0))
    }

    /// Sets the voxels inside the object's support to 1 and the others to 0.
    pub fn ones(&self, x: &mut Array) -> Result<()> {
        self.place.fill(x, 1.0)?;
        self.outside(x, 0.0)
    }

    /// All views.
    pub fn views(&self) -> Vec<usize> {
        (0..self.geometry.views.len()).collect()
    }
}

/// `‖x‖²`.
pub(super) fn norm2(place: &dyn Place, x: &Array) -> Result<f64> {
    place.reduce(Reduction::Squares, x, x)
}

/// `‖x − y‖`.
pub(super) fn distance(place: &dyn Place, x: &Array, y: &Array) -> Result<f64> {
    Ok(place.reduce(Reduction::Differences, x, y)?.sqrt())
}

/// Root mean square of `x − before`, relative to that of `x`.
pub(super) fn change(place: &dyn Place, x: &Array, before: &Array) -> Result<f64> {
    Ok(distance(place, x, before)? / norm2(place, x)?.max(1e-300).sqrt())
}

/// Overwrites `to` with `from`.
pub(super) fn copy(place: &dyn Place, from: &Array, to: &mut Array) -> Result<()> {
    place.map(&ADD, [1.0, 0.0], to, &[from])
}

/// Buffer for the pixels of the largest of `parts` parts of the views.
pub(super) fn room(space: &Space, parts: usize) -> Result<Array> {
    space.projections(space.header().views.div_ceil(parts.max(1)))
}

/// Replaces x by `1/x` if it is above a millionth of the largest value, else by 0: excludes rays that miss the volume
/// and voxels that no ray meets.
pub(super) fn invert(place: &dyn Place, x: &mut Array) -> Result<()> {
    let largest = place.reduce(Reduction::Maximum, x, x)?;
    place.map(&INVERT, [f64::from(1e-6 * largest as f32), 0.0], x, &[])
}
