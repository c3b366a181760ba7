//! Gradient training: an attenuation field whose Beer-Lambert line integrals match the measured ones.
//!
//! Every step draws rays, compares their integrals with the measurement by a loss (L1 in the published codes), adds
//! the priors on small random blocks of neighbouring points, and takes an Adam step.

use crate::drift::{Drift, DriftWatch};
use crate::fit::{Fitted, fit};
use crate::guard::{Guard, Watched, strayed};
use crate::iterative::noise::{self, Noise};
use crate::iterative::start_volume;
use crate::losses::L1;
use crate::patience::{Patience, Waited};
use crate::pretrain::learn;
use crate::priors::Places;
use crate::rays::{Pixels, RaySource, Views};
use crate::schedule::{Clock, Decay, Ends};
use crate::surround::Within;
use crate::watched;
use conefield_core::backend::{Adam, Executable, TrainRay, Work};
use conefield_core::checkpoint::{Checkpoint, Resume, Standing, tensors};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::loss::{Loss, NoiseModel};
use conefield_core::pipeline::{Masked, Model, Pipeline};
use conefield_core::prior::Prior;
use conefield_core::scene::Scene;
use conefield_core::solver::{DriftRecord, Job, Observer, PretrainJob, Reconstruction, Record, Solution, Solver};
use conefield_core::spec::{LossSpec, PriorSpec, SolverSpec, Spec};
use conefield_core::stage::{Projector, UnitRay};
use conefield_core::trained::TrainedField;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `gradient`.
#[derive(Serialize, Deserialize, JsonSchema)]
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
    /// What a difference between predicted and measured costs.
    #[serde(deserialize_with = "conefield_core::spec::stage::needed")]
    #[schemars(schema_with = "loss")]
    pub loss: Box<dyn LossSpec>,
    /// Learning rate.
    pub lr: f64,
    /// How it goes down.
    pub decay: Decay,
    /// Adam's decay rates of the moments.
    pub betas: [f64; 2],
    /// Adam's ε.
    pub eps: f64,
    /// What the field is to be like, whatever was measured.
    #[serde(deserialize_with = "conefield_core::spec::stage::list")]
    #[schemars(schema_with = "list_of_priors")]
    pub priors: Vec<Box<dyn PriorSpec>>,
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
            loss: Box::new(L1 {}),
            lr: 1e-3,
            decay: Decay::Exponential(0.1),
            betas: [0.9, 0.999],
            eps: 1e-8,
            priors: vec![],
            drift: None,
            rollbacks: 8,
            report_every: 50,
            pretrain_points: 65_536,
            pretrain_steps: 1000,
        }
    }
}

fn loss(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "x-stage": "loss" })
}

fn list_of_priors(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "items": { "x-stage": "prior" } })
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
        let points = self.pretrain_points;
        ensure((1..=1 << 22).contains(&points), place, "solver.pretrain_points", points, "1 to 2^22")?;
        self.decay.validate()?;
        self.drift.as_ref().map_or(Ok(()), Drift::validate)?;
        let loss = self.loss.build().map_err(|e| e.within("solver.loss"))?;
        let prior = |(i, spec): (usize, &Box<dyn PriorSpec>)| {
            let prior = spec.build().and_then(|p| p.blocks().validate().map(|()| p));
            prior.map_err(|e| e.within(&format!("solver.priors.{i}")))
        };
        let priors = self.priors.iter().enumerate().map(prior).collect::<Result<_>>()?;
        // Settings hold those of stages, which cannot be cloned: they are written and read.
        let again = serde_json::to_value(self).and_then(serde_json::from_value);
        let settings =
            again.map_err(|e| Error::invalid(place, "solver", e, "settings that can be written and read"))?;
        Ok(Box::new(Training { settings, loss, priors }))
    }
}

/// Steps whose rays a loss learns from at most, and rays of each.
const DRAWS: u64 = 64;
const DRAWN: usize = 1024;

/// Rays of held-out views that are rendered for a record, at most.
const HELD_OUT_RAYS: usize = 8192;

/// What [`Gradient`] builds.
struct Training {
    settings: Gradient,
    loss: Box<dyn Loss>,
    priors: Vec<Box<dyn Prior>>,
}

