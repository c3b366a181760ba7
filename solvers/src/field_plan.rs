//! The plan of methods that train a field by stochastic gradients.
//!
//! Every step draws rays, compares their integrals with the measurement by a loss (L1 in the published codes), adds the
//! priors on small random blocks of neighbouring points, and takes an Adam step.

use crate::fit::{Fitted, fit};
use crate::iterative::known_volume;
use crate::iterative::noise::{self, Noise};
use crate::losses::L1;
use crate::neural_field::NeuralField;
use crate::optimizer::Optimizer;
use crate::pretrain::{Pretraining, learn, pretrain};
use crate::priors::Places;
use crate::rays::{Pixels, RayChoice, RaySource, Views, Windows};
use crate::schedule::{Clock, Ends};
use crate::solid;
use crate::surround::{self, Corrected};
use crate::training::callbacks::{FieldMonitor, LiveSlices, Rollback};
use crate::training::run::Tally;
use crate::training::{Callback, CallbackSpec, Callbacks, Draw, Run, Task, checkpoint, train};
use conefield_core::arena::Weights;
use conefield_core::backend::{Adam, Executable, TrainRay};
use conefield_core::error::{Result, ensure};
use conefield_core::loss::{Loss, NoiseModel};
use conefield_core::method::{
    Context, Findings, Job, Line, Needs, Observer, Outline, Plan, PretrainJob, Reconstruction, Solution, StageLine,
};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::prior::Prior;
use conefield_core::registry::Registered;
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::scene::{Scene, SceneSettings};
use conefield_core::settings::{Initializer, InitializerSpec, LossSpec};
use conefield_core::trained::{FieldVoxels, Placement, TrainedField};
use conefield_fields::initializers::random::Random;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

