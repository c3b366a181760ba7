//! A tiny scan and runs on it, from specs in JSON.

use conefield_backend_cpu::Cpu;
use conefield_core::arena::{Arena, Weights};
use conefield_core::backend::{Backend, Executable, Explain, TrainRay};
use conefield_core::checkpoint::{Checkpoint, Resume};
use conefield_core::method::{Context, Job, Observer, Plan, Reconstruction, Record, Solution};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::place::Place;
use conefield_core::random::{mix, unit};
use conefield_core::scan::{Scan, Volume};
use conefield_core::scene::{Scene, SceneSettings};
use conefield_core::simd::Real;
use conefield_core::spec::{Spec, load};
use conefield_core::{Error, Result};
use conefield_projectors::simulate::{Protocol, simulate};
use ndarray::Array3;
use serde_json::{Value, json};
use std::sync::Arc;

// Stage types register themselves where their crate is linked.
use conefield_encoders as _;
use conefield_fields as _;
use conefield_solvers as _;

/// A ball in air with a box inside, 16³ voxels of 10 mm, in 1/mm.
pub fn truth() -> Volume {
    let data = Array3::from_shape_fn((16, 16, 16), |(x, y, z)| {
        let d = [x, y, z].map(|i| i as f32 - 7.5);
        let ball = d.iter().map(|v| v * v).sum::<f32>() < 40.0;
        let inside = (5..9).contains(&x) && (6..11).contains(&y) && (5..10).contains(&z);
        f32::from(u8::from(ball)) * if inside { 0.02 } else { 0.01 }
    });
    Volume::centered(data, [10.0; 3])
}

/// `all` with the keys of `change`, which replace its own.
fn changed(mut all: Value, change: Value) -> Value {
    if let (Some(all), Value::Object(change)) = (all.as_object_mut(), change) {
        all.extend(change);
    }
    all
}

/// Eight views with a detector of 16 × 16 pixels; the keys in `change` replace these.
pub fn protocol(change: Value) -> Protocol {
    let all = json!({
        "dso": 500.0, "dsd": 750.0, "detector": [16, 16], "extent": {"side": [280.0, 280.0]},
        "angles": {"even": {"views": 8}},
    });
    serde_json::from_value(changed(all, change)).unwrap()
}

/// A small field with layers of `width` numbers; the keys in `change` replace these.
pub fn neural_field(width: usize, change: Value) -> Value {
    let all = json!({
        "type": "neural-field", "normalizers": [{"type": "layer-norm"}],
        "encoder": {"type": "hash-grid", "levels": 3, "base_resolution": 3, "log2_table_size": 8},
        "field": {"type": "mlp", "width": width, "depth": 3, "skips": [1]},
        "projector": {"type": "ray-march", "samples": 20},
    });
    changed(all, change)
}

/// Eight views of [`truth`], 16 × 16 pixels.
pub fn scan() -> Scan {
    simulate(&truth(), &protocol(json!({}))).unwrap()
}

/// The spec that `value` says, read as a file of it would be.
pub fn spec(value: &Value) -> Result<Spec> {
    Ok(load::parse(&value.to_string(), "test.json", &[], &[])?.spec)
}

/// The plan of `spec`, which reads `weights` where it names any.
pub fn plan(spec: &Spec, backend: &dyn Backend, weights: &Weights) -> Result<Box<dyn Plan>> {
    spec.method.plan(&Context { weights: &|_| Ok(weights.clone()), ..Context::new(backend) })
}

/// The plan of what `value` says, or why there is none.
pub fn planned(value: &Value, backend: &dyn Backend) -> Result<Box<dyn Plan>> {
    plan(&spec(value)?, backend, &Weights::default())
}

/// The stages of the field of `value`.
pub fn pipeline(value: &Value) -> Pipeline {
    planned(value, &Cpu::new()).unwrap().pipeline().unwrap().clone()
}

/// A model of `pipeline` whose parameters are not where they start.
pub fn moved(pipeline: &Pipeline) -> Model {
    let mut model = Model::random(pipeline.clone(), 3);
    for (i, p) in model.arena.params.iter_mut().enumerate() {
        *p += 0.4 * (unit(mix(5, i as u64)) - 0.5);
    }
    model
}

/// Rays of [`scan`] through pixels of all views.
pub fn rays(count: usize, target: impl Fn(usize) -> f32) -> Vec<TrainRay> {
    let scan = scan();
    let scene = Scene::new(&scan, &SceneSettings::default()).unwrap();
    let ray = |i| scene.pixel_ray(&scan.geometry, i % 8, (i * 5) % 16, (i * 7) % 16);
    (0..count).map(|i| TrainRay { ray: ray(i), target: target(i) }).collect()
}

/// A point of the unit cube.
pub fn point(i: u64) -> [f32; 3] {
    std::array::from_fn(|k| 0.05 + 0.9 * unit(mix(i, k as u64)))
}

/// The CPU whose arrays live in a place.
pub struct In<P>(pub Arc<P>);

impl<P: Place + 'static> Backend for In<P> {
    fn name(&self) -> &'static str {
        "in a place"
    }
    fn compile(&self, pipeline: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        Cpu::new().compile(pipeline)
    }
    fn place(&self) -> Arc<dyn Place> {
        self.0.clone()
    }
}

/// Keeps what a run says, and may stop it.
pub struct Heard {
    /// The step after which it stops.
    at: u64,
    step: u64,
    /// What an interrupted run goes on from, as it would come back from a file.
    pub kept: Option<Resume>,
    pub records: Vec<Record>,
    pub notes: Vec<String>,
}

