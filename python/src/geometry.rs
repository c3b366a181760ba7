//! Positions of source, detector and voxels.

use crate::arguments;
use crate::arrays::{given, owned};
use crate::errors::{OrRaise, raised};
use conefield_core::Error;
use conefield_core::error::ensure;
use conefield_core::geometry::{self, Radians, Vec3, View, VoxelGrid};
use conefield_core::orbit::{self, CircularOrbit};
use conefield_core::words::counted;
use ndarray::Array2;
use numpy::{PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

/// Positions of source, detector and voxels, for every view.
#[pyclass(frozen, module = "conefield._native")]
pub struct Geometry(pub geometry::Geometry);

/// Numbers per view: source, detector centre, step to the next column u, step to the next row v.
const VECTOR: usize = 12;

impl Geometry {
    fn checked(py: Python<'_>, geometry: geometry::Geometry) -> PyResult<Self> {
        geometry.validate("geometry").or_raise(py)?;
        Ok(Self(geometry))
    }
}

#[pymethods]
impl Geometry {
    /// A circular orbit about z.
    #[staticmethod]
    fn circular(
        py: Python<'_>,
        dso: Option<f64>,
        dsd: Option<f64>,
        angles: PyReadonlyArray1<'_, f64>,
        detector: [usize; 2],
        pixel: [f64; 2],
        offset: [f64; 2],
        tilt: [f64; 3],
        volume: ([usize; 3], Vec3, Vec3),
    ) -> PyResult<Self> {
        let angles = owned(&angles).to_vec();
        let all = [&offset[..], &tilt, &angles].concat();
        let field = "a length or an angle";
        ensure(all.iter().all(|x| x.is_finite()), "geometry", field, "a number that is not finite", "finite numbers")
            .or_raise(py)?;
        let (shape, spacing, center) = volume;
        let volume = VoxelGrid { shape, spacing, center };
        orbit::check_pixel("geometry", "", pixel).or_raise(py)?;
        let orbit = if dso.is_none() && dsd.is_none() {
            CircularOrbit::parallel(&volume, pixel, offset, angles)
        } else {
            let parallel = "neither dso nor dsd: a parallel beam";
            let [dso, dsd] = orbit::distances("geometry", "", [dso, dsd], parallel).or_raise(py)?;
            CircularOrbit { dso, dsd, pixel, offset, angles }
        };
        let tilt = tilt.map(Radians);
        let views = orbit.views().into_iter().map(|v| v.tilted(tilt)).collect();
        Self::checked(py, geometry::Geometry { detector, views, volume })
    }

    /// Views given by their vectors, `[view, 12]`.
    #[staticmethod]
    fn from_vectors(
        py: Python<'_>,
        vectors: PyReadonlyArray2<'_, f64>,
        detector: [usize; 2],
        volume: ([usize; 3], Vec3, Vec3),
    ) -> PyResult<Self> {
        let found = format!("{:?}", vectors.shape());
        let expected = "[views, 12]: source, detector centre, u and v of each view";
        ensure(vectors.shape()[1] == VECTOR, "geometry", "shape of the vectors", found, expected).or_raise(py)?;
        let vectors = owned(&vectors);
        let view = |row: ndarray::ArrayView1<'_, f64>| {
            let at = |first: usize| -> Vec3 { std::array::from_fn(|k| row[first + k]) };
            View { source: at(0), detector: at(3), u: at(6), v: at(9) }
        };
        let views = vectors.rows().into_iter().map(view).collect();
        let (shape, spacing, center) = volume;
        Self::checked(py, geometry::Geometry { detector, views, volume: VoxelGrid { shape, spacing, center } })
    }

    /// The same views with another voxel grid.
    fn with_volume(&self, py: Python<'_>, shape: [usize; 3], spacing: Vec3, center: Vec3) -> PyResult<Self> {
        Self::checked(py, geometry::Geometry { volume: VoxelGrid { shape, spacing, center }, ..self.0.clone() })
    }

    /// Some of the views, in the order of the indices; or those where a mask is true.
    fn select(&self, views: &Bound<'_, PyAny>) -> PyResult<Self> {
        let (py, n) = (views.py(), self.0.views.len());
        let views = arguments::views(views, "views", n)?;
        if let Some(v) = views.iter().find(|v| **v >= n) {
            return Err(raised(py, &Error::invalid("geometry", "view", v, format!("an index below {n}"))));
        }
        let views = views.iter().map(|&v| self.0.views[v]).collect();
        Self::checked(py, geometry::Geometry { views, ..self.0.clone() })
    }

    #[getter]
    fn vectors<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        let at = |v: &View, k: usize| [v.source, v.detector, v.u, v.v][k / 3][k % 3];
        given(py, Array2::from_shape_fn((self.0.views.len(), VECTOR), |(i, k)| at(&self.0.views[i], k)))
    }

    #[getter]
    fn detector(&self) -> (usize, usize) {
        self.0.detector.into()
    }

    #[getter]
    fn volume_shape(&self) -> (usize, usize, usize) {
        self.0.volume.shape.into()
    }

    #[getter]
    fn spacing(&self) -> (f64, f64, f64) {
        self.0.volume.spacing.into()
    }

    #[getter]
    fn center(&self) -> (f64, f64, f64) {
        self.0.volume.center.into()
    }

    #[getter]
    fn projections_shape(&self) -> (usize, usize, usize) {
        let [rows, columns] = self.0.detector;
        (self.0.views.len(), rows, columns)
    }

    /// The circular orbit of the views, if they lie on one: dso, dsd, pixel, offset, angles.
    #[allow(clippy::type_complexity)]
    fn orbit(&self) -> Option<(f64, f64, [f64; 2], [f64; 2], Vec<f64>)> {
        CircularOrbit::fit(&self.0.views).map(|o| (o.dso, o.dsd, o.pixel, o.offset, o.angles))
    }

    fn __len__(&self) -> usize {
        self.0.views.len()
    }

    fn __eq__(&self, other: &Bound<'_, PyAny>) -> bool {
        other.cast::<Self>().is_ok_and(|o| o.get().0 == self.0)
    }

    fn __repr__(&self) -> String {
        let (g, [rows, columns], [x, y, z]) = (&self.0, self.0.detector, self.0.volume.shape);
        let views = counted(g.views.len(), "view");
        format!("Geometry({views} of {rows} x {columns}, volume {x} x {y} x {z})")
    }

    /// For pickling, as used by multiprocessing.
    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyTuple>)> {
        let (py, g) = (slf.py(), slf.get());
        let make = py.get_type::<Self>().getattr("from_vectors")?;
        let volume = (g.0.volume.shape, g.0.volume.spacing, g.0.volume.center);
        let arguments = (g.vectors(py), g.0.detector, volume).into_pyobject(py)?;
        Ok((make, arguments))
    }
}
