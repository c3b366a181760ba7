//! Iterative solvers on voxels: one driver, and a [`Method`] each.
//!
//! A step is one pass over all views. After each the driver reports, checkpoints, and looks at what ends the run.

pub mod algebraic;
pub mod asd_pocs;
pub mod cgls;
pub mod fista_tv;
pub mod noise;
pub mod order;
pub mod tv;
pub mod watch;

use crate::fit::support;
use crate::schedule::{Clock, Ends};
use crate::shadow::{air_level, shadow};
use crate::surround::Within;
use conefield_core::Error;
use conefield_core::checkpoint::{Checkpoint, Resume, Standing};
use conefield_core::error::{Result, ensure};
use conefield_core::scan::{Scan, Volume};
use conefield_core::solver::{Best, Job, Observer, Reconstruction, Record, Solution};
use conefield_core::spec::{SceneSettings, Spec, SupportRule, VolumeStart};
use conefield_core::voxel::{VoxelOperator, VoxelProjector};
use ndarray::{Array2, Array3, Axis, Zip};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;
use watch::{Watch, difference_square_sum, square_sum};

/// When an iterative solver ends, whichever comes first.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Stop {
    /// After this many passes over the views.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub passes: Option<u64>,
    /// After this many seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// When a pass changes the volume by less than this share of it, both in root mean square.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change: Option<f64>,
    /// When the held-out views' error has not fallen for this many passes; the best volume is kept.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub patience: Option<u64>,
}

impl Stop {
    /// Refuses a run without an end.
    pub fn validate(&self) -> Result<()> {
        let ends = self.passes.is_some() || self.seconds.is_some() || self.change.is_some();
        ensure(ends, "spec", "solver.stop", "no end", "one of passes, seconds or change")?;
        for (name, limit) in [("change", self.change), ("seconds", self.seconds)] {
            if let Some(x) = limit {
                let field = format!("solver.stop.{name}");
                ensure(x.is_finite() && x > 0.0, "spec", &field, x, "a positive finite number")?;
            }
        }
        ensure(self.patience != Some(0), "spec", "solver.stop.patience", 0, "at least 1")
    }

    /// See [`conefield_core::solver::Solver::needs_held_out`].
    fn needs_held_out(&self) -> Option<&'static str> {
        self.patience.map(|_| "solver.stop.patience")
    }

    /// Bytes of the volume that [`drive`] keeps for `patience`.
    fn kept(&self, voxels: u64) -> u64 {
        if self.patience.is_some() { 4 * voxels } else { 0 }
    }
}

/// Pixels by which an object's shadow is widened before what is left counts as air.
const MARGIN: usize = 4;

/// A scan and the operator that models it.
pub struct Problem<'a> {
    /// What was measured.
    pub scan: &'a Scan,
    /// The system matrix.
    pub operator: &'a dyn VoxelOperator<f32>,
    /// Seed of everything random.
    pub seed: u64,
    /// The voxels that may be other than 0, if not all.
    inside: Option<&'a Array3<bool>>,
    /// Where each view shows the object, if the other pixels are to count as 0.
    shadow: Option<Vec<Array2<bool>>>,
}

impl<'a> Problem<'a> {
    /// Takes pixels outside the object's shadow for 0.
    pub fn clear_air(&mut self) {
        let level = air_level(self.scan);
        let views = self.scan.projections.outer_iter().into_par_iter();
        self.shadow = Some(views.map(|view| shadow(view, level, MARGIN)).collect());
    }

    /// Share of the pixels that [`Problem::clear_air`] found outside the shadow.
    pub fn air_share(&self) -> f64 {
        let Some(shadows) = &self.shadow else { return 0.0 };
        let inside: usize = shadows.iter().map(|s| s.iter().filter(|x| **x).count()).sum();
        1.0 - inside as f64 / self.scan.projections.len().max(1) as f64
    }

    /// `A·x` for some views.
    pub fn forward(&self, views: &[usize], x: &Array3<f32>) -> Array3<f32> {
        let [rows, columns] = self.scan.geometry.detector;
        let mut out = Array3::zeros((views.len(), rows, columns));
        self.operator.forward(&self.scan.geometry, views, x.view(), out.view_mut());
        out
    }

