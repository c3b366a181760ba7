//! What the plans of trained fields share, whatever the field and its data.

use crate::fit::fit;
use crate::optimizer::Optimizer;
use crate::solid;
use crate::surround;
use crate::training::callbacks::{FieldMonitor, LiveSlices};
use crate::training::{Callback, CallbackSpec, Callbacks, Run, Task, checkpoint, train};
use conefield_core::error::{Result, ensure};
use conefield_core::loss::Loss;
use conefield_core::method::{Findings, Job, Line, Needs, Outline, Reconstruction, Solution};
use conefield_core::pipeline::Pipeline;
use conefield_core::prior::Prior;
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::scene::{Scene, SceneSettings};
use conefield_core::settings::{LossSpec, PriorSpec};
use conefield_core::trained::{FieldVoxels, TrainedField};
use std::sync::Arc;

/// The parts of a plan that trains a field.
pub(crate) struct FieldParts {
    pub scene: SceneSettings,
    pub optimizer: Optimizer,
    pub pipeline: Pipeline,
    pub loss: Arc<dyn Loss>,
    pub priors: Vec<Box<dyn Prior>>,
    callback_settings: Vec<Box<dyn CallbackSpec>>,
    /// Callbacks of the first run. Later runs build their own, because callbacks keep state.
    callbacks: Option<Vec<Box<dyn Callback>>>,
    /// Bytes held by callbacks.
    pub kept: u64,
    /// The key of the callback that needs held-out views.
    pub held_out: Option<String>,
}

impl FieldParts {
    /// Builds the parts of these settings, and their lines for `explain`.
    pub fn build(
        scene: &SceneSettings,
        optimizer: &Optimizer,
        pipeline: Pipeline,
        loss: &dyn LossSpec,
        priors: &[Box<dyn PriorSpec>],
        callback_settings: &[Box<dyn CallbackSpec>],
    ) -> Result<(Self, Vec<Line>)> {
        scene.validate()?;
        optimizer.validate().map_err(|e| e.within("optimizer"))?;
        let callbacks = build_callbacks(callback_settings)?;
        for (i, callback) in callbacks.iter().enumerate() {
            callback.check(&pipeline).map_err(|e| e.within(&format!("callbacks.{i}")))?;
        }
        let built = loss.build().map_err(|e| e.within("loss"))?;
        let mut lines = vec![Line::new("loss", loss.type_name(), &built.describe())];
        let loss = Arc::from(built);
        let mut built = vec![];
        for (i, spec) in priors.iter().enumerate() {
            let key = format!("priors.{i}");
            let prior = spec.build().and_then(|p| p.blocks().validate().map(|()| p));
            let prior = prior.map_err(|e| e.within(&key))?;
            lines.push(Line::new(&key, spec.type_name(), &prior.describe()));
            built.push(prior);
        }
        for (i, (c, spec)) in callbacks.iter().zip(callback_settings).enumerate() {
            let said = c.describe().unwrap_or_default();
            lines.push(Line::new(&format!("callbacks.{i}"), spec.type_name(), &said));
        }
        let parameters = pipeline.layout().len() as u64;
        let parts = Self {
            scene: scene.clone(),
            optimizer: optimizer.clone(),
            pipeline,
            loss,
            priors: built,
            callback_settings: callback_settings.to_vec(),
            kept: callbacks.iter().map(|c| c.bytes(parameters)).sum(),
            held_out: callbacks.iter().position(|c| c.needs_held_out()).map(|i| format!("callbacks.{i}")),
            callbacks: Some(callbacks),
        };
        Ok((parts, lines))
    }

    /// Memory for a scan, with `working` bytes for the data of training.
    pub fn needs(&self, scan: &ScanHeader, outline: &Outline, working: u64) -> Needs {
        let n = self.pipeline.layout().len() as u64;
        let backend = outline.backend().scratch_bytes as u64;
        let [surround, corrected] = surround::bytes(self.scene.surround, scan);
        Needs {
            surround,
            corrected: corrected + solid::bytes(&self.scene.support, scan),
            model: 8 * n,
            optimizer: 8 * n + self.kept,
            backend,
            working,
            // Parameters and moments from the file, those that callbacks keep, and a copy of one of them while it is
            // loaded into the model.
            resume: 16 * n + self.kept,
            volume: false,
            evaluating: backend + FieldVoxels::BYTES,
        }
    }

    /// Analyses a scan. A field with line integrals of its own has no samples.
    pub fn inspect(&self, scan: &Scan) -> Result<Findings> {
        let mut pipeline = self.pipeline.clone();
        let fitted = fit(scan, &self.scene, None, &mut pipeline)?;
        let (scene, g) = (fitted.scene, &scan.geometry);
        let mut lines = surround::found(scan, self.scene.surround)?;
        lines.extend(fitted.found);
        lines.extend(fitted.doubt);
        let middle = scene.pixel_ray(g, 0, g.detector[0] / 2, g.detector[1] / 2);
        let samples = pipeline.field.lines().is_none().then(|| pipeline.projector.max_samples(&middle));
        Ok(Findings { lines, attenuation: Some(scene.attenuation * scan.unit.mm), samples })
    }

    /// The callbacks of a run: metrics first, then those of the settings and `own`, live slices last.
    pub fn callbacks(
        &mut self,
        job: &Job<'_>,
        scene: &Scene,
        pipeline: &Pipeline,
        own: Option<Box<dyn Callback>>,
    ) -> Result<Callbacks> {
        let mut all: Vec<Box<dyn Callback>> = vec![Box::new(FieldMonitor::new(job, scene, pipeline))];
        all.extend(match self.callbacks.take() {
            Some(callbacks) => callbacks,
            None => build_callbacks(&self.callback_settings)?,
        });
        all.extend(own);
        all.push(Box::new(LiveSlices));
        Ok(Callbacks(all))
    }
}

/// Builds the callbacks of the settings. Refuses duplicates.
fn build_callbacks(settings: &[Box<dyn CallbackSpec>]) -> Result<Vec<Box<dyn Callback>>> {
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

/// Trains a run, from its checkpoint if it is resumed, to its end.
pub(crate) fn complete(mut run: Run<'_>, task: &mut dyn Task, mut callbacks: Callbacks) -> Result<Solution> {
    if let Some(resume) = run.job.resume {
        checkpoint::restore(&mut run, &mut callbacks, resume)?;
        run.observer.note(&format!("resumed after step {}", run.step));
    }
    train(&mut run, task, &mut callbacks)?;
    let Run { job, scene, model, clock, step, samples, tally, best, .. } = run;
    let (train_s, rollbacks) = (clock.seconds(), tally.rollbacks);
    let result = Reconstruction::Field(TrainedField { model, scene: scene.clone(), unit_mm: job.scan.unit.mm });
    Ok(Solution { result, steps: step, train_s, samples, sampling_s: train_s, rollbacks, best })
}