impl Solver for Training {
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let settings = &self.settings;
        job.scan.validate("scan")?;
        let mut pipeline = Pipeline::build(job.spec)?;
        let Fitted { scene, needed, found } = fit(job.scan, &job.spec.scene, &mut pipeline)?;
        found.iter().for_each(|line| observer.note(line));
        let within = Within::of(job, observer)?;
        let job = &Within::job(within.as_ref(), job);
        let volume = job.spec.initializer.as_ref().map(|i| i.volume()).transpose()?.flatten();
        let fills_weights = job.spec.initializer.as_ref().filter(|_| volume.is_none());
        let initializer = fills_weights.map(|i| i.build(job.weights)).transpose()?;
        let source = RaySource::new(
            job.scan,
            &scene,
            pipeline.projector.as_ref(),
            settings.views,
            settings.pixels,
            settings.margin,
        )?;
        observer.note(&format!("{:.0}% of the pixels are trained on", 100.0 * source.share()));
        let mut model = Model::random(pipeline, job.seed);
        let fitted = self.fitted(job, &scene, &source);
        let loss = fitted.as_deref().unwrap_or(self.loss.as_ref());
        if fitted.is_some() {
            observer.note(&format!("loss: {}", loss.describe()));
        }
        let mut guard = Guard::new(settings.rollbacks, loss, job.scan, &scene);
        let mut patience = Patience::new(settings.patience);
        if settings.patience.is_some() && job.held_out.is_none() {
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
            learn(settings, exe.as_mut(), &mut model, (&known, &scene), from.steps, job, observer)?;
            observer.note(&format!("learned {} in {} steps", from.path, from.steps));
        }
        let watch = Watch::new(job, &scene, model.pipeline.projector.as_ref());
        let steps_an_epoch = source.steps_an_epoch() as f64;
        let by_epochs = settings.epochs.map(|e| (e * steps_an_epoch).ceil() as u64);
        let steps = [settings.steps, by_epochs].into_iter().flatten().min();
        let watcher = |d| DriftWatch::new(d, &scene, job.seed, steps_an_epoch, job.resume, &model);
        let mut drift = settings.drift.as_ref().map(watcher).transpose()?;
        let Start { standing, kept: Kept { mut window, .. } } = start;
        let mut clock = Clock::new(Ends { steps, seconds: settings.seconds }, job.limits, standing.seconds);
        let mut rays = Vec::with_capacity(settings.rays);
        let mut places = Places::new(&self.priors);
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
            if step > 0 && (step % settings.report_every == 0 || done) && window.steps > 0 {
                clock.pause();
                let record = window.record(
                    step,
                    clock.seconds(),
                    guard.rate() * settings.lr * settings.decay.at(step as f64 / steps_an_epoch, share),
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
            source.draw(job.seed, step, settings.rays, &mut rays);
            let priors = places.draw(&scene, job.seed, step);
            let work = Work { step, seed: job.seed, loss, rays: &rays, points: &[], priors: &priors };
            let start = Instant::now();
            let stats = exe.step(&mut model, &work)?;
            let back = guard.judge(&work, &stats, &mut model, exe.as_mut())?;
            step += 1;
            samples += stats.samples;
            match back {
                Some(said) => window.tell(said, observer),
                None => {
                    exe.update(&mut model, &guard.next(settings.adam(step, epoch, share)))?;
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
        self.settings.patience.map(|_| "solver.patience")
    }

    fn pretrain(&self, job: &PretrainJob<'_>, observer: &mut dyn Observer) -> Result<Model> {
        crate::pretrain::pretrain(&self.settings, job, observer)
    }

    fn trains_field(&self, _: &Spec) -> Result<bool> {
        Ok(true)
    }

    /// The list of the pixels that are trained on, at most all of them, and what a loss learns from.
    fn working_memory(&self, pixels: u64, _: u64) -> u64 {
        let learning = if self.loss.needs_scan() { noise::memory(pixels) } else { 0 };
        size_of::<u32>() as u64 * pixels + learning
    }

    /// Parameters and moments of the last good state, and parameters of the best one.
    fn memory_per_parameter(&self) -> u64 {
        let good = if self.settings.rollbacks > 0 { 3 } else { 0 };
        size_of::<f32>() as u64 * (good + u64::from(self.settings.patience.is_some()))
    }

    fn describe(&self) -> String {
        let priors: String = self.priors.iter().map(|p| format!(", {}", p.describe())).collect();
        let ends = self.settings.patience.map_or(String::new(), |n| {
            let records = if n == 1 { "a record".into() } else { format!("{n} records") };
            format!(", ends after {records} of {} steps without a smaller held-out error", self.settings.report_every)
        });
        format!(
            "gradient: {} rays a step, {}, Adam {}{priors}{ends}",
            self.settings.rays,
            self.loss.describe(),
            self.settings.lr
        )
        .to_lowercase()
    }
}

impl Training {
    /// The loss for the job's scan, where it learns from one.
    fn fitted(&self, job: &Job<'_>, scene: &Scene, source: &RaySource<'_>) -> Option<Box<dyn Loss>> {
        if !self.loss.needs_scan() {
            return None;
        }
        let noise = Noise::of(job.scan, true);
        let (mut rays, mut measured) = (vec![], vec![]);
        for step in 0..source.steps_an_epoch().min(DRAWS) {
            source.draw(job.seed, step, DRAWN, &mut rays);
            measured.extend(rays.iter().map(|r| f64::from(r.target)));
        }
        let line = scene.line_scale();
        let noise = NoiseModel { sigma: noise.sigma / line, growth: noise.growth * line, measured: &measured };
        self.loss.fitted(&noise)
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
