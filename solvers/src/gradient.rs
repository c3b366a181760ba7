//! Gradient training: an attenuation field whose Beer-Lambert line integrals match the measured ones.
//!
//! Every step draws rays, compares their integrals with the measurement (L1 in the published codes), optionally adds
//! a total-variation prior on small random blocks of neighbouring points, and takes an Adam step.

use crate::drift::{Drift, DriftWatch};
use crate::fit::{Fitted, fit};
use crate::guard::{Guard, Watched, strayed};
use crate::iterative::start_volume;
use crate::patience::{Patience, Waited};
use crate::pretrain::learn;
use crate::rays::{Pixels, RaySource, Views};
use crate::refine::{Refinement, Since};
use crate::schedule::{Clock, Decay, Ends};
use crate::surround::Within;
use crate::watched;
use conefield_core::backend::{Adam, Executable, Loss, TrainRay, TvBlocks, Work};
use conefield_core::checkpoint::{Checkpoint, Resume, Standing, tensors};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::pipeline::{Masked, Model, Pipeline};
use conefield_core::random::stream;
use conefield_core::scan::ScanHeader;
use conefield_core::scene::Scene;
use conefield_core::solver::{DriftRecord, Job, Observer, PretrainJob, Reconstruction, Record, Solution, Solver};
use conefield_core::spec::{SolverSpec, Spec};
use conefield_core::stage::{Projector, UnitRay};
use conefield_core::trained::TrainedField;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Penalty of the difference between predicted and measured, in the scan's own scale.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Penalty {
    /// Absolute difference (published by NI-NeRF).
    L1,
    /// Half the square (published by NAF, up to the factor).
    L2,
    /// Half the square up to this difference, linear beyond it.
    Huber(f64),
}

impl From<Penalty> for Loss {
    fn from(p: Penalty) -> Self {
        match p {
            Penalty::L1 => Loss::L1,
            Penalty::L2 => Loss::L2,
            Penalty::Huber(delta) => Loss::Huber { delta },
        }
    }
}

/// Total variation of the field over small random blocks of neighbouring points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TvPrior {
    /// Weight against the mean penalty of a ray.
    pub weight: f64,
    /// Blocks a step.
    pub blocks: usize,
    /// Points along a block's edge.
    pub edge: usize,
    /// Distance of the points in voxels.
    pub spacing: f64,
    /// Differences below this (in the scale that stages see) count quadratically.
    pub smoothing: f64,
}

impl Default for TvPrior {
    fn default() -> Self {
        Self { weight: 1e-3, blocks: 64, edge: 8, spacing: 1.0, smoothing: 1e-4 }
    }
}

/// Settings of `gradient`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Gradient {
    /// Ends after this many passes over the views.
    pub epochs: Option<f64>,
    /// Ends after this many steps.
    pub steps: Option<u64>,
    /// Ends after this many seconds of training. Which limit comes first ends the run.
    pub seconds: Option<f64>,
    /// Ends when the held-out views' error has not fallen for this many records, of `report_every` steps each; the best of them
    /// is kept. A learning rate that goes down does so until the end that is set: what it still brings may come late.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub patience: Option<u64>,
    /// Rays a step.
    pub rays: usize,
    /// Where a step takes its rays from.
    pub views: Views,
    /// Which pixels count.
    pub pixels: Pixels,
    /// Pixels by which the support is widened.
    pub margin: usize,
    /// Penalty of the difference between predicted and measured.
    pub loss: Penalty,
    /// Learning rate.
    pub lr: f64,
    /// How it goes down.
    pub decay: Decay,
    /// Adam's decay rates of the moments.
    pub betas: [f64; 2],
    /// Adam's ε.
    pub eps: f64,
    /// Total-variation prior, if any.
    pub tv: Option<TvPrior>,
    /// While a scan is reconstructed, logs how much normalizers and field change under the same features, if asked for.
    pub drift: Option<Drift>,
    /// Times that a run may go back to its last good state, with half the learning rate, when its loss runs away or is no
    /// longer finite; 0 keeps no such state.
    pub rollbacks: u64,
    /// Steps between two records of the metrics.
    pub report_every: u64,
    /// Points a step of pre-training.
    pub pretrain_points: usize,
    /// Steps of pre-training.
    pub pretrain_steps: u64,
}

