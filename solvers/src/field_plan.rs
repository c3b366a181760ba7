//! The plan of a neural field, which is trained by stochastic gradients.
//!
//! Every step draws rays, compares their integrals with the measurement by a loss (L1 in the published codes), adds the
//! priors on small random blocks of neighbouring points, and takes an Adam step.

use crate::field_parts::{FieldParts, complete};
use crate::fit::{Fitted, fit};
use crate::iterative::known_volume;
use crate::iterative::noise::{self, Noise};
use crate::losses::L1;
use crate::neural_field::NeuralField;
use crate::pretrain::{Pretraining, learn, pretrain};
use crate::priors::Places;
use crate::rays::{Pixels, RaySource, Views, Windows};
use crate::schedule::Clock;
use crate::surround::Corrected;
use crate::training::callbacks::Rollback;
use crate::training::{CallbackSpec, Draw, Run, Task};
use conefield_core::arena::Weights;
use conefield_core::backend::{Executable, TrainRay};
use conefield_core::error::{Result, ensure};
use conefield_core::loss::{Loss, NoiseModel};
use conefield_core::method::{
    Context, Findings, Job, Limits, Line, Method, Needs, Observer, Outline, Plan, PretrainJob, Solution, StageLine,
    StartFile,
};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::registry::Registered;
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::scene::Scene;
use conefield_core::settings::{Initializer, InitializerSpec, LossSpec};
use conefield_core::trained::{Placement, TrainedField};
use conefield_core::words::counted;
use conefield_fields::initializers::mci::Mci;
use conefield_fields::initializers::random::Random;
use conefield_fields::initializers::volume::FromVolume;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

impl Method for NeuralField {
    fn plan(&self, context: &Context<'_>) -> Result<Box<dyn Plan>> {
        let pipeline = self.pipeline()?;
        let mut stages = vec![StageLine::new("encoder", self.encoder.type_name(), pipeline.encoder.as_ref())];
        for (i, (n, spec)) in pipeline.normalizers.iter().zip(&self.normalizers).enumerate() {
            stages.push(StageLine::new(&format!("normalizers.{i}"), spec.type_name(), n.as_ref()));
        }
        stages.push(StageLine::new("field", self.field.type_name(), pipeline.field.as_ref()));
        let mut beside = vec![Line::new("projector", self.projector.type_name(), &pipeline.projector.describe())];
        let Self { scene, optimizer, loss, priors, callbacks, .. } = self;
        let (parts, lines) = FieldParts::build(scene, optimizer, pipeline, loss.as_ref(), priors, callbacks)?;
        self.training.validate().map_err(|e| e.within("training"))?;
        self.pretraining.validate().map_err(|e| e.within("pretraining"))?;
        let none = |_: &str| Ok(Weights::default());
        let read: &dyn Fn(&str) -> Result<Weights> = if context.reads_weights { context.weights } else { &none };
        let initializer = self.initializer.build(read).map_err(|e| e.within("initializer"))?;
        if context.reads_weights {
            initializer.check(parts.pipeline.layout()).map_err(|e| e.within("initializer"))?;
        }
        let (exe, compiled) = context.backend.compile(&parts.pipeline)?;
        exe.admits(parts.loss.as_ref(), &parts.priors)?;
        beside.push(Line::new("initializer", self.initializer.type_name(), &initializer.describe()));
        beside.extend(lines);
        let what = format!("{} rays per step, Adam {}", self.training.rays, self.optimizer.lr);
        let method = Line::new("method", self.type_name(), &what);
        Ok(Box::new(FieldPlan {
            parts,
            training: self.training.clone(),
            pretraining: self.pretraining.clone(),
            initializer,
            compiled: Some(exe),
            outline: Outline { method, stages, beside, compiled: Some(compiled), links: vec![] },
        }))
    }

    fn start_setting(&self, file: &StartFile) -> Option<(String, serde_json::Value)> {
        let initializer: Box<dyn InitializerSpec> = match file {
            StartFile::Weights(file) => Box::new(Mci { weights: file.clone() }),
            StartFile::Volume(file) => Box::new(FromVolume::new(file.clone())),
        };
        Some(("initializer".into(), serde_json::to_value(initializer).ok()?))
    }
}

/// The data of a step, and when training ends.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Training {
    /// Ends training after this many passes over the views.
    pub epochs: Option<f64>,
    /// Ends training after this many steps.
    pub steps: Option<u64>,
    /// Ends training after this many seconds. The first limit reached ends the run.
    pub seconds: Option<f64>,
    /// Rays per step.
    pub rays: usize,
    /// Views that a step takes its rays from.
    pub views: Views,
    /// Pixels that are used for training.
    pub pixels: Pixels,
    /// Pixels by which the support is widened.
    pub margin: usize,
    /// Takes some rays of each step from windows of neighbouring pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub windows: Option<Windows>,
    /// Most steps between two records of the metrics; a run has at least ten.
    pub report_every: u64,
}

