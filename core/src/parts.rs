//! Volumes available part by part, so that they need not be in memory as a whole.

use crate::error::Result;
use crate::geometry::VoxelGrid;
use crate::parallel;
use crate::scan::{Affine, Volume};
use ndarray::{Array3, ArrayView2, ArrayView3, ArrayViewMut2, ArrayViewMut3, Axis};
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

/// Side of the blocks that are copied at once: the voxels of a cache line.
const SIDE: usize = 16;
/// Voxels along z that are copied at once.
const DEPTH: usize = 64;

/// Copies `from` to `to`, of the same shape. Files and arrays differ in the axis that runs fastest. A few planes along x
/// at a time, as a part of an array on the disk may touch all of its pages.
pub fn copy(mut to: ArrayViewMut3<'_, f32>, from: ArrayView3<'_, f32>) {
    for (mut to, from) in to.axis_chunks_iter_mut(Axis(0), SIDE).zip(from.axis_chunks_iter(Axis(0), SIDE)) {
        let blocks = to.axis_chunks_iter_mut(Axis(1), SIDE).zip(from.axis_chunks_iter(Axis(1), SIDE));
        parallel::over(blocks, |_, (mut to, from)| {
            to.axis_iter_mut(Axis(1)).zip(from.axis_iter(Axis(1))).for_each(|(to, from)| turn(to, from));
        });
    }
}

/// Copies at most [`SIDE`] lines, each by way of a small buffer: both arrays are passed through as they lie in memory.
fn turn(mut to: ArrayViewMut2<'_, f32>, from: ArrayView2<'_, f32>) {
    let mut buffer = [[0.0; DEPTH]; SIDE];
    let parts = to.axis_chunks_iter_mut(Axis(1), DEPTH).zip(from.axis_chunks_iter(Axis(1), DEPTH));
    for (mut to, from) in parts {
        if from.strides()[0] == 1 {
            for (z, line) in from.axis_iter(Axis(1)).enumerate() {
                buffer.iter_mut().zip(line).for_each(|(buffer, value)| buffer[z] = *value);
            }
        } else {
            for (line, buffer) in from.outer_iter().zip(&mut buffer) {
                buffer.iter_mut().zip(line).for_each(|(buffer, value)| *buffer = *value);
            }
        }
        if to.strides()[0] == 1 {
            for (z, mut line) in to.axis_iter_mut(Axis(1)).enumerate() {
                line.iter_mut().zip(&buffer).for_each(|(value, buffer)| *value = buffer[z]);
            }
        } else {
            for (mut line, buffer) in to.outer_iter_mut().zip(&buffer) {
                line.iter_mut().zip(buffer).for_each(|(value, buffer)| *value = *buffer);
            }
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::ShapeBuilder;

    #[test]
    fn copies_between_any_layouts() {
        for shape in [[1, 1, 1], [5, 40, 3], [17, 16, 130], [33, 3, 64]] {
            let value = |(x, y, z): (usize, usize, usize)| (x * 10_000 + y * 200 + z) as f32;
            for [from_f, to_f] in [[false, false], [false, true], [true, false], [true, true]] {
                let from = Array3::from_shape_fn(shape.set_f(from_f), value);
                let mut to = Array3::zeros(shape.set_f(to_f));
                copy(to.view_mut(), from.view());
                assert!(to.indexed_iter().all(|(at, x)| *x == value(at)), "{shape:?}, {from_f} to {to_f}");
            }
            // A part of an array whose lines run along y.
            let whole = Array3::from_shape_fn([shape[0], shape[2] + 2, shape[1]], |(x, z, y)| value((x, y, z)));
            let mut to = Array3::zeros(shape);
            copy(to.view_mut(), whole.slice(ndarray::s![.., 1..=shape[2], ..]).permuted_axes([0, 2, 1]));
            assert!(to.indexed_iter().all(|((x, y, z), v)| *v == value((x, y, z + 1))), "{shape:?}");
        }
    }
}