impl Default for Gradient {
    fn default() -> Self {
        Self {
            epochs: None,
            steps: Some(1500),
            seconds: None,
            patience: None,
            rays: 1024,
            views: Views::All,
            pixels: Pixels::Support,
            margin: 8,
            loss: Penalty::L1,
            lr: 1e-3,
            decay: Decay::Exponential(0.1),
            betas: [0.9, 0.999],
            eps: 1e-8,
            tv: None,
            drift: None,
            rollbacks: 8,
            report_every: 50,
            pretrain_points: 65_536,
            pretrain_steps: 1000,
        }
    }
}

conefield_core::stage_type!(Solver, "gradient", Gradient, "stochastic gradient training of an attenuation field");

#[typetag::serde(name = "gradient")]
impl SolverSpec for Gradient {
    fn build(&self) -> Result<Box<dyn Solver>> {
        let place = "spec";
        let positive = |x: f64| x.is_finite() && x > 0.0;
        ensure((1..=1 << 20).contains(&self.rays), place, "solver.rays", self.rays, "1 to 2^20")?;
        ensure(positive(self.lr), place, "solver.lr", self.lr, "a positive finite number")?;
        // Second moments are cleared below 1e-36: a smaller ε would leave steps of any size, or 0/0.
        let eps = self.eps.is_finite() && self.eps >= 1e-16;
        ensure(eps, place, "solver.eps", self.eps, "a finite number, at least 1e-16")?;
        let betas = self.betas.iter().all(|b| (0.0..1.0).contains(b));
        ensure(betas, place, "solver.betas", format!("{:?}", self.betas), "two numbers from 0 to below 1")?;
        ensure(self.report_every > 0, place, "solver.report_every", 0, "at least 1")?;
        ensure(self.patience != Some(0), place, "solver.patience", 0, "at least 1")?;
        ensure(
            self.epochs.is_some() || self.steps.is_some() || self.seconds.is_some(),
            place,
            "solver",
            "no end",
            "one of epochs, steps or seconds",
        )?;
        for (name, end) in [("epochs", self.epochs), ("seconds", self.seconds)] {
            if let Some(x) = end {
                ensure(positive(x), place, &format!("solver.{name}"), x, "a positive finite number")?;
            }
        }
        if let Penalty::Huber(delta) = self.loss {
            ensure(positive(delta), place, "solver.loss", delta, "a positive finite number")?;
        }
        if let Some(tv) = &self.tv {
            ensure((2..=32).contains(&tv.edge), place, "solver.tv.edge", tv.edge, "2 to 32")?;
            ensure(tv.weight.is_finite() && tv.weight >= 0.0, place, "solver.tv.weight", tv.weight, "0 or more")?;
            ensure(positive(tv.spacing), place, "solver.tv.spacing", tv.spacing, "a positive finite number")?;
            ensure(positive(tv.smoothing), place, "solver.tv.smoothing", tv.smoothing, "a positive finite number")?;
            ensure((1..=1 << 16).contains(&tv.blocks), place, "solver.tv.blocks", tv.blocks, "1 to 65536")?;
        }
        let points = self.pretrain_points;
        ensure((1..=1 << 22).contains(&points), place, "solver.pretrain_points", points, "1 to 2^22")?;
        self.decay.validate()?;
        self.drift.as_ref().map_or(Ok(()), Drift::validate)?;
        Ok(Box::new(self.clone()))
    }
}

/// Rays of held-out views that are rendered for a record, at most.
const HELD_OUT_RAYS: usize = 8192;

