//! Volumes: `conefield.Volume` is written in Python, as it holds a NumPy array that users may change.

use crate::arguments;
use crate::arrays::{check_memory, fitting, given};
use crate::errors::OrRaise;
use crate::work::without_lock;
use conefield::hounsfield::{How, Levels};
use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::{Unit, Volume};
use numpy::{PyArray2, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::prelude::*;
use std::path::PathBuf;

/// Converts from a `conefield.Volume`.
pub fn taken(volume: &Bound<'_, PyAny>) -> PyResult<Volume> {
    let data: PyReadonlyArray3<'_, f32> = volume.getattr("data")?.extract()?;
    let grid = VoxelGrid {
        shape: [data.shape()[0], data.shape()[1], data.shape()[2]],
        spacing: volume.getattr("spacing")?.extract()?,
        center: volume.getattr("center")?.extract()?,
    };
    let affine: Option<[[f64; 4]; 4]> = match volume.getattr("affine")? {
        none if none.is_none() => None,
        rows => Some(rows.call_method0("tolist")?.extract()?),
    };
    grid.validate("volume").or_raise(volume.py())?;
    Ok(Volume { data: fitting(&data)?, grid, affine })
}

/// Converts to a `conefield.Volume`.
pub fn made<'py>(py: Python<'py>, volume: Volume) -> PyResult<Bound<'py, PyAny>> {
    let Volume { data, grid, affine } = volume;
    let affine = affine.map(|a| PyArray2::from_vec2(py, &a.map(|row| row.to_vec())));
    let affine = affine.transpose().map_err(|e| crate::errors::broken(py, &e.to_string()))?;
    let class = py.import("conefield._volume")?.getattr("Volume")?;
    class.call1((given(py, data), grid.spacing.to_vec(), grid.center.to_vec(), affine))
}

/// Reads the volume `name`: a file, the folder of a DICOM series, of TIFF slices or of OME-Zarr, or
/// `phantom:KIND[:SIZE]`.
#[pyfunction]
pub fn read_volume(py: Python<'_>, name: String) -> PyResult<Bound<'_, PyAny>> {
    let volume = without_lock(py, |_| {
        let voxels = conefield::files::voxels(&name)?;
        conefield::memory::Memory::of_volumes(&[voxels]).check()?;
        conefield::files::volume(&name)
    })?;
    made(py, volume)
}

/// Writes a volume in the format given by the file extension; the header says if it is in Hounsfield units.
#[pyfunction]
pub fn write_volume(py: Python<'_>, path: PathBuf, volume: &Bound<'_, PyAny>) -> PyResult<()> {
    let note: Option<String> = volume.getattr("hu")?.extract()?;
    let volume = taken(volume)?;
    without_lock(py, |_| match note {
        None => conefield_io::write_volume(&path, &volume),
        Some(note) => conefield_io::write_voxels(&path, &mut Levels::already(note).of(&mut &volume)),
    })
}

/// The volume in Hounsfield units. Its values are in 1/`unit` (name and mm), without a unit in 1/mm.
#[pyfunction]
pub fn hounsfield<'py>(
    py: Python<'py>,
    volume: &Bound<'py, PyAny>,
    how: &str,
    unit: Option<(String, f64)>,
) -> PyResult<Bound<'py, PyAny>> {
    let volume = taken(volume)?;
    // The converted volume is another one.
    check_memory(8 * volume.data.len() as u64).or_raise(py)?;
    let unit = unit.map(|(name, mm)| Unit { name, mm });
    let (converted, note) = without_lock(py, |_| {
        let how: How = arguments::parsed("how", how, |text| text.parse())?;
        let calibration = how.open("volume", unit.as_ref(), &volume.grid, volume.affine.as_ref())?;
        let levels = calibration.measure(&mut &volume)?;
        let converted = Volume::collect(&mut levels.of(&mut &volume))?;
        Ok((converted, levels.note))
    })?;
    let converted = made(py, converted)?;
    converted.setattr("hu", note)?;
    Ok(converted)
}
