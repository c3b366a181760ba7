//! The order in which files store voxels: x fastest in NIfTI, MetaImage, NRRD and TIFF stacks, z fastest in NumPy's
//! files and in conefield's arrays.

use crate::affine::Affine;
use crate::memory;
use crate::{number, packing};
use conefield_core::finite::stray;
use conefield_core::geometry::VoxelGrid;
use conefield_core::parts::{Voxels, copy};
use conefield_core::scan::Volume;
use conefield_core::{Error, Result, allowance};
use ndarray::{Array3, ArrayViewMut3, ShapeBuilder, aview1};
use std::io::Write;
use std::path::Path;

/// Which axis runs fastest in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FileOrder {
    XFastest,
    ZFastest,
}

/// A volume from `values` in the order of NIfTI and MetaImage, x fastest, of the file `place`; refuses a value that is
/// not finite.
pub(crate) fn read(place: &str, grid: VoxelGrid, affine: Option<Affine>, values: Vec<f32>) -> Result<Volume> {
    let [nx, ny, nz] = grid.shape;
    let stored = Array3::from_shape_vec((nx, ny, nz).f(), values)
        .map_err(|e| Error::invalid(place, "data", e, "as many values as voxels"))?;
    allowance::numbers(place, "data", stored.len())?;
    let mut data = Array3::zeros(grid.shape);
    copy(data.view_mut(), stored.view());
    drop(stored);
    let data = memory::all_finite(place, data, &|(x, y, z)| format!("voxel [{x}, {y}, {z}]"))?;
    Ok(Volume { data, grid, affine })
}

/// Voxels in memory at once while a file is written.
const SLAB: usize = 1 << 22;

/// Bytes of a slab, and of what compresses it.
pub const SLAB_BYTES: u64 = 4 * SLAB as u64 + packing::BYTES;

/// Bytes of compressed data that the writer of MetaImage keeps in memory; more goes to a file.
pub const PACKED_BYTES: u64 = 32 << 20;

/// Writes `voxels` to the file `path`, little-endian, slab by slab along the file's slowest axis; refuses a value that
/// is not finite.
pub(crate) fn write(w: &mut dyn Write, path: &Path, voxels: &mut dyn Voxels, order: FileOrder) -> Result<()> {
    let shape = voxels.grid().shape;
    let axis = match order {
        FileOrder::XFastest => 2,
        FileOrder::ZFastest => 0,
    };
    // Whole layers if one fits, else rows of a layer.
    let (row, rows) = (shape[2 - axis], shape[1]);
    let broad = (SLAB / row).clamp(1, rows);
    let thick = (SLAB / (row * rows)).clamp(1, shape[axis]);
    let mut values = vec![0.0; thick * broad * row];
    let layers = (0..shape[axis]).step_by(thick);
    for (from, along) in layers.flat_map(|from| (0..rows).step_by(broad).map(move |along| (from, along))) {
        let mut part = shape.map(|n| 0..n);
        part[axis] = from..(from + thick).min(shape[axis]);
        part[1] = along..(along + broad).min(rows);
        let size = part.each_ref().map(|r| r.len());
        let values = &mut values[..size.iter().product()];
        let layout = size.set_f(order == FileOrder::XFastest);
        let slab = ArrayViewMut3::from_shape(layout, values)
            .map_err(|e| Error::invalid(path.display().to_string(), "shape", e, "a shape that can be addressed"))?;
        voxels.fill(&part, slab)?;
        if let Some((i, x)) = stray(&aview1(values)) {
            let at = match order {
                FileOrder::XFastest => [i % size[0], along + i / size[0] % size[1], from + i / (size[0] * size[1])],
                FileOrder::ZFastest => [from + i / (size[1] * size[2]), along + i / size[2] % size[1], i % size[2]],
            };
            let place = path.display().to_string();
            return Err(Error::invalid(place, format!("voxel {at:?}"), x, "a finite number"));
        }
        number::write(w, values).map_err(|e| Error::io(path, e))?;
    }
    Ok(())
}