impl Solver for Gradient {
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        job.scan.validate("scan")?;
        let mut pipeline = Pipeline::build(job.spec)?;
        let Fitted { scene, needed, found } = fit(job.scan, &job.spec.scene, &mut pipeline)?;
        found.iter().for_each(|line| observer.note(line));
        let within = Within::of(job, observer)?;
        let job = &Within::job(within.as_ref(), job);
        let volume = job.spec.initializer.as_ref().map(|i| i.volume()).transpose()?.flatten();
        let fills_weights = job.spec.initializer.as_ref().filter(|_| volume.is_none());
        let initializer = fills_weights.map(|i| i.build(job.weights)).transpose()?;
        let source =
            RaySource::new(job.scan, &scene, pipeline.projector.as_ref(), self.views, self.pixels, self.margin)?;
        observer.note(&format!("{:.0}% of the pixels are trained on", 100.0 * source.share()));
        let mut model = Model::random(pipeline, job.seed);
        let mut guard = Guard::new(self.rollbacks, self.loss.into(), job.scan, &scene);
        let mut patience = Patience::new(self.patience);
        if self.patience.is_some() && job.held_out.is_none() {
            observer.note("solver.patience looks at views that are kept aside, and none are: it does not end this run");
        }
        let mut start = Start::default();
        if let Some(resume) = job.resume {
            resume.restore(&mut model)?;
            start = Start::read(resume)?;
            guard.resume(std::mem::take(&mut start.kept.guard), resume, &model)?;
            patience.resume(std::mem::take(&mut start.kept.patience), resume, &model)?;
            observer.note(&format!("resumed after step {}", start.standing.step));
        } else if let Some(i) = initializer {
            let report = i.apply(model.pipeline.layout(), &mut model.arena)?;
            if !report.loaded.is_empty() {
                observer.note(&format!(
                    "loaded {} of {} tensors",
                    report.loaded.len(),
                    report.loaded.len() + report.fresh.len()
                ));
            }
        }
        if let (Some(keep), None) = (needed, job.resume) {
            model.mask(&Masked { normalizer: None, keep })?;
        }
        let (mut exe, explain) = job.backend.compile(&model.pipeline)?;
        observer.note(&explain.backend);
        if let (Some(from), None) = (&volume, job.resume) {
            let known = start_volume(job, &from.path)?;
            learn(self, exe.as_mut(), &mut model, (&known, &scene), from.steps, job, observer)?;
            observer.note(&format!("learned {} in {} steps", from.path, from.steps));
        }
        let watch = Watch::new(job, &scene, model.pipeline.projector.as_ref());
        let steps_an_epoch = source.steps_an_epoch() as f64;
        let by_epochs = self.epochs.map(|e| (e * steps_an_epoch).ceil() as u64);
        let steps = [self.steps, by_epochs].into_iter().flatten().min();
        let watcher = |d| DriftWatch::new(d, &scene, job.seed, steps_an_epoch, job.resume, &model);
        let mut drift = self.drift.as_ref().map(watcher).transpose()?;
        let Start { standing, kept: Kept { mut window, since, .. } } = start;
        let rule = &job.spec.scene.occupancy;
        let mut refinement = Refinement::new(rule, &scene, job.seed, since.unwrap_or_default(), job.resume)?;
        let mut clock = Clock::new(Ends { steps, seconds: self.seconds }, job.limits, standing.seconds);
        let mut rays = Vec::with_capacity(self.rays);
        let mut tv = TvBlocks::default();
        let (mut step, mut samples) = (standing.step, standing.samples);
        clock.resume();
        loop {
            if let Some(drift) = drift.as_mut().filter(|d| d.due(step)) {
                clock.pause();
                window.drift.extend(drift.look(step, &mut model, exe.as_mut(), &mut window.events)?);
                clock.resume();
            }
            let cancelled = observer.cancelled();
            if step > standing.step && (cancelled || observer.checkpoint_due()) {
                clock.pause();
                let solver = serde_json::json!({
                    "window": window,
                    "guard": guard.watched(),
                    "patience": patience.waited(),
                    "since": refinement.as_ref().map(Refinement::since),
                });
                let masks = model.masks().to_vec();
                // The record of this step, if one is due, comes after the checkpoint.
                let recorded = step.saturating_sub(1);
                let standing = Standing { step, recorded, samples, seconds: clock.seconds(), masks, solver };
                exe.fetch(&mut model)?;
                // What the guard has yet to find out is not worth to go on from: an earlier checkpoint stays.
                if strayed(&model.arena).is_none() {
                    let mut tensors = tensors(&model);
                    tensors.extend(drift.iter().flat_map(|d| d.tensors(&model)));
                    tensors.extend(guard.tensors(model.pipeline.layout()));
                    tensors.extend(patience.tensors(model.pipeline.layout()));
                    tensors.extend(refinement.iter().map(Refinement::tensor));
                    observer.checkpoint(&Checkpoint { tensors, standing })?;
                }
                clock.resume();
            }
            if cancelled {
                return Err(Error::Interrupted { step });
            }
            let share = clock.share(step);
            let done = clock.done(step) >= 1.0;
            if done && let Some(said) = guard.finish(step, &mut model, exe.as_mut())? {
                window.tell(said, observer);
            }
            let mut settled = false;
            if step > 0 && (step % self.report_every == 0 || done) && window.steps > 0 {
                clock.pause();
                let record = window.record(
                    step,
                    clock.seconds(),
                    guard.rate() * self.lr * self.decay.at(step as f64 / steps_an_epoch, share),
                );
                let mut record = watch.fill(record, &model, exe.as_mut())?;
                settled = patience.judge(&record, &mut model, exe.as_mut())?;
                if settled {
                    record.events.push("the stopping rule is met".into());
                }
                observer.record(&record);
                window = Window::default();
                clock.resume();
            }
            if done || settled {
                break;
            }
            let epoch = step as f64 / steps_an_epoch;
            window.events.extend(model.refresh(&scene, epoch, job.backend, &mut exe)?);
            patience.renew(&model);
            if let Some(refinement) = &mut refinement
                && let Some(said) = refinement.look(step, &model, exe.as_mut())?
            {
                window.tell(said, observer);
            }
            source.draw(job.seed, step, self.rays, &mut rays);
            let tv = self.tv.as_ref().map(|prior| {
                blocks(prior, &scene, job.seed, step, &mut tv);
                &tv
            });
            let occupancy = refinement.as_ref().and_then(Refinement::occupancy);
            let work = Work { step, seed: job.seed, loss: self.loss.into(), rays: &rays, points: &[], tv, occupancy };
            let start = Instant::now();
            let stats = exe.step(&mut model, &work)?;
            let back = guard.judge(&work, &stats, &mut model, exe.as_mut())?;
            step += 1;
            samples += stats.samples;
            match back {
                Some(said) => {
                    window.tell(said, observer);
                    refinement.iter_mut().for_each(|r| r.forget(step));
                }
                None => {
                    exe.update(&mut model, &guard.next(self.adam(step, epoch, share)))?;
                    window.add(stats.loss, stats.prior, stats.samples, start.elapsed().as_secs_f64());
                }
            }
            let share = clock.done(step);
            observer.progress(step, share, clock.seconds() * (1.0 - share).max(0.0) / share.max(1e-9));
        }
        clock.pause();
        drop(source);
        let best = patience.finish(&mut model);
        let field = TrainedField { model, scene, unit_mm: job.scan.unit.mm };
        let (train_s, rollbacks) = (clock.seconds(), guard.rollbacks());
        let result = Reconstruction::Field(field);
        Ok(Solution { result, steps: step, train_s, samples, sampling_s: train_s, rollbacks, best })
    }

    fn needs_held_out(&self) -> Option<&'static str> {
        self.patience.map(|_| "solver.patience")
    }

    fn pretrain(&self, job: &PretrainJob<'_>, observer: &mut dyn Observer) -> Result<Model> {
        crate::pretrain::pretrain(self, job, observer)
    }

    fn trains_field(&self, _: &Spec) -> Result<bool> {
        Ok(true)
    }

    /// The list of the pixels that are trained on, at most all of them.
    fn bytes(&self, header: &ScanHeader) -> u64 {
        size_of::<u32>() as u64 * header.pixels()
    }

    /// Parameters and moments of the last good state, and parameters of the best one.
    fn memory_per_parameter(&self) -> u64 {
        let good = if self.rollbacks > 0 { 3 } else { 0 };
        size_of::<f32>() as u64 * (good + u64::from(self.patience.is_some()))
    }

    fn describe(&self) -> String {
        let tv = self.tv.as_ref().map_or(String::new(), |t| format!(", total variation {}", t.weight));
        let ends = self.patience.map_or(String::new(), |n| {
            let records = if n == 1 { "a record".into() } else { format!("{n} records") };
            format!(", ends after {records} of {} steps without a smaller held-out error", self.report_every)
        });
        format!("gradient: {} rays a step, {:?}, Adam {}{tv}{ends}", self.rays, self.loss, self.lr).to_lowercase()
    }
}