impl NeuralField {
    /// Builds the remaining parts and compiles `pipeline`. `stages` describes its stages, `beside` everything else.
    pub(crate) fn train(
        &self,
        pipeline: Pipeline,
        stages: Vec<StageLine>,
        mut beside: Vec<Line>,
        context: &Context<'_>,
    ) -> Result<Box<dyn Plan>> {
        self.scene.validate()?;
        self.optimizer.validate().map_err(|e| e.within("optimizer"))?;
        self.training.validate().map_err(|e| e.within("training"))?;
        self.pretraining.validate().map_err(|e| e.within("pretraining"))?;
        let callbacks = build_callbacks(&self.callbacks)?;
        for (i, callback) in callbacks.iter().enumerate() {
            callback.check(&pipeline).map_err(|e| e.within(&format!("callbacks.{i}")))?;
        }
        let loss = self.loss.build().map_err(|e| e.within("loss"))?;
        let mut priors = vec![];
        for (i, spec) in self.priors.iter().enumerate() {
            let prior = spec.build().and_then(|p| p.blocks().validate().map(|()| p));
            priors.push(prior.map_err(|e| e.within(&format!("priors.{i}")))?);
        }
        let none = |_: &str| Ok(Weights::default());
        let read: &dyn Fn(&str) -> Result<Weights> = if context.reads_weights { context.weights } else { &none };
        let initializer = self.initializer.build(read).map_err(|e| e.within("initializer"))?;
        if context.reads_weights {
            initializer.check(pipeline.layout()).map_err(|e| e.within("initializer"))?;
        }
        let (exe, compiled) = context.backend.compile(&pipeline)?;
        exe.admits(loss.as_ref(), &priors)?;
        beside.push(Line::new("initializer", self.initializer.type_name(), &initializer.describe()));
        beside.push(Line::new("loss", self.loss.type_name(), &loss.describe()));
        for (i, (p, spec)) in priors.iter().zip(&self.priors).enumerate() {
            beside.push(Line::new(&format!("priors.{i}"), spec.type_name(), &p.describe()));
        }
        for (i, (c, spec)) in callbacks.iter().zip(&self.callbacks).enumerate() {
            let said = c.describe().unwrap_or_default();
            beside.push(Line::new(&format!("callbacks.{i}"), spec.type_name(), &said));
        }
        let parameters = pipeline.layout().len() as u64;
        let kept = callbacks.iter().map(|c| c.bytes(parameters)).sum();
        let held_out = callbacks.iter().position(|c| c.needs_held_out()).map(|i| format!("callbacks.{i}"));
        let what = format!("{} rays per step, Adam {}", self.training.rays, self.optimizer.lr);
        let method = Line::new("method", self.type_name(), &what);
        Ok(Box::new(FieldPlan {
            scene: self.scene.clone(),
            optimizer: self.optimizer.clone(),
            training: self.training.clone(),
            pretraining: self.pretraining.clone(),
            callback_settings: self.callbacks.clone(),
            pipeline,
            initializer,
            loss: Arc::from(loss),
            priors,
            callbacks: Some(callbacks),
            kept,
            held_out,
            compiled: Some(exe),
            outline: Outline { method, stages, beside, compiled: Some(compiled), links: vec![] },
        }))
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

/// Builds the callbacks of the settings. Refuses duplicates.
pub(crate) fn build_callbacks(settings: &[Box<dyn CallbackSpec>]) -> Result<Vec<Box<dyn Callback>>> {
    let mut all: Vec<Box<dyn Callback>> = vec![];
    for (i, spec) in settings.iter().enumerate() {
        let key = format!("callbacks.{i}");
        let callback = spec.build().map_err(|e| e.within(&key))?;
        let twin = all.iter().any(|c| c.name() == callback.name());
        ensure(!twin, "spec", &key, format!("another {:?}", callback.name()), "each callback once")?;
        all.push(callback);
    }
    Ok(all)
}

/// Maximum number of rays that a loss is fitted to, unless one step has more.
const DRAWN: u64 = 1 << 16;

/// The plan of a trained field.
struct FieldPlan {
    scene: SceneSettings,
    optimizer: Optimizer,
    training: Training,
    pretraining: Pretraining,
    callback_settings: Vec<Box<dyn CallbackSpec>>,
    pipeline: Pipeline,
    initializer: Box<dyn Initializer>,
    loss: Arc<dyn Loss>,
    priors: Vec<Box<dyn Prior>>,
    /// Callbacks of the first run. Later runs build their own, because callbacks keep state.
    callbacks: Option<Vec<Box<dyn Callback>>>,
    /// Bytes held by callbacks.
    kept: u64,
    /// The key of the callback that needs held-out views.
    held_out: Option<String>,
    /// Compiled stages for the first run, unless the scan changes the stages.
    compiled: Option<Box<dyn Executable>>,
    outline: Outline,
}

impl Plan for FieldPlan {
    fn outline(&self) -> Outline {
        self.outline.clone()
    }

    fn needs(&self, scan: &ScanHeader) -> Needs {
        let n = self.pipeline.layout().len() as u64;
        let kept = self.kept;
        let backend = self.outline.backend().scratch_bytes as u64;
        let learning = if self.loss.needs_scan() { noise::scratch(scan) } else { 0 };
        let known = if self.initializer.volume().is_some() { 8 * scan.voxels() } else { 0 };
        let [surround, corrected] = surround::bytes(self.scene.surround, scan);
        Needs {
            surround,
            corrected: corrected + solid::bytes(&self.scene.support, scan),
            model: 8 * n,
            optimizer: 8 * n + kept,
            backend,
            working: RaySource::bytes(scan, self.training.windows) + learning + known,
            // Parameters and moments from the file, those that callbacks keep, and a copy of one of them while it is
            // loaded into the model.
            resume: 16 * n + kept,
            volume: false,
            evaluating: backend + FieldVoxels::BYTES,
        }
    }

    fn inspect(&self, scan: &Scan) -> Result<Findings> {
        let mut pipeline = self.pipeline.clone();
        let fitted = fit(scan, &self.scene, None, &mut pipeline)?;
        let (scene, g) = (fitted.scene, &scan.geometry);
        let mut lines = surround::found(scan, self.scene.surround)?;
        lines.extend(fitted.found);
        let middle = scene.pixel_ray(g, 0, g.detector[0] / 2, g.detector[1] / 2);
        Ok(Findings {
            lines,
            attenuation: Some(scene.attenuation * scan.unit.mm),
            samples: Some(pipeline.projector.max_samples(&middle)),
        })
    }

    fn run(&mut self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        job.scan.validate("scan")?;
        let mut pipeline = self.pipeline.clone();
        let Fitted { scene, solid, needed, found, changed } =
            fit(job.scan, &self.scene, Some(job.volumes), &mut pipeline)?;
        found.iter().for_each(|line| observer.note(line));
        let corrected = Corrected::of(job, self.scene.surround, solid.as_ref(), observer)?;
        let job = &Corrected::job(corrected.as_ref(), job);
        let Training { views, pixels, margin, windows, .. } = self.training;
        let source = RaySource::new(job.scan, &scene, &pipeline, RayChoice { views, pixels, margin, windows })?;
        observer.note(&format!("training uses {:.0}% of the pixels", 100.0 * source.share()));
        if let Some(whole) = source.whole_windows() {
            let none = if whole == 0 { ": all rays are single pixels" } else { "" };
            observer.note(&format!("windows whose pixels are all used for training: {whole} in all views{none}"));
        }
        let fitted = self.fitted_loss(job, &scene, &source);
        if let Some(loss) = &fitted {
            observer.note(&format!("loss: {}", loss.describe()));
        }
        let mut callbacks = match self.callbacks.take() {
            Some(callbacks) => callbacks,
            None => build_callbacks(&self.callback_settings)?,
        };
        callbacks.insert(0, Box::new(FieldMonitor::new(job, &scene, &pipeline)));
        callbacks.push(Box::new(LiveSlices));
        let mut callbacks = Callbacks(callbacks);
        let compiled = self.compiled.take().filter(|_| !changed && needed.is_none());
        let loss = fitted.unwrap_or_else(|| self.loss.clone());
        let begun = self.begin(job, &scene, (pipeline, needed, compiled), observer)?;
        let mut run = Run {
            job,
            scene: &scene,
            observer,
            model: begun.0,
            exe: begun.1,
            clock: self.clock(job, source.steps_an_epoch()),
            loss: loss.clone(),
            steps_an_epoch: source.steps_an_epoch(),
            report_every: self.training.report_every,
            step: 0,
            samples: 0,
            tally: Tally::default(),
            settled: false,
            best: None,
        };
        if let Some(resume) = job.resume {
            checkpoint::restore(&mut run, &mut callbacks, resume)?;
            run.observer.note(&format!("resumed after step {}", run.step));
        }
        let mut task = Rays {
            optimizer: &self.optimizer,
            count: self.training.rays,
            source,
            scene: &scene,
            loss: loss.as_ref(),
            rays: vec![],
            next: (None, vec![]),
            places: Places::new(&self.priors),
        };
        train(&mut run, &mut task, &mut callbacks)?;
        let Run { model, clock, step, samples, tally, best, .. } = run;
        let (train_s, rollbacks) = (clock.seconds(), tally.rollbacks);
        let result = Reconstruction::Field(TrainedField { model, scene: scene.clone(), unit_mm: job.scan.unit.mm });
        Ok(Solution { result, steps: step, train_s, samples, sampling_s: train_s, rollbacks, best })
    }

    fn pretrain(&mut self, job: &PretrainJob<'_>, observer: &mut dyn Observer) -> Result<Model> {
        let compiled = match self.compiled.take() {
            Some(exe) => exe,
            None => job.backend.compile(&self.pipeline)?.0,
        };
        observer.note(&self.outline.backend().backend);
        let learning = (&self.optimizer, &self.pretraining, self.training.report_every);
        pretrain((self.pipeline.clone(), compiled), learning, &self.scene, job, observer)
    }

    fn restore(&self, placement: &Placement, load: &mut dyn FnMut(&mut Model) -> Result<()>) -> Result<TrainedField> {
        TrainedField::restore(self.pipeline.clone(), &self.scene, placement, load)
    }

    fn pipeline(&self) -> Option<&Pipeline> {
        Some(&self.pipeline)
    }

    fn needs_held_out(&self) -> Option<String> {
        self.held_out.clone()
    }
}

impl FieldPlan {
    /// The loss fitted to the scan, if it depends on the scan.
    fn fitted_loss(&self, job: &Job<'_>, scene: &Scene, source: &RaySource<'_>) -> Option<Arc<dyn Loss>> {
        if !self.loss.needs_scan() {
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
        self.loss.fitted(&noise).map(Arc::from)
    }

    fn clock(&self, job: &Job<'_>, steps_an_epoch: u64) -> Clock {
        let Training { epochs, steps, seconds, .. } = self.training;
        let by_epochs = epochs.map(|e| (e * steps_an_epoch as f64).ceil() as u64);
        let steps = [steps, by_epochs].into_iter().flatten().min();
        let spent = job.resume.map_or(0.0, |r| r.standing.seconds);
        Clock::new(Ends { steps, seconds }, job.limits, spent)
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
            let learning = (&self.optimizer, &self.pretraining);
            learn(learning, exe.as_mut(), &mut model, (&volume, scene), steps, job, observer)?;
            observer.note(&format!("learned {from} in {steps} steps"));
        }
        Ok((model, exe))
    }
}

/// Training on the rays of a scan.
struct Rays<'a> {
    optimizer: &'a Optimizer,
    count: usize,
    source: RaySource<'a>,
    scene: &'a Scene,
    loss: &'a dyn Loss,
    rays: Vec<TrainRay>,
    /// The rays of the next step, with its number if they are drawn.
    next: (Option<u64>, Vec<TrainRay>),
    places: Places<'a>,
}

impl Task for Rays<'_> {
    fn draw(&mut self, seed: u64, step: u64) -> Draw<'_> {
        let Self { count, source, scene, loss, rays, next, places, .. } = self;
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
        Draw { loss: *loss, rays, priors: places.draw(scene, seed, step), ahead }
    }

    fn adam(&self, epoch: f64, share: f64) -> Adam {
        self.optimizer.adam(1, epoch, share)
    }
}
