//! Errors of single against double precision, stage by stage and of whole steps, as inputs and sizes grow.
//!
//! Both get the same numbers, exact in single precision. The differences come from the rounding of the work itself.

use crate::common::{apart, moved, pipeline, scan};
use crate::page;
use conefield_backend_cpu::rows::Kernels;
use conefield_backend_cpu::step::Slots;
use conefield_core::backend::{TrainRay, Work};
use conefield_core::random::{mix, unit};
use conefield_core::scene::{Scene, SceneSettings};
use conefield_core::settings::{EncoderSpec, FieldSpec, NormalizerSpec};
use conefield_core::simd::Real;
use conefield_core::stage::{Backward, Grads, Kernel, Stage, Tile, TileMut};
use conefield_evaluation::report::{CurveOptions, curves_png};
use conefield_solvers::losses::L2;
use serde_json::{Value, json};
use std::ops::Range;

/// A stage with data for it.
pub struct Pair<'a> {
    stage: &'a dyn Stage,
    params: Vec<f32>,
    x: Vec<f32>,
    dy: Vec<f32>,
    rows: usize,
}

/// How far single precision is from double.
pub struct Errors {
    pub outputs: f64,
    pub params: f64,
    pub inputs: f64,
    pub finite: bool,
}

impl<'a> Pair<'a> {
    /// Inputs from `inputs`, parameters from ± `params` or as the stage starts.
    pub fn new(stage: &'a dyn Stage, params: Option<f64>, inputs: Range<f64>, rows: usize, seed: u64) -> Self {
        let info = stage.info();
        let draw = |stream: u64, i: usize| f64::from(unit(mix(seed + stream, i as u64)));
        let mut own = vec![0.0; info.params];
        stage.init(seed, &mut own);
        if let Some(range) = params {
            own.iter_mut().enumerate().for_each(|(i, p)| *p = (range * (2.0 * draw(1, i) - 1.0)) as f32);
        }
        let within = |i| (inputs.start + (inputs.end - inputs.start) * draw(2, i)) as f32;
        let x = (0..info.input * rows).map(within).collect();
        let dy = (0..info.output * rows).map(|i| (2.0 * draw(3, i) - 1.0) as f32).collect();
        Self { stage, params: own, x, dy, rows }
    }

    /// The same with these inputs.
    pub fn at(self, x: Vec<f32>) -> Self {
        Self { x, ..self }
    }

    pub fn errors(&self) -> Errors {
        let exact = self.stage.reference().expect("every built-in stage has one");
        let [y, g, dx] = self.work(self.stage.kernel());
        let [y64, g64, dx64] = self.work(exact);
        let finite = [&y, &g, &dx].into_iter().flatten().all(|v| v.is_finite());
        Errors { outputs: apart(&y, &y64), params: apart(&g, &g64), inputs: apart(&dx, &dx64), finite }
    }

    /// Outputs, gradients of parameters, gradients of inputs.
    fn work<R: Real>(&self, kernel: &dyn Kernel<R>) -> [Vec<R>; 3] {
        let (info, n) = (self.stage.info(), self.rows);
        let wide = |v: &[f32]| v.iter().map(|x| R::of(f64::from(*x))).collect::<Vec<R>>();
        let (p, x, dy) = (wide(&self.params), wide(&self.x), wide(&self.dy));
        let zeros = |n: usize| vec![R::ZERO; n];
        let (mut y, mut tape) = (zeros(info.output * n), zeros(info.tape * n));
        let (mut g, mut dx) = (zeros(info.params), zeros(info.input * n));
        kernel.forward(&p, Tile::new(&x, n), TileMut::new(&mut y, n), TileMut::new(&mut tape, n));
        let grads = Grads { values: &mut g, range: 0..info.params };
        let (tape, to) = (TileMut::new(&mut tape, n), Some(TileMut::new(&mut dx, n)));
        kernel.backward(Backward { params: &p, x: Tile::new(&x, n), tape, dy: Tile::new(&dy, n), grads, dx: to });
        [y, g, dx]
    }
}