impl Gradient {
    /// Adam's settings for step `step` (from 1).
    pub fn adam(&self, step: u64, epoch: f64, share: f64) -> Adam {
        Adam {
            lr: self.lr * self.decay.at(epoch, share),
            beta1: self.betas[0],
            beta2: self.betas[1],
            eps: self.eps,
            step,
        }
    }
}

/// Random blocks of neighbouring points inside the volume.
fn blocks(prior: &TvPrior, scene: &Scene, seed: u64, step: u64, out: &mut TvBlocks) {
    let mut rng = stream(seed ^ 0x7e57_b10c, step);
    let voxel = scene.unit_spacing();
    let spacing = voxel.map(|s| s * prior.spacing as f32);
    let (lo, hi) = (scene.to_unit(scene.bounds[0]), scene.to_unit(scene.bounds[1]));
    out.corners.clear();
    for _ in 0..prior.blocks {
        out.corners.push(std::array::from_fn(|k| {
            let room = (hi[k] - lo[k] - spacing[k] * (prior.edge - 1) as f32).max(0.0);
            lo[k] + room * rng.random::<f32>()
        }));
    }
    out.spacing = spacing;
    out.edge = prior.edge;
    out.weight = prior.weight;
    out.smoothing = prior.smoothing;
}

/// Where training begins.
#[derive(Default)]
struct Start {
    standing: Standing,
    kept: Kept,
}

