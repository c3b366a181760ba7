//! A tiny scan and runs on it, from specs in JSON.

use conefield_backend_cpu::Cpu;
use conefield_core::Result;
use conefield_core::arena::Weights;
use conefield_core::backend::Backend;
use conefield_core::checkpoint::{Checkpoint, Resume};
use conefield_core::method::{Context, Job, Observer, Plan, Reconstruction, Record, Solution};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::scan::{Scan, Volume};
use conefield_core::spec::{Spec, load};
use conefield_projectors::simulate::{Protocol, simulate};
use ndarray::Array3;
use serde_json::{Value, json};

// Stage types register themselves where their crate is linked.
use conefield_encoders as _;
use conefield_fields as _;
use conefield_solvers as _;

/// A ball in air with a box inside, 16³ voxels of 10 mm, in 1/mm.
#[allow(dead_code)]
pub fn truth() -> Volume {
    let data = Array3::from_shape_fn((16, 16, 16), |(x, y, z)| {
        let d = [x, y, z].map(|i| i as f32 - 7.5);
        let ball = d.iter().map(|v| v * v).sum::<f32>() < 40.0;
        let inside = (5..9).contains(&x) && (6..11).contains(&y) && (5..10).contains(&z);
        f32::from(u8::from(ball)) * if inside { 0.02 } else { 0.01 }
    });
    Volume::centered(data, [10.0; 3])
}

/// Eight views of it, 16 × 16 pixels.
#[allow(dead_code)]
pub fn scan() -> Scan {
    let protocol: Protocol = serde_json::from_value(json!({
        "dso": 500.0, "dsd": 750.0, "detector": [16, 16], "extent": {"side": [280.0, 280.0]},
        "angles": {"even": {"views": 8}},
    }))
    .unwrap();
    simulate(&truth(), &protocol).unwrap()
}

/// The spec that `value` says, read as a file of it would be.
pub fn spec(value: &Value) -> Result<Spec> {
    Ok(load::parse(&value.to_string(), "test.json", &[], &[])?.spec)
}

/// The plan of `spec`, which reads `weights` where it names any.
#[allow(dead_code)]
pub fn plan(spec: &Spec, backend: &dyn Backend, weights: &Weights) -> Result<Box<dyn Plan>> {
    spec.method.plan(&Context { weights: &|_| Ok(weights.clone()), ..Context::new(backend) })
}

/// The stages of the field of `spec`.
#[allow(dead_code)]
pub fn pipeline(spec: &Spec) -> Pipeline {
    plan(spec, &Cpu::new(), &Weights::default()).unwrap().pipeline().unwrap().clone()
}

/// Keeps what a run says.
#[derive(Default)]
pub struct Heard(pub Vec<Record>);

impl Observer for Heard {
    fn progress(&mut self, _: u64, _: f64, _: f64) {}
    fn record(&mut self, record: &Record) {
        self.0.push(record.clone());
    }
    fn note(&mut self, _: &str) {}
}

/// Stops after a step, with the checkpoint that is kept there.
#[derive(Default)]
pub struct Stop {
    /// The step.
    pub at: u64,
    step: u64,
    /// What an interrupted run goes on from, as it would come back from a file.
    pub kept: Option<Resume>,
    /// Records until then.
    pub heard: Vec<Record>,
}

#[allow(dead_code)]
impl Stop {
    pub fn at(step: u64) -> Self {
        Self { at: step, ..Self::default() }
    }
}

impl Observer for Stop {
    fn progress(&mut self, step: u64, _: f64, _: f64) {
        self.step = step;
    }
    fn record(&mut self, record: &Record) {
        self.heard.push(record.clone());
    }
    fn note(&mut self, _: &str) {}
    fn cancelled(&self) -> bool {
        self.step >= self.at
    }
    fn checkpoint(&mut self, c: &Checkpoint<'_>) -> Result<()> {
        let tensors = c.tensors.iter().map(|(n, s, v)| (n.clone(), (s.to_vec(), v.to_vec()))).collect();
        let weights = Weights { tensors, ..Weights::default() };
        let standing = serde_json::from_str(&serde_json::to_string(&c.standing).unwrap()).unwrap();
        self.kept = Some(Resume::new("kept".into(), standing, weights));
        Ok(())
    }
}

/// A whole run of `value` on `scan`, with the weights file that it may name.
#[allow(dead_code)]
pub fn solve(value: &Value, scan: &Scan, weights: &Weights) -> Result<(Solution, Vec<Record>)> {
    solve_on(&Cpu::new(), value, scan, weights)
}

/// The same on any backend.
pub fn solve_on(
    backend: &dyn Backend,
    value: &Value,
    scan: &Scan,
    weights: &Weights,
) -> Result<(Solution, Vec<Record>)> {
    let spec = spec(value)?;
    let job = Job { seed: 7, ..Job::new(scan, backend) };
    let mut heard = Heard::default();
    let solution = plan(&spec, backend, weights)?.run(&job, &mut heard)?;
    Ok((solution, heard.0))
}

/// A run on [`scan`]: PSNR against [`truth`], and what was recorded.
#[allow(dead_code)]
pub fn psnr(value: &Value, backend: &dyn Backend) -> (f64, Vec<Record>) {
    let (solution, records) = solve_on(backend, value, &scan(), &Weights::default()).unwrap();
    let (found, truth) = (solution.result.volume(backend).unwrap(), truth());
    let square = |(a, b): (&f32, &f32)| (f64::from(*a) - f64::from(*b)).powi(2);
    let mse = found.data.iter().zip(&truth.data).map(square).sum::<f64>() / truth.data.len() as f64;
    (10.0 * (0.02f64.powi(2) / mse).log10(), records)
}

/// The volume of a run.
#[allow(dead_code)]
pub fn volume(solution: &Solution) -> Volume {
    solution.result.volume(&Cpu::new()).unwrap()
}

/// The trained model of a run.
#[allow(dead_code)]
pub fn model(solution: Solution) -> Model {
    match solution.result {
        Reconstruction::Field(field) => field.model,
        _ => panic!("this solver trains no model"),
    }
}
