//! A regularizer implemented by a Python object: a proximal map, or a denoiser in its place.

use crate::errors::OrRaise;
use crate::stages::{StageObject, optional};
use conefield_core::error::ensure;
use conefield_core::geometry::VoxelGrid;
use conefield_core::regularizer::{Penalty, Regularizer, Weight};
use conefield_core::space::Space;
use conefield_core::{Error, Result};
use ndarray::{Array3, ArrayView3};
use numpy::IntoPyArray;
use pyo3::prelude::*;
use std::sync::Arc;

struct Shared {
    of: StageObject,
    weight: Weight,
    /// Whether the object can evaluate its penalty.
    has_value: bool,
}

/// A regularizer of a Python object.
pub struct PythonRegularizer(Arc<Shared>);

impl PythonRegularizer {
    /// The outer error is an exception of the object.
    pub fn new(py: Python<'_>, of: StageObject) -> PyResult<Result<Self>> {
        let own = of.object.bind(py);
        let weight = match (optional(own, "weight")?, optional(own, "noise_weight")?) {
            (Some(_), Some(_)) => {
                let expected = "one of them: weight is λ itself, noise_weight counts in the scan's noise";
                return Ok(Err(Error::invalid("spec", "weight", "noise_weight beside it", expected)));
            }
            (Some(w), None) => Weight::Fixed(w),
            (None, k) => Weight::Noise(k.unwrap_or(1.0)),
        };
        if let Err(e) = weight.validate() {
            return Ok(Err(e));
        }
        if !own.hasattr("prox")? {
            return Ok(Err(Error::invalid("spec", "prox", "no such method", "prox(v, tau), an array like v")));
        }
        let has_value = own.hasattr("value")?;
        Ok(Ok(Self(Arc::new(Shared { of, weight, has_value }))))
    }
}

impl Regularizer for PythonRegularizer {
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
        // Input and output arrays.
        space.hold(8 * grid.shape.iter().map(|&n| n as u64).product::<u64>());
        Ok(Box::new(On { shared: self.0.clone(), grid: *grid }))
    }

    fn weight(&self, _: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(self.0.weight.lambda(1.0, noise))
    }

    fn describe(&self) -> String {
        let kind = if self.0.has_value { "a proximal map" } else { "a denoiser" };
        format!("{}: {kind} written in Python, weight {}", self.0.of.name, self.0.weight)
    }
}

/// The object for one grid.
struct On {
    shared: Arc<Shared>,
    grid: VoxelGrid,
}

impl On {
    /// Runs `call` with the GIL, one at a time; `None` if it or another stage has failed.
    fn call<T>(&self, call: impl FnOnce(Python<'_>, &Bound<'_, PyAny>) -> PyResult<T>) -> Option<T> {
        self.shared.of.call(|py, object| {
            object.setattr("spacing", self.grid.spacing)?;
            call(py, object)
        })
    }

    fn prox_of(&self, py: Python<'_>, object: &Bound<'_, PyAny>, v: &[f32], tau: f32) -> PyResult<Array3<f32>> {
        // Voxels outside the support may be passed as the lowest number: for a filter they are empty.
        let v = v.iter().map(|&v| if v == f32::MIN { 0.0 } else { v }).collect();
        let v = Array3::from_shape_vec(self.grid.shape, v).map_err(|e| crate::errors::broken(py, &e.to_string()))?;
        let found = object.call_method1("prox", (v.into_pyarray(py), tau))?;
        let found: Array3<f32> = self.shared.of.shaped(&found, &self.grid.shape, "prox")?;
        // Else the clip at 0 hides NaN.
        let stray = found.iter().find(|x| !x.is_finite());
        let finite = ensure(stray.is_none(), self.shared.of.name, "prox", stray.unwrap_or(&0.0), "finite numbers");
        finite.or_raise(py)?;
        Ok(found)
    }
}

impl Penalty for On {
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        if !self.shared.has_value {
            return 0.0;
        }
        let x = x.as_standard_layout().into_owned();
        self.call(|py, object| object.call_method1("value", (x.into_pyarray(py),))?.extract()).unwrap_or(0.0)
    }

    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        // With weight 0 the object is not needed.
        let found = if tau == 0.0 { None } else { self.call(|py, object| self.prox_of(py, object, v, tau)) };
        match found.as_ref().and_then(|f| f.as_slice()) {
            Some(found) => {
                let all = u.iter_mut().zip(found).zip(v);
                all.for_each(|((u, x), v)| *u = if *v == f32::MIN { 0.0 } else { x.max(0.0) });
            }
            None => u.iter_mut().zip(v).for_each(|(u, x)| *u = x.max(0.0)),
        }
    }
}
