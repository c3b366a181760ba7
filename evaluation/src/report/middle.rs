//! The middle slices of a volume.

use conefield_core::geometry::VoxelGrid;
use conefield_core::parts::{Part, copy};
use conefield_core::scan::Volume;
use ndarray::{Array2, ArrayView3, Axis, s};

/// The three middle slices of a volume; pictures show nothing else.
#[derive(Debug, Clone)]
pub struct MiddleSlices {
    pub(super) grid: VoxelGrid,
    /// Slices perpendicular to x, y and z; the remaining axes keep their order.
    pub(super) across: [Array2<f32>; 3],
}

impl MiddleSlices {
    /// Slices of zeros, to be filled by [`MiddleSlices::gather`].
    pub fn new(grid: VoxelGrid) -> Self {
        let [x, y, z] = grid.shape;
        Self { grid, across: [[y, z], [x, z], [x, y]].map(Array2::zeros) }
    }

    /// The slices of a whole volume.
    pub fn of(volume: &Volume) -> Self {
        let mut slices = Self::new(volume.grid);
        slices.gather(&volume.grid.shape.map(|n| 0..n), volume.data.view());
        slices
    }

    /// Copies the voxels of `part` that belong to the slices.
    pub fn gather(&mut self, part: &Part, values: ArrayView3<'_, f32>) {
        for (k, slice) in self.across.iter_mut().enumerate() {
            let middle = self.grid.shape[k] / 2;
            if part[k].contains(&middle) {
                let [a, b] = [[1, 2], [0, 2], [0, 1]][k].map(|axis: usize| part[axis].clone());
                let at = middle - part[k].start;
                copy(slice.slice_mut(s![a, b]).insert_axis(Axis(k)), values.slice_axis(Axis(k), (at..at + 1).into()));
            }
        }
    }

    /// Grey window: the values shown, without the outermost thousandth on either side.
    pub fn window(&self) -> [f32; 2] {
        let mut all: Vec<f32> = self.across.iter().flatten().copied().filter(|x| x.is_finite()).collect();
        all.sort_unstable_by(f32::total_cmp);
        let at = |share: f64| all.get((all.len() as f64 * share) as usize).or(all.last()).copied().unwrap_or(0.0);
        let (low, high) = (at(0.001), at(0.999));
        if low < high { [low, high] } else { [low, low + low.abs().max(1.0)] }
    }
}
