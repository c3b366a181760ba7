//! Trained fields, which can be evaluated at any voxels.

use crate::arguments;
use crate::volume::made;
use crate::work::without_lock;
use conefield::files;
use conefield_core::parts::Voxels;
use conefield_core::scan::Volume;
use conefield_core::trained::TrainedField;
use conefield_core::{Error, Result, allowance};
use ndarray::{Array3, s};
use pyo3::prelude::*;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// The field trained by a neural method.
#[pyclass(frozen, module = "conefield._native")]
pub struct Field {
    field: TrainedField,
    notes: BTreeMap<String, String>,
}

impl Field {
    pub fn new(field: TrainedField, notes: BTreeMap<String, String>) -> Self {
        Self { field, notes }
    }
}

#[pymethods]
impl Field {
    /// Evaluates the field on a grid with `voxels` voxels along the longest side.
    #[pyo3(signature = (voxels = None, backend = "auto"))]
    fn volume<'py>(&self, py: Python<'py>, voxels: Option<usize>, backend: &str) -> PyResult<Bound<'py, PyAny>> {
        let volume = without_lock(py, |watch| {
            let backend = arguments::backend(backend)?.open()?;
            let own = self.field.scene.grid;
            let grid = match voxels {
                None => own,
                Some(n @ 1..=8192) => own.with_longest(n),
                Some(n) => return Err(Error::invalid("arguments", "voxels", n, "1 to 8192 along the longest side")),
            };
            grid.validate("arguments")?;
            allowance::numbers("arguments", "voxels", grid.len().unwrap_or(usize::MAX))?;
            let mut from = self.field.voxels(backend.as_ref(), grid)?;
            collect(&mut from, &|| watch.cancelled())
        })?;
        made(py, volume)
    }

    /// Writes weights.safetensors, which the commands `export` and `features` read.
    fn write(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        without_lock(py, |_| files::write_field(&path, &self.field, self.notes.clone()))
    }

    #[getter]
    fn parameters(&self) -> usize {
        self.field.model.pipeline.layout().len()
    }

    fn __repr__(&self) -> String {
        let [x, y, z] = self.field.scene.grid.shape;
        format!("Field({} parameters, trained for {x} x {y} x {z} voxels)", self.parameters())
    }
}

/// Collects all of `voxels`, several planes at a time, unless cancelled.
pub fn collect(voxels: &mut dyn Voxels, cancelled: &dyn Fn() -> bool) -> Result<Volume> {
    let grid = voxels.grid();
    let mut data = Array3::zeros(grid.shape);
    let [nx, ny, nz] = grid.shape;
    // Number of planes between two checks for cancellation.
    let planes = (1usize << 20).div_ceil((ny * nz).max(1));
    for from in (0..nx).step_by(planes) {
        if cancelled() {
            return Err(Error::Aborted { part: "the evaluation of voxels".into() });
        }
        let x = from..(from + planes).min(nx);
        voxels.fill(&[x.clone(), 0..ny, 0..nz], data.slice_mut(s![x, .., ..]))?;
    }
    Ok(Volume { data, grid, affine: voxels.affine() })
}

/// Reads the weights.safetensors of a run.
#[pyfunction]
pub fn read_field(py: Python<'_>, path: PathBuf) -> PyResult<Field> {
    let file = if path.is_dir() { path.join("weights.safetensors") } else { path };
    let (field, notes) = without_lock(py, |_| {
        let notes = conefield_io::read_weights(&file)?.notes;
        Ok((files::read_field(&file)?, notes))
    })?;
    Ok(Field::new(field, notes))
}