fn encoder(value: Value) -> Box<dyn EncoderSpec> {
    serde_json::from_value(value).unwrap()
}

/// Rows of the table: the stage, its inputs, the errors, and what outputs may have at most.
fn stages() -> Vec<(String, String, Errors, f64)> {
    let mut all = vec![];
    let mut add = |name: &str, stage: &dyn Stage, params: Option<f64>, size: f64, inputs: Range<f64>, limit: f64| {
        let errors = Pair::new(stage, params, inputs.clone(), 400, 11).errors();
        let weights = params.map_or("as they start".to_owned(), |p| format!("to ± {p:e}"));
        let said = format!("{:e} to {:e}, parameters {weights}", inputs.start, inputs.end);
        all.push((name.to_owned(), said, errors, limit * size));
    };
    for cells in [16u32, 256, 4096, 65_536] {
        let s = encoder(json!({"type": "hash-grid", "levels": 1, "base_resolution": cells, "log2_table_size": 12}));
        let s = s.build().unwrap();
        add(&format!("hash-grid, {cells} cells"), s.as_ref(), Some(1.0), 1.0, 0.0..1.0, 1e-6 + 4e-7 * f64::from(cells));
    }
    let s = encoder(json!({"type": "hash-grid", "levels": 1, "log2_table_size": 12})).build().unwrap();
    for size in [1e-30, 1e30] {
        add("hash-grid, 16 cells", s.as_ref(), Some(size), 1.0, 0.0..1.0, 1e-5);
    }
    let s = encoder(json!({"type": "dense-grid", "levels": 2, "base_resolution": 30})).build().unwrap();
    add("dense-grid, 60 cells", s.as_ref(), Some(1.0), 1.0, 0.0..1.0, 2e-5);
    for top in [1.0, 32.0, 1024.0] {
        let s = encoder(json!({"type": "frequency", "bands": 6, "max_frequency": top})).build().unwrap();
        add(&format!("frequency to {top}"), s.as_ref(), None, top, 0.0..1.0, 2e-6);
    }
    let norm: Box<dyn NormalizerSpec> = serde_json::from_value(json!({"type": "layer-norm"})).unwrap();
    let norm = norm.build(20).unwrap();
    for inputs in [-1e-30..1e-30, -1e-4..1e-4, -1.0..1.0, 999.0..1001.0, -1e30..1e30] {
        // The rounding of the mean is relative to the inputs; without the mean, 2 in 1000 of them remain.
        let limit = if inputs.start > 0.0 { 1e-3 } else { 1e-5 };
        add("layer-norm, 20 channels", norm.as_ref(), None, 1.0, inputs, limit);
    }
    for (width, depth) in [(32, 4), (256, 4), (32, 16)] {
        let s: Box<dyn FieldSpec> =
            serde_json::from_value(json!({"type": "mlp", "width": width, "depth": depth, "skips": [2]})).unwrap();
        let s = s.build(20).unwrap();
        for inputs in [-1e-30..1e-30, -2.0..2.0, -1e4..1e4] {
            add(&format!("mlp, {depth} layers of {width}"), s.as_ref(), None, 1.0, inputs, 2e-5);
        }
    }
    let s: Box<dyn FieldSpec> = serde_json::from_value(json!({"type": "voxel-grid", "resolution": 70})).unwrap();
    add("voxel-grid, 70 cells", s.build(3).unwrap().as_ref(), None, 1.0, 0.0..1.0, 4e-5);
    all
}