impl Start {
    fn read(resume: &Resume) -> Result<Self> {
        let kept = serde_json::from_value(resume.standing.solver.clone());
        let kept = kept.map_err(|e| Error::invalid(&resume.place, "solver", e, "what this solver keeps"))?;
        Ok(Self { standing: resume.standing.clone(), kept })
    }
}

/// What a checkpoint keeps for this solver.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    window: Window,
    guard: Watched,
    patience: Waited,
    #[serde(default)]
    since: Option<Since>,
}

/// Sums since the last record.
#[derive(Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Window {
    steps: u64,
    loss: f64,
    prior: f64,
    samples: u64,
    seconds: f64,
    #[serde(default)]
    drift: Vec<DriftRecord>,
    events: Vec<String>,
}

impl Window {
    /// Says what happened, now and in the next record.
    fn tell(&mut self, said: String, observer: &mut dyn Observer) {
        observer.note(&said);
        self.events.push(said);
    }

    fn add(&mut self, loss: f64, prior: f64, samples: u64, seconds: f64) {
        self.steps += 1;
        self.loss += loss;
        self.prior += prior;
        self.samples += samples;
        self.seconds += seconds;
    }

    fn record(&mut self, step: u64, seconds: f64, lr: f64) -> Record {
        let n = self.steps as f64;
        Record {
            step,
            seconds,
            loss: Some(self.loss / n),
            prior: (self.prior > 0.0).then_some(self.prior / n),
            lr: Some(lr),
            samples_per_s: Some(self.samples as f64 / self.seconds.max(1e-12)),
            drift: std::mem::take(&mut self.drift),
            events: std::mem::take(&mut self.events),
            ..Record::default()
        }
    }
}