impl Default for Training {
    fn default() -> Self {
        Self {
            epochs: None,
            steps: Some(1500),
            seconds: None,
            rays: 1024,
            views: Views::All,
            pixels: Pixels::Support,
            margin: 8,
            windows: None,
            report_every: 50,
        }
    }
}

impl Training {
    /// Refuses numbers that cannot be used, and a run without an end.
    pub fn validate(&self) -> Result<()> {
        ensure((1..=1 << 20).contains(&self.rays), "spec", "rays", self.rays, "1 to 2^20")?;
        ensure(self.margin <= 1024, "spec", "margin", self.margin, "at most 1024 pixels")?;
        ensure(self.report_every > 0, "spec", "report_every", 0, "at least 1")?;
        if let Some(windows) = self.windows {
            windows.validate(self.rays).map_err(|e| e.within("windows"))?;
        }
        let ends = self.epochs.is_some() || self.steps.is_some() || self.seconds.is_some();
        ensure(ends, "spec", "", "no end", "one of epochs, steps or seconds")?;
        ensure(self.steps != Some(0), "spec", "steps", 0, "at least 1: without a step the field stays untrained")?;
        for (name, end) in [("epochs", self.epochs), ("seconds", self.seconds)] {
            if let Some(x) = end {
                ensure(x.is_finite() && x > 0.0, "spec", name, x, "a positive finite number")?;
            }
        }
        Ok(())
    }
}

/// The default initializer.
pub(crate) fn random() -> Box<dyn InitializerSpec> {
    Box::new(Random {})
}

/// The default loss.
pub(crate) fn l1() -> Box<dyn LossSpec> {
    Box::new(L1 {})
}

/// The default callbacks.
pub(crate) fn rollback() -> Vec<Box<dyn CallbackSpec>> {
    vec![Box::new(Rollback::default())]
}

/// Maximum number of rays that a loss is fitted to, unless one step has more.
const DRAWN: u64 = 1 << 16;

/// The plan of a trained field.
struct FieldPlan {
    parts: FieldParts,
    training: Training,
    pretraining: Pretraining,
    initializer: Box<dyn Initializer>,
    /// Compiled stages for the first run, unless the scan changes the stages.
    compiled: Option<Box<dyn Executable>>,
    outline: Outline,
}

impl Plan for FieldPlan {
    fn outline(&self) -> Outline {
        self.outline.clone()
    }

    fn needs(&self, scan: &ScanHeader) -> Needs {
        let learning = if self.parts.loss.needs_scan() { noise::scratch(scan) } else { 0 };
        let known = if self.initializer.volume().is_some() { 8 * scan.voxels() } else { 0 };
        let working = RaySource::bytes(scan, self.training.windows) + learning + known;
        self.parts.needs(scan, &self.outline, working)
    }

    fn inspect(&self, scan: &Scan) -> Result<Findings> {
        self.parts.inspect(scan)
    }

    fn run(&mut self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        job.scan.validate("scan")?;
        let (mut pipeline, settings) = (self.parts.pipeline.clone(), &self.parts.scene);
        let Fitted { scene, solid, needed, found, doubt, changed } =
            fit(job.scan, settings, Some(job.volumes), &mut pipeline)?;
        found.iter().for_each(|line| observer.note(line));
        doubt.iter().for_each(|line| observer.warn(line));
        let corrected = Corrected::of(job, settings.surround, solid.as_ref(), observer)?;
        let job = &Corrected::job(corrected.as_ref(), job);
        let source = RaySource::new(job.scan, &scene, &pipeline, &self.training)?;
        observer.note(&format!("training uses {:.0}% of the pixels", 100.0 * source.share()));
        if let Some(whole) = source.whole_windows() {
            let none = if whole == 0 { ": all rays are single pixels" } else { "" };
            observer.note(&format!("windows whose pixels are all used for training: {whole} in all views{none}"));
        }
        let fitted = self.fitted_loss(job, &scene, &source);
        if let Some(loss) = &fitted {
            observer.note(&format!("loss: {}", loss.describe()));
        }
        let callbacks = self.parts.callbacks(job, &scene, &pipeline, None)?;
        let compiled = self.compiled.take().filter(|_| !changed && needed.is_none());
        let loss = fitted.unwrap_or_else(|| self.parts.loss.clone());
        let (model, exe) = self.begin(job, &scene, (pipeline, needed, compiled), observer)?;
        let run = Run {
            clock: self.clock(job, source.steps_an_epoch()),
            loss,
            optimizer: self.parts.optimizer.clone(),
            steps_an_epoch: source.steps_an_epoch(),
            report_every: self.training.report_every,
            ..Run::new(job, &scene, observer, model, exe)
        };
        let places = Places::new(&self.parts.priors);
        let count = self.training.rays;
        complete(run, &mut Rays { count, source, scene: &scene, rays: vec![], next: (None, vec![]), places }, callbacks)
    }

