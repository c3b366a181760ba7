//! An encoder implemented by a Python object.
//!
//! The GIL is acquired once per batch of rows, and batches are processed one at a time: this is for prototyping, not
//! for speed.

use crate::errors::{broken, raised};
use crate::stages::{StageObject, array, optional};
use conefield_core::error::ensure;
use conefield_core::simd::Real;
use conefield_core::stage::{
    Backward, Encoder, GradKind, Info, Kernel, Parameter, Reduced, Scope, Stage, Tile, TileMut,
};
use conefield_core::{Error, Result};
use ndarray::{Array1, Array2, ArrayD};
use numpy::{Element, IntoPyArray};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use std::sync::Arc;

/// Number of coordinates of a point.
const INPUT: usize = 3;

/// State shared by all encoders of one object.
struct Shared {
    of: StageObject,
    blocks: Vec<Parameter>,
    /// Initial parameters.
    first: Vec<f32>,
    /// Output channels.
    width: usize,
    /// Whether it computes in double precision for double-precision inputs.
    double: bool,
    coarse_to_fine: bool,
    resolutions: Option<Vec<f64>>,
}

/// An encoder of a Python object, possibly without some of its channels.
pub struct PythonEncoder {
    shared: Arc<Shared>,
    /// Output channels of the object that are used.
    outputs: Vec<usize>,
}

impl PythonEncoder {
    /// Calls the object on a few points to find its widths. The outer error is an exception of the object.
    pub fn new(py: Python<'_>, of: StageObject) -> PyResult<Result<Self>> {
        let own = &of.object.bind(py).clone();
        let mut shared = Shared {
            of,
            blocks: vec![],
            first: vec![],
            width: 0,
            double: false,
            coarse_to_fine: optional(own, "coarse_to_fine")?.unwrap_or(false),
            resolutions: optional(own, "resolutions")?,
        };
        if let Some(params) = optional::<Bound<'_, PyDict>>(own, "params")? {
            for (key, value) in params.iter() {
                let value = array::<f32>(&value)?;
                let (name, start) = (key.extract()?, shared.first.len());
                shared.blocks.push(Parameter { name, shape: value.shape().to_vec(), start });
                shared.first.extend(value.iter());
            }
        }
        if let Some(i) = shared.first.iter().position(|x| !x.is_finite()) {
            let found = format!("{} at {i}", shared.first[i]);
            return Ok(Err(Error::invalid("spec", "params", found, "finite first values")));
        }
        let points = [0.1, 0.4, 0.7, 0.2, 0.5, 0.8, 0.3, 0.6, 0.9];
        let y = shared.forward_as_is(py, &shared.wide(), Tile::new(&points, 3))?;
        let shape: Vec<usize> = y.getattr("shape")?.extract()?;
        let expected = "[rows, channels], with the rows of the points and at least one channel";
        if let Err(e) = ensure(
            shape.len() == 2 && shape[0] == 3 && shape[1] > 0,
            "spec",
            "forward",
            format!("an array of shape {shape:?} for 3 points"),
            expected,
        ) {
            return Ok(Err(e));
        }
        let width = shape[1];
        let cells = shared.resolutions.as_ref().map_or(width, Vec::len);
        if let Err(e) = ensure(cells == width, "spec", "resolutions", cells, format!("{width}, one for each channel")) {
            return Ok(Err(e));
        }
        shared.width = width;
        shared.double = y.getattr("dtype")?.getattr("name")?.extract::<String>()? == "float64";
        let outputs = (0..width).collect();
        Ok(Ok(Self { shared: Arc::new(shared), outputs }))
    }
}

/// Channels of rows in Python's layout: `[row, channel]`.
fn rows<'py, R: Real + Element>(py: Python<'py>, tile: Tile<'_, R>) -> PyResult<Bound<'py, PyAny>> {
    let channels = Array2::from_shape_vec((tile.width(), tile.rows), tile.data.to_vec());
    let channels = channels.map_err(|e| broken(py, &e.to_string()))?;
    Ok(channels.reversed_axes().as_standard_layout().into_owned().into_pyarray(py).into_any())
}

impl Shared {
    /// The initial parameters in double precision.
    fn wide(&self) -> Vec<f64> {
        self.first.iter().map(|&x| f64::from(x)).collect()
    }

    /// Sets the parameters on the object.
    fn set<R: Real + Element>(&self, py: Python<'_>, params: &[R]) -> PyResult<()> {
        if self.blocks.is_empty() {
            return Ok(());
        }
        let all = PyDict::new(py);
        for block in &self.blocks {
            let flat = Array1::from(params[block.range()].to_vec()).into_pyarray(py);
            all.set_item(&block.name, flat.call_method1("reshape", (PyTuple::new(py, &block.shape)?,))?)?;
        }
        self.of.object.setattr(py, "params", all)
    }