impl Default for Heard {
    fn default() -> Self {
        Self::until(u64::MAX)
    }
}

impl Heard {
    /// Stops the run after step `at`.
    pub fn until(at: u64) -> Self {
        Self { at, step: 0, kept: None, records: vec![], notes: vec![] }
    }
}

impl Observer for Heard {
    fn progress(&mut self, step: u64, _: f64, _: f64) {
        self.step = step;
    }
    fn record(&mut self, record: &Record) {
        self.records.push(record.clone());
    }
    fn note(&mut self, text: &str) {
        self.notes.push(text.into());
    }
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

/// Interrupts a run after each of `steps`, which may depend on the outcome of the run in one piece, and lets it go on: it
/// comes to the same outcome by the same records. Returns both.
pub fn goes_on<T: PartialEq>(
    plan: &mut dyn Plan,
    job: &Job<'_>,
    steps: impl Fn(&T) -> Vec<u64>,
    outcome: impl Fn(Result<Solution>) -> T,
) -> (T, Vec<Record>) {
    let mut run = |resume: Option<&Resume>, at| {
        let mut heard = Heard::until(at);
        (plan.run(&Job { resume, ..*job }, &mut heard), heard)
    };
    let (whole, heard) = run(None, u64::MAX);
    let whole = outcome(whole);
    // As text, in which NaN equals NaN.
    let said = |records: &[Record]| -> Vec<String> {
        records.iter().map(|r| format!("{:?}", (r.step, r.loss, r.held_out, &r.drift, &r.events))).collect()
    };
    for at in steps(&whole) {
        let (stopped, first) = run(None, at);
        assert!(matches!(stopped, Err(Error::Interrupted { .. })), "interrupted after step {at}");
        let kept = first.kept.unwrap_or_else(|| panic!("no checkpoint after step {at}"));
        let (again, second) = run(Some(&kept), u64::MAX);
        assert!(outcome(again) == whole, "interrupted after step {at}");
        assert_eq!([said(&first.records), said(&second.records)].concat(), said(&heard.records), "after step {at}");
    }
    (whole, heard.records)
}

/// A whole run of `value` on `scan`, and what was recorded.
pub fn solve(value: &Value, scan: &Scan) -> Result<(Solution, Vec<Record>)> {
    solve_on(&Cpu::new(), value, scan)
}

/// The same on any backend.
pub fn solve_on(backend: &dyn Backend, value: &Value, scan: &Scan) -> Result<(Solution, Vec<Record>)> {
    run(planned(value, backend)?.as_mut(), scan, backend)
}

/// The same with the weights file that `value` names.
pub fn solve_from(weights: &Weights, value: &Value, scan: &Scan) -> Result<(Solution, Vec<Record>)> {
    let backend = Cpu::new();
    run(plan(&spec(value)?, &backend, weights)?.as_mut(), scan, &backend)
}

fn run(plan: &mut dyn Plan, scan: &Scan, backend: &dyn Backend) -> Result<(Solution, Vec<Record>)> {
    let mut heard = Heard::default();
    let solution = plan.run(&Job { seed: 7, ..Job::new(scan, backend) }, &mut heard)?;
    Ok((solution, heard.records))
}

/// The voxels that a run of `value` on `scan` ends with.
pub fn voxels(backend: &dyn Backend, value: &Value, scan: &Scan) -> Result<Array3<f32>> {
    let (solution, _) = solve_on(backend, value, scan)?;
    Ok(solution.result.volume(backend)?.data)
}

/// PSNR of `scale` times these voxels against [`truth`], in dB.
pub fn decibels(found: &Array3<f32>, scale: f64) -> f64 {
    let truth = truth().data;
    let square = |(a, b): (&f32, &f32)| (f64::from(*a) * scale - f64::from(*b)).powi(2);
    let mse = found.iter().zip(&truth).map(square).sum::<f64>() / truth.len() as f64;
    10.0 * (0.02f64.powi(2) / mse).log10()
}

/// A run on [`scan`]: PSNR against [`truth`], and what was recorded.
pub fn psnr(value: &Value, backend: &dyn Backend) -> (f64, Vec<Record>) {
    let (solution, records) = solve_on(backend, value, &scan()).unwrap();
    (decibels(&solution.result.volume(backend).unwrap().data, 1.0), records)
}

/// Largest difference as a share of the largest number wanted; infinite where one is NaN.
pub fn apart<'a, R: Real>(
    found: impl IntoIterator<Item = &'a f32>,
    wanted: impl IntoIterator<Item = &'a R, IntoIter: Clone>,
) -> f64 {
    let wanted = wanted.into_iter();
    let top = wanted.clone().fold(1e-300f64, |m, v| m.max(v.f64().abs()));
    let off = found.into_iter().zip(wanted).map(|(a, b)| (f64::from(*a) - b.f64()).abs() / top);
    off.fold(0.0, |m, e| if e.is_nan() { f64::INFINITY } else { m.max(e) })
}

/// The volume of a run.
pub fn volume(solution: &Solution) -> Volume {
    solution.result.volume(&Cpu::new()).unwrap()
}

/// The trained model of a run.
pub fn model(solution: Solution) -> Model {
    match solution.result {
        Reconstruction::Field(field) => field.model,
        _ => panic!("this solver trains no model"),
    }
}

pub fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

/// The bits of parameters and moments.
pub fn state(arena: &Arena) -> Vec<u32> {
    [&arena.params, &arena.first, &arena.second].into_iter().flat_map(|part| bits(part)).collect()
}