    fn pretrain(&mut self, job: &PretrainJob<'_>, observer: &mut dyn Observer) -> Result<Model> {
        let compiled = match self.compiled.take() {
            Some(exe) => exe,
            None => job.backend.compile(&self.parts.pipeline)?.0,
        };
        observer.note(&self.outline.backend().backend);
        let learning = (&self.parts.optimizer, &self.pretraining, self.training.report_every);
        pretrain((self.parts.pipeline.clone(), compiled), learning, &self.parts.scene, job, observer)
    }

    fn restore(&self, placement: &Placement, load: &mut dyn FnMut(&mut Model) -> Result<()>) -> Result<TrainedField> {
        TrainedField::restore(self.parts.pipeline.clone(), &self.parts.scene, placement, load)
    }

    fn pipeline(&self) -> Option<&Pipeline> {
        Some(&self.parts.pipeline)
    }

    fn needs_held_out(&self) -> Option<String> {
        self.parts.held_out.clone()
    }
}

impl FieldPlan {
    /// The loss fitted to the scan, if it depends on the scan.
    fn fitted_loss(&self, job: &Job<'_>, scene: &Scene, source: &RaySource<'_>) -> Option<Arc<dyn Loss>> {
        if !self.parts.loss.needs_scan() {
            return None;
        }
        let noise = Noise::of(job.scan.projections.view(), true);
        let (mut rays, mut measured) = (vec![], vec![]);
        let most = (DRAWN / self.training.rays as u64).max(1);
        for step in 0..source.steps_an_epoch().min(most) {
            source.draw(job.seed, step, self.training.rays, &mut rays);
            measured.extend(rays.iter().map(|r| f64::from(r.target)));
        }
        let line = scene.line_scale();
        let noise = NoiseModel { sigma: noise.sigma / line, growth: noise.growth * line, measured: &measured };
        self.parts.loss.fitted(&noise).map(Arc::from)
    }

    fn clock(&self, job: &Job<'_>, steps_an_epoch: u64) -> Clock {
        let Training { epochs, steps, seconds, .. } = self.training;
        let by_epochs = epochs.map(|e| (e * steps_an_epoch as f64).ceil() as u64);
        let steps = [steps, by_epochs].into_iter().flatten().min();
        let spent = job.resume.map_or(0.0, |r| r.standing.seconds);
        Clock::new(Limits { steps, seconds, ..Limits::default() }, job.limits, spent)
    }

    /// The initial model, or the model from a checkpoint, and its executable. `needed`: the encoder's channels that the
    /// scan needs, if not all. `compiled`: the compiled stages, if they still fit.
    fn begin(
        &self,
        job: &Job<'_>,
        scene: &Scene,
        (pipeline, needed, compiled): (Pipeline, Option<Vec<usize>>, Option<Box<dyn Executable>>),
        observer: &mut dyn Observer,
    ) -> Result<(Model, Box<dyn Executable>)> {
        let mut model = Model::random(pipeline, job.seed);
        if let Some(resume) = job.resume {
            resume.restore(&mut model)?;
        } else {
            let report = self.initializer.apply(model.pipeline.layout(), &mut model.arena)?;
            let (loaded, all) = (report.loaded.len(), report.loaded.len() + report.fresh.len());
            if loaded > 0 {
                observer.note(&format!("loaded {loaded} of {all} tensors"));
            }
            if let Some(keep) = needed {
                model.mask(keep)?;
            }
        }
        let mut exe = match compiled.filter(|_| model.masks().is_empty()) {
            Some(exe) => exe,
            None => job.backend.compile(&model.pipeline)?.0,
        };
        observer.note(&self.outline.backend().backend);
        if job.resume.is_none()
            && let Some((volume, steps, from)) = known_volume(job, self.initializer.volume())?
        {
            let learning = (&self.parts.optimizer, &self.pretraining);
            learn(learning, exe.as_mut(), &mut model, (&volume, scene), steps, job, observer)?;
            observer.note(&format!("learned {from} in {}", counted(steps, "step")));
        }
        Ok((model, exe))
    }
}

/// Training on the rays of a scan.
struct Rays<'a> {
    count: usize,
    source: RaySource<'a>,
    scene: &'a Scene,
    rays: Vec<TrainRay>,
    /// The rays of the next step, with its number if they are drawn.
    next: (Option<u64>, Vec<TrainRay>),
    places: Places<'a>,
}

impl Task for Rays<'_> {
    fn draw(&mut self, seed: u64, step: u64) -> Draw<'_> {
        let Self { count, source, scene, rays, next, places } = self;
        if next.0.take() == Some(step) {
            std::mem::swap(rays, &mut next.1);
        } else {
            source.draw(seed, step, *count, rays);
        }
        let (source, count) = (&*source, *count);
        let ahead = Box::new(move || {
            source.draw(seed, step + 1, count, &mut next.1);
            next.0 = Some(step + 1);
        });
        Draw { rays, priors: places.draw(scene, seed, step), ahead }
    }
}