    fn forward_as_is<'py, R: Real + Element>(
        &self,
        py: Python<'py>,
        params: &[R],
        x: Tile<'_, R>,
    ) -> PyResult<Bound<'py, PyAny>> {
        self.set(py, params)?;
        self.of.object.bind(py).call_method1("forward", (rows(py, x)?,))
    }

    /// `[row, channel]` for all of the object's channels.
    fn forward<R: Real + Element>(&self, py: Python<'_>, params: &[R], x: Tile<'_, R>) -> PyResult<Array2<R>> {
        let y = self.forward_as_is(py, params, x)?;
        self.of.shaped(&y, &[x.rows, self.width], "forward")
    }

    /// `∂L/∂x`, `[row, 3]`, and the gradients of all parameters, concatenated.
    fn backward<R: Real + Element>(
        &self,
        py: Python<'_>,
        params: &[R],
        x: Tile<'_, R>,
        dy: Array2<R>,
    ) -> PyResult<(Array2<R>, Vec<R>)> {
        self.set(py, params)?;
        let dy = dy.into_pyarray(py);
        let found = self.of.object.bind(py).call_method1("backward", (rows(py, x)?, dy))?;
        let (dx, grads): (Bound<'_, PyAny>, Bound<'_, PyAny>) = found.extract()?;
        let dx = self.of.shaped(&dx, &[x.rows, INPUT], "backward")?;
        let mut all = vec![];
        for block in &self.blocks {
            let grad: ArrayD<R> = array(&grads.get_item(&block.name)?)?;
            if grad.shape() != block.shape {
                let what = format!("gradients of {} of shape {:?}", block.name, grad.shape());
                let wrong = Error::invalid(self.of.name, "backward", what, format!("{:?}", block.shape));
                return Err(raised(py, &wrong));
            }
            all.extend(grad);
        }
        Ok((dx, all))
    }
}

impl<R: Real + Element> Kernel<R> for PythonEncoder {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
        let Some(found) = self.shared.of.call(|py, _| self.shared.forward(py, params, x)) else {
            return y.data.fill(R::ZERO);
        };
        for (c, &place) in self.outputs.iter().enumerate() {
            let channel = &mut y.data[c * x.rows..(c + 1) * x.rows];
            channel.iter_mut().zip(found.column(place)).for_each(|(y, found)| *y = *found);
        }
    }

    fn backward(&self, Backward { params, x, dy, grads, dx, .. }: Backward<'_, R>) {
        let mut whole = Array2::from_elem((x.rows, self.shared.width), R::ZERO);
        for (c, &place) in self.outputs.iter().enumerate() {
            whole.column_mut(place).iter_mut().zip(dy.channel(c)).for_each(|(to, d)| *to = *d);
        }
        let Some((found, all)) = self.shared.of.call(|py, _| self.shared.backward(py, params, x, whole)) else {
            return dx.into_iter().for_each(|dx| dx.data.fill(R::ZERO));
        };
        grads.values.iter_mut().zip(&all[grads.range]).for_each(|(sum, g)| *sum += *g);
        if let Some(dx) = dx {
            for c in 0..INPUT {
                let channel = &mut dx.data[c * x.rows..(c + 1) * x.rows];
                channel.iter_mut().zip(found.column(c)).for_each(|(dx, found)| *dx = *found);
            }
        }
    }
}

impl Stage for PythonEncoder {
    fn info(&self) -> Info {
        let (output, params) = (self.outputs.len(), self.shared.first.len());
        let grads = if params == 0 { GradKind::None } else { GradKind::Dense };
        let macs = INPUT * output;
        Info { input: INPUT, output, params, tape: 0, scope: Scope::Row, grads, macs, identity: false }
    }

    fn parameters(&self) -> Vec<Parameter> {
        self.shared.blocks.clone()
    }

    fn init(&self, _: u64, params: &mut [f32]) {
        params.copy_from_slice(&self.shared.first);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        self.shared.double.then_some(self)
    }

    fn fault(&self) -> Result<()> {
        self.shared.of.fault()
    }

    fn describe(&self) -> String {
        let (kept, all) = (self.outputs.len(), self.shared.width);
        let of = if kept == all { String::new() } else { format!(" of {all}") };
        format!("{}: written in Python, {kept}{of} channels", self.shared.of.name)
    }
}

impl Encoder for PythonEncoder {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        let outputs = keep.iter().map(|&c| self.outputs[c]).collect();
        let stage = Self { shared: self.shared.clone(), outputs };
        Ok(Reduced { stage: Box::new(stage), params: vec![0..self.shared.first.len()], channels: (0..INPUT).collect() })
    }

    fn coarse_to_fine(&self) -> bool {
        self.shared.coarse_to_fine
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        let all = self.shared.resolutions.as_ref()?;
        Some(self.outputs.iter().map(|&c| all[c]).collect())
    }
}