    /// `p − A·x` for some views, with p 0 in air if that is asked for.
    pub fn residual(&self, views: &[usize], x: &Array3<f32>) -> Array3<f32> {
        let mut out = self.forward(views, x);
        for (mut image, &v) in out.axis_iter_mut(Axis(0)).zip(views) {
            match &self.shadow {
                None => image.zip_mut_with(&self.scan.view(v), |a, p| *a = p - *a),
                Some(shadow) => Zip::from(&mut image)
                    .and(self.scan.view(v))
                    .and(&shadow[v])
                    .for_each(|a, p, inside| *a = if *inside { p - *a } else { -*a }),
            }
        }
        out
    }

    /// Overwrites `out` with `Aᵀ·y` of some views: 0 where no object can be, so that what starts at 0 there stays.
    pub fn back(&self, views: &[usize], y: &Array3<f32>, out: &mut Array3<f32>) {
        out.fill(0.0);
        self.operator.adjoint(&self.scan.geometry, views, y.view(), out.view_mut());
        self.outside(out, 0.0);
    }

    /// Sets the voxels in which no object can be to `value`.
    pub fn outside(&self, x: &mut Array3<f32>, value: f32) {
        if let Some(inside) = self.inside {
            Zip::from(x).and(inside).par_for_each(|x, inside| *x = if *inside { *x } else { value });
        }
    }

    /// Every view.
    pub fn views(&self) -> Vec<usize> {
        (0..self.scan.geometry.views.len()).collect()
    }

    /// Voxels of 0.
    pub fn zeros(&self) -> Array3<f32> {
        Array3::zeros(self.scan.geometry.volume.shape)
    }

    /// Voxels of 1 where the object can be, and of 0 elsewhere.
    pub fn ones(&self) -> Array3<f32> {
        let mut ones = Array3::ones(self.scan.geometry.volume.shape);
        self.outside(&mut ones, 0.0);
        ones
    }

    /// The volume to start from, in 1/mm: what the initializer of the job's spec brings, or 0.
    pub fn start(&self, job: &Job<'_>) -> Result<Array3<f32>> {
        let Some(start) = start_of(job.spec)? else { return Ok(self.zeros()) };
        let data = start_volume(job, &start.path)?.data;
        let mut x = if data.is_standard_layout() { data } else { data.as_standard_layout().into_owned() };
        self.outside(&mut x, 0.0);
        Ok(x)
    }
}

/// What a pass came to.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pass {
    /// `‖p − A·x‖²` of the volumes that the pass met, each view once.
    pub residual: f64,
    /// Root mean square change of the volume over its root mean square, where the method knows it.
    pub change: Option<f64>,
    /// The value of the prior, where there is one.
    pub prior: Option<f64>,
}

