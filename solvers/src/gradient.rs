//! Gradient training: an attenuation field whose Beer-Lambert line integrals match the measured ones.
//!
//! Every step draws rays, compares their integrals with the measurement (L1 in the published codes), optionally adds
//! a total-variation prior on small random blocks of neighbouring points, and takes an Adam step.

use crate::fit::{Fitted, fit};
use crate::iterative::start_volume;
use crate::pretrain::learn;
use crate::rays::{Pixels, RaySource, Views};
use crate::schedule::{Clock, Decay, Ends};
use crate::surround::Within;
use crate::training::callbacks::{FieldMonitor, LiveSlices, Rollback};
use crate::training::{Callback, CallbackSpec, Callbacks, Run, Task, checkpoint, train};
use conefield_core::backend::{Adam, Loss, TrainRay, TvBlocks, Work};
use conefield_core::error::{Result, ensure};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::random::stream;
use conefield_core::scene::Scene;
use conefield_core::solver::{Job, Observer, PretrainJob, Reconstruction, Solution, Solver};
use conefield_core::spec::{SolverSpec, Spec};
use conefield_core::trained::TrainedField;
use rand::RngExt;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

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
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Gradient {
    /// Ends after this many passes over the views.
    pub epochs: Option<f64>,
    /// Ends after this many steps.
    pub steps: Option<u64>,
    /// Ends after this many seconds of training. Which limit comes first ends the run.
    pub seconds: Option<f64>,
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
    /// What watches over training while a scan is reconstructed.
    #[serde(deserialize_with = "conefield_core::spec::stage::list")]
    #[schemars(schema_with = "callbacks")]
    pub callbacks: Vec<Box<dyn CallbackSpec>>,
    /// Steps between two records of the metrics.
    pub report_every: u64,
    /// Points a step of pre-training.
    pub pretrain_points: usize,
    /// Steps of pre-training.
    pub pretrain_steps: u64,
}

fn callbacks(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "items": { "x-stage": "callback" }, "default": [{ "type": "rollback" }] })
}

impl Default for Gradient {
    fn default() -> Self {
        Self {
            epochs: None,
            steps: Some(1500),
            seconds: None,
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
            callbacks: vec![Box::new(Rollback::default())],
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
        self.callbacks()?;
        Ok(Box::new(self.clone()))
    }
}

impl Solver for Gradient {
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        job.scan.validate("scan")?;
        let mut pipeline = Pipeline::build(job.spec)?;
        let mut callbacks = self.callbacks()?;
        for (i, callback) in callbacks.iter().enumerate() {
            callback.check(&pipeline).map_err(|e| e.within(&format!("solver.callbacks.{i}")))?;
        }
        let Fitted { scene, needed, found } = fit(job.scan, &job.spec.scene, &mut pipeline)?;
        found.iter().for_each(|line| observer.note(line));
        let within = Within::of(job, observer)?;
        let job = &Within::job(within.as_ref(), job);
        let source = RaySource::new(job.scan, &scene, &pipeline, self.views, self.pixels, self.margin)?;
        observer.note(&format!("{:.0}% of the pixels are trained on", 100.0 * source.share()));
        callbacks.insert(0, Box::new(FieldMonitor::new(job, &scene, &pipeline)));
        callbacks.push(Box::new(LiveSlices));
        let mut callbacks = Callbacks(callbacks);
        let mut run = self.begin(job, &scene, source.steps_an_epoch(), (pipeline, needed), observer)?;
        if let Some(resume) = job.resume {
            checkpoint::restore(&mut run, &mut callbacks, resume)?;
            run.observer.note(&format!("resumed after step {}", run.step));
        }
        let mut rays = Rays { settings: self, source, scene: &scene, rays: vec![], tv: TvBlocks::default() };
        train(&mut run, &mut rays, &mut callbacks)?;
        let Run { model, clock, step, samples, tally, best, .. } = run;
        let (train_s, rollbacks) = (clock.seconds(), tally.rollbacks);
        let result = Reconstruction::Field(TrainedField { model, scene: scene.clone(), unit_mm: job.scan.unit.mm });
        Ok(Solution { result, steps: step, train_s, samples, sampling_s: train_s, rollbacks, best })
    }

