//! Line integrals of voxels and their adjoint.

use crate::arguments;
use crate::arrays::{check_memory, given, owned};
use crate::errors::OrRaise;
use crate::geometry::Geometry;
use crate::scan::Scan;
use crate::volume::taken;
use crate::work::{Watch, without_lock};
use conefield::projection;
use conefield_core::error::ensure;
use conefield_core::geometry;
use conefield_core::simd::Real;
use conefield_core::voxel::VoxelOperator;
use conefield_core::{Error, Result};
use conefield_evaluation::metrics;
use ndarray::Array3;
use numpy::{PyArray3, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::prelude::*;
use serde_json::Value;

/// The shapes of `x` and of the result, and what `x` is.
fn sides(adjoint: bool, g: &geometry::Geometry) -> ([usize; 3], [usize; 3], &'static str) {
    let [rows, columns] = g.detector;
    let (volume, views) = (g.volume.shape, [g.views.len(), rows, columns]);
    if adjoint { (views, volume, "projections") } else { (volume, views, "volume") }
}

/// `A·x`, or with `adjoint` `Aᵀ·x`.
fn applied<R: Real>(
    adjoint: bool,
    operator: &dyn VoxelOperator<R>,
    g: &geometry::Geometry,
    x: Array3<R>,
) -> Result<Array3<R>> {
    let (_, to, _) = sides(adjoint, g);
    let all: Vec<usize> = (0..g.views.len()).collect();
    let mut out = Array3::from_elem(to, R::ZERO);
    if adjoint {
        operator.adjoint(g, &all, x.view(), out.view_mut());
    } else {
        operator.forward(g, &all, x.view(), out.view_mut());
    }
    operator.fault()?;
    Ok(out)
}

/// `A·x`, or with `adjoint` `Aᵀ·x`, in the precision of `array`.
#[pyfunction]
pub fn apply<'py>(
    py: Python<'py>,
    geometry: &Bound<'py, Geometry>,
    projector: &str,
    array: &Bound<'py, PyAny>,
    adjoint: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let projector: Value = arguments::read(py, projector)?;
    let g = &geometry.get().0;
    // Before `x` is copied: its shape, and memory for both arrays.
    let checked = |shape: &[usize], size: u64| {
        let (from, _, what) = sides(adjoint, g);
        let expected = format!("{from:?}, as the geometry has it");
        ensure(shape == from, what, "shape", format!("{shape:?}"), expected).or_raise(py)?;
        without_lock(py, |_| {
            let projector = projection::projector(projector)?;
            let voxels = g.volume.shape.iter().map(|&n| n as u64).product::<u64>();
            check_memory(size / 4 * (projection::bytes(projector.as_ref(), g) + 4 * voxels))?;
            Ok(projector)
        })
    };
    if let Ok(double) = array.extract::<PyReadonlyArray3<'_, f64>>() {
        let projector = checked(double.shape(), 8)?;
        let x = owned(&double);
        let work = |_: &Watch| applied(adjoint, projector.reference(), g, x);
        return Ok(given(py, without_lock(py, work)?).into_any());
    }
    let single = array.extract::<PyReadonlyArray3<'_, f32>>()?;
    let projector = checked(single.shape(), 4)?;
    let x = owned(&single);
    let work = |_: &Watch| applied(adjoint, projector.operator(), g, x);
    Ok(given(py, without_lock(py, work)?).into_any())
}

/// Predicted views of `scan` for a volume in 1/unit of the scan; with `residual` measured minus predicted ones.
#[pyfunction]
pub fn project_scan<'py>(
    py: Python<'py>,
    scan: &Bound<'py, Scan>,
    projector: &str,
    volume: &Bound<'py, PyAny>,
    residual: bool,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    let projector: Value = arguments::read(py, projector)?;
    let (volume, scan) = (taken(volume)?, &scan.get().scan);
    let views = without_lock(py, |_| {
        let projector = projection::projector(projector)?;
        let mut geometry = scan.geometry.clone();
        geometry.volume = projection::placed(&volume, &scan.geometry.volume, true);
        if let Some(odd) = projection::oddity(&geometry.volume, &scan.geometry.volume) {
            tracing::warn!("{odd}");
        }
        check_memory(projection::bytes(projector.as_ref(), &geometry))?;
        let mut views = projection::predicted(&volume, &geometry, scan.unit.mm, projector.as_ref(), &mut |_| Ok(()))?;
        if residual {
            metrics::residual(scan, &mut views)?;
        }
        Ok::<_, Error>(views)
    })?;
    Ok(given(py, views))
}