/// What changes from pass to pass.
pub trait Method {
    /// Goes through all views once. `pass` counts from 0.
    fn pass(&mut self, problem: &Problem<'_>, pass: u64) -> Result<Pass>;

    /// The volume as it stands, in 1/mm.
    fn volume(&self) -> &Array3<f32>;

    /// The volume, which the method needs no more.
    fn take(&mut self) -> Array3<f32>;

    /// All that the next pass depends on, by name, for checkpoints.
    fn state(&mut self) -> Vec<(&'static str, &mut [f32])>;

    /// Numbers that belong to the state.
    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![]
    }
}

/// Bytes that knowing where the object can be takes, of a volume of so many `voxels`.
pub fn memory(settings: &SceneSettings, voxels: u64) -> u64 {
    match settings.support {
        SupportRule::Box => 0,
        SupportRule::Carve => voxels,
    }
}

/// What a job on voxels begins with.
pub(crate) struct Opened {
    projector: Box<dyn VoxelProjector>,
    /// The voxels that the object can be in, where that is known.
    inside: Option<Array3<bool>>,
    /// The scan without what lies beyond the volume.
    within: Option<Within>,
}

impl Opened {
    /// Refuses a scan that makes no sense, says what solves it and how, and finds out where the object is.
    pub(crate) fn of(solver: &str, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Self> {
        job.scan.validate("scan")?;
        let g = &job.scan.geometry;
        let (bounds, [rows, columns]) = (g.volume.bounds(), g.detector);
        let meets = |v, p: usize| g.ray(v, p / columns, p % columns).clip(bounds).is_some();
        let met = (0..g.views.len()).any(|v| (0..rows * columns).any(|p| meets(v, p)));
        ensure(met, "scan", "geometry", "rays that all miss the volume", "rays through the volume")?;
        let projector = job.backend.place(projector_of(job.spec)?)?;
        observer.note(&format!("{solver}; {}", projector.describe()));
        // By the views as they were measured: what is taken off them afterwards is known too coarsely to carve by.
        let (support, said) = support(job.scan, &job.spec.scene);
        said.iter().for_each(|line| observer.note(line));
        let inside = support.map(|support| {
            let mut inside = Array3::from_elem(g.volume.shape, false);
            Zip::indexed(&mut inside).par_for_each(|(x, y, z), i| *i = support.holds(g.volume.voxel([x, y, z])));
            inside
        });
        Ok(Self { projector, inside, within: Within::of(job, observer)? })
    }

    /// The job on what is inside the volume.
    pub(crate) fn job<'a>(&'a self, job: &Job<'a>) -> Job<'a> {
        Within::job(self.within.as_ref(), job)
    }

    /// Its problem, with every pixel as it was measured.
    pub(crate) fn problem<'a>(&'a self, job: &Job<'a>) -> Problem<'a> {
        let (operator, inside) = (self.projector.operator(), self.inside.as_ref());
        Problem { scan: job.scan, operator, seed: job.seed, inside, shadow: None }
    }
}

/// The voxel projector of a spec: Joseph's where it names none. Refuses a spec with stages of a field.
fn projector_of(spec: &Spec) -> Result<Box<dyn VoxelProjector>> {
    voxels_only(spec)?;
    match &spec.projector {
        Some(p) => p.build_voxel(),
        None => Ok(Box::new(conefield_projectors::voxel::Joseph {})),
    }
}

/// Refuses what no solver here takes.
pub(crate) fn refuse_others(spec: &Spec) -> Result<()> {
    projector_of(spec)?;
    start_of(spec).map(drop)
}

/// Refuses stages that only a field has.
pub fn voxels_only(spec: &Spec) -> Result<()> {
    let stages = [
        ("encoder", spec.encoder.is_some()),
        ("normalizers", !spec.normalizers.is_empty()),
        ("field", spec.field.is_some()),
    ];
    for (stage, there) in stages {
        let solver = spec.solver.typetag_name();
        ensure(!there, "spec", stage, "a stage of a field", format!("none: {solver} reconstructs voxels"))?;
    }
    Ok(())
}

/// What the spec's initializer brings. Refuses one that fills weights.
fn start_of(spec: &Spec) -> Result<Option<VolumeStart>> {
    let Some(initializer) = &spec.initializer else { return Ok(None) };
    let start = initializer.volume()?;
    let found = format!("{:?}, which fills weights", initializer.typetag_name());
    ensure(start.is_some(), "spec", "initializer.type", found, "\"volume\", or no initializer")?;
    Ok(start)
}

/// Reads a volume that fits the scan, in 1/mm.
pub fn start_volume(job: &Job<'_>, path: &str) -> Result<Volume> {
    let shape = job.scan.geometry.volume.shape;
    let volume = (job.volumes)(path)?;
    let found = format!("{:?}", volume.data.shape());
    ensure(volume.data.shape() == shape, path, "shape", found, format!("{shape:?}, the voxels of the scan"))?;
    if let Some((at, x)) = volume.data.indexed_iter().find(|(_, x)| !x.is_finite()) {
        return Err(Error::invalid(path, format!("voxel {at:?}"), x, "a finite attenuation"));
    }
    let mm = job.scan.unit.mm as f32;
    Ok(Volume { grid: job.scan.geometry.volume, ..volume.mapped(|x| x / mm) })
}

/// Where the driver stands beside the method.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    numbers: Vec<f64>,
    best: Option<f64>,
    since_best: u64,
    /// Whether the stopping rule is met.
    settled: bool,
}

/// Runs `method` on `job` until `stop` or the job's limits end it. What was computed since `begun` counts as its time.
pub fn drive(
    job: &Job<'_>,
    stop: &Stop,
    begun: Instant,
    problem: &Problem<'_>,
    method: &mut dyn Method,
    observer: &mut dyn Observer,
) -> Result<Solution> {
    let mm = job.scan.unit.mm as f32;
    let watch = Watch::new(job);
    let pixels = job.scan.projections.len() as f64;
    let mut step = 0;
    let mut kept = Kept::default();
    let mut seconds = 0.0;
    let mut best: Option<Array3<f32>> = None;
    // Differences ten times those of an empty volume, and growing, are no reconstruction.
    let (empty, mut last) = (problem.scan.projections.as_slice().map_or(f64::MAX, square_sum), None);
    if let Some(resume) = job.resume {
        kept = restore(resume, method)?;
        best = best_of(resume, job);
        (step, seconds) = (resume.standing.step, resume.standing.seconds);
        observer.note(&format!("resumed after pass {step}"));
    }
    let ends = Ends { steps: stop.passes, seconds: stop.seconds };
    let mut clock = Clock::new(ends, job.limits, seconds + begun.elapsed().as_secs_f64());
    let started = step;
    let mut last_pass = 0.0;
    if stop.patience.is_some() && job.held_out.is_none() {
        observer.note("stop.patience looks at views that are kept aside, and none are: it does not end this run");
    }
    clock.resume();
    loop {
        let cancelled = observer.cancelled();
        // Time alone does not end a run that has made nothing yet.
        let share = if step == 0 { clock.share_of_steps(step) } else { clock.done(step) };
        let over = share >= 1.0 || kept.settled || (step > 0 && !clock.allows(last_pass));
        if over {
            observer.progress(step, 1.0, 0.0);
        }
        if step > started && (cancelled || observer.checkpoint_due()) {
            clock.pause();
            kept.numbers = method.numbers().iter().map(|x| **x).collect();
            let solver = serde_json::json!(kept);
            let standing = Standing { step, recorded: step, seconds: clock.seconds(), solver, ..Standing::default() };
            let state = method.state();
            let sizes: Vec<[usize; 1]> = state.iter().map(|(_, x)| [x.len()]).collect();
            let mut tensors: Vec<(String, &[usize], &[f32])> =
                state.iter().zip(&sizes).map(|((n, x), size)| (n.to_string(), &size[..], &**x)).collect();
            let flat = best.as_ref().and_then(|b| b.as_slice());
            let length = [flat.map_or(0, <[f32]>::len)];
            if let Some(b) = flat {
                tensors.push(("best".into(), &length, b));
            }
            observer.checkpoint(&Checkpoint { tensors, standing })?;
            clock.resume();
        }
        if cancelled {
            return Err(Error::Interrupted { step });
        }
        if over {
            break;
        }
        let pass_begun = Instant::now();
        let pass = method.pass(problem, step)?;
        problem.operator.fault()?;
        step += 1;
        let away = pass.residual > 100.0 * empty && last.is_some_and(|l| pass.residual > l);
        if away || !pass.residual.is_finite() {
            let times = (pass.residual / empty).sqrt();
            let what = format!("the residual is {times:.3e} times that of an empty volume; try a smaller relaxation");
            return Err(Error::Diverged { step, what });
        }
        last = Some(pass.residual);
        clock.pause();
        let held_out = watch.held_out(problem.operator, method.volume())?;
        let mut record = Record {
            step,
            seconds: clock.seconds(),
            loss: Some((pass.residual / pixels).sqrt()),
            prior: pass.prior,
            change: pass.change,
            held_out,
            psnr: watch.psnr(method.volume(), mm),
            ..Record::default()
        };
        if let (Some(patience), Some(error)) = (stop.patience, held_out) {
            if kept.best.is_none_or(|b| error < b) {
                kept.best = Some(error);
                kept.since_best = 0;
                best = Some(method.volume().clone());
            } else {
                kept.since_best += 1;
                kept.settled |= kept.since_best >= patience;
            }
        }
        if let (Some(limit), Some(change)) = (stop.change, pass.change) {
            kept.settled |= change < limit;
        }
        if kept.settled {
            record.events.push("the stopping rule is met".into());
        }
        observer.record(&record);
        clock.resume();
        last_pass = pass_begun.elapsed().as_secs_f64();
        let share = clock.done(step);
        observer.progress(step, share.min(1.0), clock.seconds() * (1.0 - share).max(0.0) / share.max(1e-9));
    }
    clock.pause();
    let mut data = best.unwrap_or_else(|| method.take());
    data.par_mapv_inplace(|x| x * mm);
    finite(&data, step)?;
    let volume = Volume { data, grid: job.scan.geometry.volume, affine: None };
    Ok(Solution {
        result: Reconstruction::Volume(volume),
        steps: step,
        train_s: clock.seconds(),
        samples: 0,
        sampling_s: 0.0,
        rollbacks: 0,
        best: kept.best.map(|held_out| Best { step: step - kept.since_best, held_out }),
    })
}

/// Refuses a volume with a number that is not finite.
pub(crate) fn finite(volume: &Array3<f32>, step: u64) -> Result<()> {
    match volume.indexed_iter().find(|(_, x)| !x.is_finite()) {
        Some((at, x)) => Err(Error::Diverged { step, what: format!("voxel {at:?} is {x}") }),
        None => Ok(()),
    }
}

fn restore(resume: &Resume, method: &mut dyn Method) -> Result<Kept> {
    let kept: std::result::Result<Kept, _> = serde_json::from_value(resume.standing.solver.clone());
    let kept = kept.map_err(|e| Error::invalid(&resume.place, "solver", e, "what this solver keeps"))?;
    for (name, values) in method.state() {
        let found = resume.weights.tensors.get(name).map(|t| &t.1);
        let fits = found.filter(|t| t.len() == values.len());
        let said = found.map_or("nothing".into(), |t| format!("{} numbers", t.len()));
        let fits = fits.ok_or_else(|| {
            Error::invalid(&resume.place, name, said, format!("{} numbers, as this run needs", values.len()))
        })?;
        values.copy_from_slice(fits);
    }
    let numbers = method.numbers();
    ensure(
        numbers.len() == kept.numbers.len(),
        &resume.place,
        "solver.numbers",
        kept.numbers.len(),
        format!("{} numbers", numbers.len()),
    )?;
    for (number, saved) in numbers.into_iter().zip(&kept.numbers) {
        *number = *saved;
    }
    Ok(kept)
}

fn best_of(resume: &Resume, job: &Job<'_>) -> Option<Array3<f32>> {
    let (_, values) = resume.weights.tensors.get("best")?;
    Array3::from_shape_vec(job.scan.geometry.volume.shape, values.clone()).ok()
}

/// `1/x` where `x` is more than a millionth of the largest, else 0: rays that miss the volume and voxels that no ray
/// meets take no part.
pub fn inverse(mut x: Array3<f32>) -> Array3<f32> {
    let least = 1e-6 * x.iter().fold(0.0f32, |m, &v| m.max(v));
    x.par_mapv_inplace(|v| if v > least { 1.0 / v } else { 0.0 });
    x
}

/// All of an array that this crate made.
pub(crate) fn flat(x: &Array3<f32>) -> &[f32] {
    x.as_slice().unwrap_or_else(|| unreachable!("arrays of this crate are contiguous"))
}

/// Like [`flat`], to be written.
pub(crate) fn flat_mut(x: &mut Array3<f32>) -> &mut [f32] {
    x.as_slice_mut().unwrap_or_else(|| unreachable!("arrays of this crate are contiguous"))
}

/// Root mean square of `x − before` over that of `x`.
pub(crate) fn change(x: &Array3<f32>, before: &Array3<f32>) -> f64 {
    distance(x, before) / norm2(x).max(1e-300).sqrt()
}

/// `‖x − y‖`.
pub(crate) fn distance(x: &Array3<f32>, y: &Array3<f32>) -> f64 {
    difference_square_sum(flat(x), flat(y)).sqrt()
}

/// Bytes that a projector works in at most while it takes `values` measured ones back.
fn projecting(values: u64) -> u64 {
    (8 * values).min(12 << 20)
}

/// `‖x‖²` of an array.
pub(crate) fn norm2(x: &Array3<f32>) -> f64 {
    square_sum(flat(x))
}