    fn needs_held_out(&self) -> Option<&'static str> {
        let needs = self.callbacks().is_ok_and(|all| all.iter().any(|c| c.needs_held_out()));
        needs.then_some("solver.callbacks")
    }

    fn pretrain(&self, job: &PretrainJob<'_>, observer: &mut dyn Observer) -> Result<Model> {
        crate::pretrain::pretrain(self, job, observer)
    }

    fn trains_field(&self, _: &Spec) -> Result<bool> {
        Ok(true)
    }

    /// The list of the pixels that are trained on, at most all of them.
    fn working_memory(&self, pixels: u64, _: u64) -> u64 {
        size_of::<u32>() as u64 * pixels
    }

    fn memory_per_parameter(&self) -> u64 {
        self.callbacks().iter().flatten().map(|c| c.bytes(1)).sum()
    }

    fn describe(&self) -> String {
        let tv = self.tv.as_ref().map_or(String::new(), |t| format!(", total variation {}", t.weight));
        let said = self.callbacks().into_iter().flatten().filter_map(|c| c.describe());
        let said: String = said.map(|s| format!(", {s}")).collect();
        format!("gradient: {} rays a step, {:?}, Adam {}{tv}{said}", self.rays, self.loss, self.lr).to_lowercase()
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

    /// The callbacks that the settings name, each once.
    fn callbacks(&self) -> Result<Vec<Box<dyn Callback>>> {
        let mut all: Vec<Box<dyn Callback>> = vec![];
        for (i, spec) in self.callbacks.iter().enumerate() {
            let key = format!("solver.callbacks.{i}");
            let callback = spec.build().map_err(|e| e.within(&key))?;
            let twin = all.iter().any(|c| c.name() == callback.name());
            ensure(!twin, "spec", &key, format!("another {:?}", callback.name()), "each callback once")?;
            all.push(callback);
        }
        Ok(all)
    }

    /// A run of `job` with its model as it begins, or as a checkpoint has it. `needed` are the encoder's channels that the
    /// scan needs, if it does not need all.
    fn begin<'a>(
        &self,
        job: &'a Job<'a>,
        scene: &'a Scene,
        steps_an_epoch: u64,
        (pipeline, needed): (Pipeline, Option<Vec<usize>>),
        observer: &'a mut dyn Observer,
    ) -> Result<Run<'a>> {
        let volume = job.spec.initializer.as_ref().map(|i| i.volume()).transpose()?.flatten();
        let fills_weights = job.spec.initializer.as_ref().filter(|_| volume.is_none());
        let initializer = fills_weights.map(|i| i.build(job.weights)).transpose()?;
        let mut model = Model::random(pipeline, job.seed);
        if let Some(resume) = job.resume {
            resume.restore(&mut model)?;
        } else {
            if let Some(i) = initializer {
                let report = i.apply(model.pipeline.layout(), &mut model.arena)?;
                let (loaded, all) = (report.loaded.len(), report.loaded.len() + report.fresh.len());
                if loaded > 0 {
                    observer.note(&format!("loaded {loaded} of {all} tensors"));
                }
            }
            if let Some(keep) = needed {
                model.mask(keep)?;
            }
        }
        let (mut exe, explain) = job.backend.compile(&model.pipeline)?;
        observer.note(&explain.backend);
        if let (Some(from), None) = (&volume, job.resume) {
            let known = start_volume(job, &from.path)?;
            learn(self, exe.as_mut(), &mut model, (&known, scene), from.steps, job, observer)?;
            observer.note(&format!("learned {} in {} steps", from.path, from.steps));
        }
        let by_epochs = self.epochs.map(|e| (e * steps_an_epoch as f64).ceil() as u64);
        let steps = [self.steps, by_epochs].into_iter().flatten().min();
        let spent = job.resume.map_or(0.0, |r| r.standing.seconds);
        let clock = Clock::new(Ends { steps, seconds: self.seconds }, job.limits, spent);
        let (loss, report_every) = (self.loss.into(), self.report_every);
        Ok(Run { clock, loss, steps_an_epoch, report_every, ..Run::new(job, scene, observer, model, exe) })
    }
}

/// Learns from the rays of a scan.
struct Rays<'a> {
    settings: &'a Gradient,
    source: RaySource<'a>,
    scene: &'a Scene,
    rays: Vec<TrainRay>,
    tv: TvBlocks,
}

impl Task for Rays<'_> {
    fn draw(&mut self, seed: u64, step: u64) -> Work<'_> {
        let Self { settings, source, scene, rays, tv } = self;
        source.draw(seed, step, settings.rays, rays);
        let tv = settings.tv.as_ref().map(|prior| {
            blocks(prior, scene, seed, step, tv);
            &*tv
        });
        Work { step, seed, loss: settings.loss.into(), rays, points: &[], tv, occupancy: None }
    }

    fn adam(&self, epoch: f64, share: f64) -> Adam {
        self.settings.adam(1, epoch, share)
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