/// Errors of loss and gradients of a step with this number of rays and samples.
fn step(rays: usize, samples: usize) -> [f64; 2] {
    let mut value = crate::scans::field();
    value["projector"]["samples"] = json!(samples);
    let pipeline = pipeline(&value);
    let scan = scan();
    let scene = Scene::new(&scan, &SceneSettings::default()).unwrap();
    let rays: Vec<TrainRay> = (0..rays)
        .map(|i| {
            let ray = scene.pixel_ray(&scan.geometry, i % 8, 4 + (i * 5) % 8, 4 + (i * 3) % 8);
            TrainRay { ray, target: 0.05 + 0.2 * unit(mix(4, i as u64)) }
        })
        .collect();
    let params = moved(&pipeline).arena.params;
    let exact: Vec<f64> = params.iter().map(|p| f64::from(*p)).collect();
    let work = Work { step: 4, seed: 9, loss: &L2 {}, rays: &rays, points: &[], priors: &[] };
    let single = Kernels::new(&pipeline, |s| s.kernel());
    let double = Kernels::new(&pipeline, |s| s.reference().unwrap());
    let (mut g, mut g64) = (vec![0.0f32; params.len()], vec![0.0f64; params.len()]);
    let projector = pipeline.projector.as_ref();
    let found = Slots::new(&single).step(&single, projector, &params, &mut g, &work);
    let want = Slots::new(&double).step(&double, projector, &exact, &mut g64, &work);
    [(found.loss - want.loss).abs() / want.loss, apart(&g, &g64)]
}

/// A share, or that there is none: nothing to be off.
fn cell(e: f64) -> String {
    if e == 0.0 { "-".into() } else { format!("{e:.1e}") }
}

pub fn check() {
    let mut text = String::from(
        "\n| Stage | Inputs | Outputs | Gradients of parameters | of inputs |\n| --- | --- | --- | --- | --- |\n",
    );
    let mut faults = vec![];
    let mut row = |cells: [String; 5]| text += &format!("| {} |\n", cells.map(|c| page::escaped(&c)).join(" | "));
    for (name, inputs, e, limit) in stages() {
        if !e.finite || e.outputs > limit {
            faults.push(format!("{name} of {inputs}: {:.1e}, limit {limit:.1e}, finite {}", e.outputs, e.finite));
        }
        row([name, inputs, cell(e.outputs), cell(e.params), cell(e.inputs)]);
    }
    let mut curves = vec![("loss of a step".to_owned(), vec![]), ("gradients of a step".to_owned(), vec![])];
    for (rays, samples) in [(1, 1), (8, 8), (64, 20), (64, 256), (512, 256)] {
        let [loss, gradients] = step(rays, samples);
        if loss > 1e-5 || gradients > 1e-4 {
            faults.push(format!("a step of {rays} rays: loss {loss:.1e}, gradients {gradients:.1e}"));
        }
        let n = (rays * samples) as f64;
        // A logarithmic axis has no 0.
        curves[0].1.push((n, loss.max(1e-9)));
        curves[1].1.push((n, gradients.max(1e-9)));
        row([
            format!("a whole step, {rays} × {samples} samples"),
            "as trained".into(),
            cell(loss),
            cell(gradients),
            "-".into(),
        ]);
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    let of = |name: &str, values: Vec<(f64, f64)>| (name.to_owned(), values);
    let grid = |cells: u32| {
        let s = encoder(json!({"type": "hash-grid", "levels": 1, "base_resolution": cells, "log2_table_size": 12}));
        Pair::new(s.build().unwrap().as_ref(), Some(1.0), 0.0..1.0, 400, 11).errors().outputs
    };
    let frequency = |top: f64| {
        let s = encoder(json!({"type": "frequency", "bands": 2, "max_frequency": top}));
        Pair::new(s.build().unwrap().as_ref(), None, 0.0..1.0, 400, 11).errors().outputs
    };
    curves.push(of("hash grid, by cells a side", (1..=20).map(|k| (2f64.powi(k), grid(1 << k))).collect()));
    curves.push(of("frequency, by turns a side", (0..=10).map(|k| (2f64.powi(k), frequency(2f64.powi(k)))).collect()));
    if page::blessing() {
        let options = CurveOptions { log_x: true, log_y: true, ..CurveOptions::default() };
        let title = "Single against double precision";
        let labels = ["samples of a step, cells or turns a side", "error over the largest value"];
        curves_png(page::picture(), title, labels, &curves, &options).unwrap();
    }
    page::keep("growth", &text);
}
