//! The order in which NIfTI and MetaImage store voxels: x fastest. The program's arrays run z fastest.

use crate::affine::Affine;
use crate::input::Input;
use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::Volume;
use conefield_core::{Error, Result};
use ndarray::{Array3, ShapeBuilder};
use std::io::Write;
use std::path::Path;

/// A volume of `values` as NIfTI and MetaImage store them, x fastest; one that is not finite is refused.
pub(crate) fn read(input: &Input, grid: VoxelGrid, affine: Affine, values: Vec<f32>) -> Result<Volume> {
    let [nx, ny, nz] = grid.shape;
    let data = Array3::from_shape_vec((nx, ny, nz).f(), values)
        .map_err(|e| input.invalid("data", e, "as many values as voxels"))?;
    let data = data.as_standard_layout().into_owned();
    if let Some((at, x)) = data.indexed_iter().find(|(_, x)| !x.is_finite()) {
        return Err(input.invalid(format!("voxel [{}, {}, {}]", at.0, at.1, at.2), x, "a finite number"));
    }
    Ok(Volume { data, grid, affine: Some(affine) })
}

/// Writes `data` to the file `path` as [`read`] reads it, little-endian.
pub(crate) fn write(w: &mut dyn Write, path: &Path, data: &Array3<f32>) -> Result<()> {
    let (nx, ny, nz) = data.dim();
    let mut row = Vec::with_capacity(nx * 4);
    for z in 0..nz {
        for y in 0..ny {
            row.clear();
            row.extend((0..nx).flat_map(|x| data[[x, y, z]].to_le_bytes()));
            w.write_all(&row).map_err(|e| Error::io(path, e))?;
        }
    }
    Ok(())
}