/// What is looked at for every record: some voxels of the reference, some rays of the held-out views.
struct Watch {
    points: Vec<[f32; 3]>,
    reference: Vec<f32>,
    /// Voxels where the object cannot be, and the sum of their squares in the reference.
    outside: (usize, f64),
    /// From what stages see to the reference's unit.
    scale: f32,
    peak: f64,
    rays: Vec<TrainRay>,
    /// Rays that meet nothing that is modelled, and the sum of the squares of what they measured.
    missing: (usize, f64),
    top: f64,
}

impl Watch {
    fn new(job: &Job<'_>, scene: &Scene, projector: &dyn Projector) -> Self {
        let (mut points, mut reference, mut outside) = (vec![], vec![], (0, 0.0));
        let shape = scene.grid.shape;
        if let Some(r) = job.reference.filter(|r| r.data.shape() == shape) {
            for voxel in watched::voxels(shape) {
                let value = r.data[voxel];
                if scene.holds(scene.grid.voxel(voxel)) {
                    points.push(scene.voxel(voxel));
                    reference.push(value);
                } else {
                    outside = (outside.0 + 1, outside.1 + f64::from(value).powi(2));
                }
            }
        }
        let (mut rays, mut missing, mut top) = (vec![], (0, 0.0), 0.0f64);
        if let Some(scan) = job.held_out {
            let [rows, columns] = scan.geometry.detector;
            let every = (scan.projections.len() / HELD_OUT_RAYS).max(1) | 1;
            // Over all pixels, as solvers on voxels have it: errors of either kind compare.
            top = scan.projections.iter().map(|p| f64::from(scene.line_to_unit(*p))).fold(0.0, f64::max);
            for i in (0..scan.projections.len()).step_by(every) {
                let at = [i / (rows * columns), i / columns % rows, i % columns];
                let target = scene.line_to_unit(scan.projections[at]);
                let ray = scene.pixel_ray(&scan.geometry, at[0], at[1], at[2]);
                if projector.max_samples(&ray) > 0 {
                    rays.push(TrainRay { ray, target });
                } else {
                    missing = (missing.0 + 1, missing.1 + f64::from(target).powi(2));
                }
            }
        }
        Self {
            points,
            reference,
            outside,
            scale: (scene.attenuation * job.scan.unit.mm) as f32,
            peak: job.peak,
            rays,
            missing,
            top,
        }
    }

    fn fill(&self, mut record: Record, model: &Model, exe: &mut dyn Executable) -> Result<Record> {
        if !self.points.is_empty() {
            let mut mu = vec![0.0; self.points.len()];
            exe.evaluate(model, &self.points, &mut mu)?;
            let square = |(m, r): (&f32, &f32)| (f64::from(m * self.scale) - f64::from(*r)).powi(2);
            let sum = mu.iter().zip(&self.reference).map(square).sum::<f64>() + self.outside.1;
            let mse = sum / (mu.len() + self.outside.0) as f64;
            record.psnr = Some(10.0 * (self.peak * self.peak / mse.max(1e-300)).log10());
        }
        if !self.rays.is_empty() {
            let rays: Vec<UnitRay> = self.rays.iter().map(|r| r.ray).collect();
            let mut lines = vec![0.0; rays.len()];
            exe.render(model, &rays, &mut lines)?;
            let square = |(a, r): (&f32, &TrainRay)| (f64::from(*a) - f64::from(r.target)).powi(2);
            let sum = lines.iter().zip(&self.rays).map(square).sum::<f64>() + self.missing.1;
            let mse = sum / (rays.len() + self.missing.0) as f64;
            record.held_out = Some(mse.sqrt() / self.top.max(1e-300));
        }
        Ok(record)
    }
}
