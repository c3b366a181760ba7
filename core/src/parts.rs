//! Volumes available part by part, so that they need not be in memory as a whole.

use crate::allowance;
use crate::error::Result;
use crate::geometry::VoxelGrid;
use crate::scan::{Affine, Volume};
use ndarray::{Array3, ArrayView3, ArrayViewMut3};
use std::ops::Range;

/// A box of voxels: a range along each of x, y and z.
pub type Part = [Range<usize>; 3];

/// A volume in memory, or one that computes its voxels on demand.
pub trait Voxels {
    /// Where the voxels are.
    fn grid(&self) -> VoxelGrid;

    /// Voxel indices to the patient's or file's own coordinates, if known; see [`Volume::affine`].
    fn affine(&self) -> Option<Affine>;

    /// If the values are Hounsfield units: what they are of, for the header of a file, in a few words.
    fn hounsfield(&self) -> Option<&str> {
        None
    }

    /// Puts the values of `part` into `out`, which has its shape.
    fn fill(&mut self, part: &Part, out: ArrayViewMut3<'_, f32>) -> Result<()>;
}

impl Voxels for &Volume {
    fn grid(&self) -> VoxelGrid {
        self.grid
    }

    fn affine(&self) -> Option<Affine> {
        self.affine
    }

    fn fill(&mut self, part: &Part, out: ArrayViewMut3<'_, f32>) -> Result<()> {
        let [x, y, z] = part.clone();
        copy(out, self.data.slice(ndarray::s![x, y, z]));
        Ok(())
    }
}

/// Copies `from` to `to`, of the same shape, plane by plane along x. A part of an array on the disk may touch all of
/// its pages, faster than they are given back in the background.
pub fn copy(mut to: ArrayViewMut3<'_, f32>, from: ArrayView3<'_, f32>) {
    for (mut to, from) in to.outer_iter_mut().zip(from.outer_iter()) {
        to.assign(&from);
        allowance::trim();
    }
}

impl Volume {
    /// All of `voxels`, in memory.
    pub fn collect(voxels: &mut dyn Voxels) -> Result<Self> {
        let grid = voxels.grid();
        let mut data = Array3::zeros(grid.shape);
        voxels.fill(&grid.shape.map(|n| 0..n), data.view_mut())?;
        Ok(Self { data, grid, affine: voxels.affine() })
    }
}
