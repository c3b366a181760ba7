//! A solver: scan in, volume out.

use crate::arena::Weights;
use crate::backend::Backend;
use crate::checkpoint::{Checkpoint, Resume};
use crate::error::{Error, Result};
use crate::parts::Voxels;
use crate::pipeline::Model;
use crate::scan::{Scan, Volume};
use crate::spec::{SceneSettings, Spec};
use crate::trained::TrainedField;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// What a solver works on.
#[derive(Clone, Copy)]
pub struct Job<'a> {
    /// Views to learn from.
    pub scan: &'a Scan,
    /// Views kept aside, whose error is reported.
    pub held_out: Option<&'a Scan>,
    /// The volume sought, if known; it is only looked at, never learned from.
    pub reference: Option<&'a Volume>,
    /// The value that PSNR takes for the reference's full range.
    pub peak: f64,
    /// The whole spec.
    pub spec: &'a Spec,
    /// Does the work.
    pub backend: &'a dyn Backend,
    /// Seed of everything random.
    pub seed: u64,
    /// Limits that the command line adds to the spec's.
    pub limits: Limits,
    /// Reads a weights file that the spec names.
    pub weights: &'a dyn Fn(&str) -> Result<Weights>,
    /// Reads a volume that the spec names, in 1/unit of the scan.
    pub volumes: &'a dyn Fn(&str) -> Result<Volume>,
    /// Where an earlier run of the same job stood, to go on from.
    pub resume: Option<&'a Resume>,
}

impl<'a> Job<'a> {
    /// A job with nothing beside what every one has: no views kept aside, no reference (and a peak of 1), no limits, seed 0,
    /// and no files that the spec may name.
    pub fn new(scan: &'a Scan, spec: &'a Spec, backend: &'a dyn Backend) -> Self {
        Self {
            scan,
            held_out: None,
            reference: None,
            peak: 1.0,
            spec,
            backend,
            seed: 0,
            limits: Limits::default(),
            weights: &no_weights,
            volumes: &no_volumes,
            resume: None,
        }
    }
}

fn no_weights(path: &str) -> Result<Weights> {
    Err(Error::unsupported(path, "this job reads no weights"))
}

fn no_volumes(path: &str) -> Result<Volume> {
    Err(Error::unsupported(path, "this job reads no volumes"))
}

/// When to stop, whichever comes first.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Limits {
    /// Steps (iterations).
    pub steps: Option<u64>,
    /// Seconds of training.
    pub seconds: Option<f64>,
    /// Seconds of training at the latest. What follows the run's end, such as a learning rate, does not look at it.
    pub at_most: Option<f64>,
    /// When training is to be over by the clock on the wall, whatever happens beside it. Solvers that cannot stop anywhere
    /// stop before they would pass it.
    pub deadline: Option<Instant>,
    /// The same for what goes on after the training, of a solver that is a [`Successor`] of another one.
    pub then: Option<Instant>,
}

/// One line of `metrics.jsonl`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Record {
    /// Finished steps.
    pub step: u64,
    /// Seconds of training so far (evaluation and export left out).
    pub seconds: f64,
    /// Mean loss since the last record; of solvers on voxels, the root mean square of the residual `p − A·x`. FDK has none.
    pub loss: Option<f64>,
    /// Mean weighted prior since the last record.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prior: Option<f64>,
    /// Learning rate, of solvers that have one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lr: Option<f64>,
    /// Training samples a second since the last record, of solvers that take samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples_per_s: Option<f64>,
    /// Root mean square change of the volume by this pass over its root mean square, of solvers on voxels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change: Option<f64>,
    /// Root mean square error of the held-out views' line integrals, over their largest value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out: Option<f64>,
    /// PSNR against the reference over one voxel, drawn, of each block of 4³, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr: Option<f64>,
    /// Drift found since the last record, of a spec with `solver.drift`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub drift: Vec<DriftRecord>,
    /// What else happened since the last record, e.g. channels masked.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub events: Vec<String>,
}

/// How much normalizers and field have changed under the same features.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriftRecord {
    /// Finished steps when features were recorded.
    pub from_step: u64,
    /// Finished steps when they were evaluated again.
    pub step: u64,
    /// Finished passes over the views by then.
    pub epoch: f64,
    /// Mean absolute difference of the attenuation, in the scale that stages see.
    pub mean_l1: f64,
}

/// Hears of a run's progress and may stop it.
pub trait Observer {
    /// After every step: finished share in [0, 1] and the seconds left by the solver's own estimate.
    fn progress(&mut self, step: u64, share: f64, seconds_left: f64);
    /// A record is due.
    fn record(&mut self, record: &Record);
    /// A sentence for the log.
    fn note(&mut self, text: &str);
    /// Whether to stop after this step, with [`crate::Error::Interrupted`].
    fn cancelled(&self) -> bool {
        false
    }
    /// Whether it is time to call [`Observer::checkpoint`].
    fn checkpoint_due(&self) -> bool {
        false
    }
    /// Keeps a checkpoint: when one is due, and before an interrupted run ends.
    fn checkpoint(&mut self, checkpoint: &Checkpoint<'_>) -> Result<()> {
        let _ = checkpoint;
        Ok(())
    }
}

/// Hears nothing.
pub struct Silent;

impl Observer for Silent {
    fn progress(&mut self, _: u64, _: f64, _: f64) {}
    fn record(&mut self, _: &Record) {}
    fn note(&mut self, _: &str) {}
}

/// What came out of a scan, in 1/unit of it.
pub enum Reconstruction {
    /// Voxels.
    Volume(Volume),
    /// A field that can be evaluated on any grid.
    Field(TrainedField),
    /// Voxels that a solver made of a field's, and that field.
    Refined {
        /// What came out.
        volume: Volume,
        /// What it was made of.
        field: Box<TrainedField>,
    },
}

impl Reconstruction {
    /// The voxels that the scan asks for, part by part; a field is evaluated by `backend`.
    pub fn voxels<'a>(&'a self, backend: &dyn Backend) -> Result<Box<dyn Voxels + 'a>> {
        Ok(match self {
            Self::Volume(volume) | Self::Refined { volume, .. } => Box::new(volume),
            Self::Field(field) => Box::new(field.voxels(backend, field.scene.grid)?),
        })
    }

    /// The voxels that the scan asks for, all at once.
    pub fn volume(&self, backend: &dyn Backend) -> Result<Volume> {
        Volume::collect(self.voxels(backend)?.as_mut())
    }

    /// The field, of solvers that train one.
    pub fn field(&self) -> Option<&TrainedField> {
        match self {
            Self::Volume(_) => None,
            Self::Field(field) => Some(field),
            Self::Refined { field, .. } => Some(field),
        }
    }
}

/// What a solver made.
pub struct Solution {
    /// What came out.
    pub result: Reconstruction,
    /// Steps done.
    pub steps: u64,
    /// Seconds of training.
    pub train_s: f64,
    /// Training samples.
    pub samples: u64,
    /// Seconds of `train_s` that they took; another solver that goes on in voxels takes none.
    pub sampling_s: f64,
    /// Times that training ran away and went back to an earlier state.
    pub rollbacks: u64,
    /// The record whose state came out, where views that are kept aside chose it.
    pub best: Option<Best>,
}

/// A record that predicted views that are kept aside best.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Best {
    /// Its [`Record::step`].
    pub step: u64,
    /// Its [`Record::held_out`].
    pub held_out: f64,
}

/// Scan in, reconstruction out.
pub trait Solver: Send + Sync {
    /// Does the whole job.
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution>;

    /// Trains the spec's field on a known volume, voxel by voxel, for weights that other scans reuse.
    fn pretrain(&self, job: &PretrainJob<'_>, observer: &mut dyn Observer) -> Result<Model> {
        let _ = (job, observer);
        Err(Error::unsupported(self.describe(), "this solver has nothing to pre-train"))
    }

    /// Whether it trains a field of the spec's stages; otherwise it makes voxels and needs none. Refuses a spec with
    /// stages that it would pass over. Of a solver that does not say, the spec tells.
    fn trains_field(&self, spec: &Spec) -> Result<bool> {
        Ok(spec.encoder.is_some() || spec.field.is_some())
    }

    /// The setting that looks at views kept aside, if there is one: it is without effect in a job that has none.
    fn needs_held_out(&self) -> Option<&'static str> {
        None
    }

    /// What it will do with this scan, a line each, for `explain`.
    fn plan(&self, scan: &Scan) -> Vec<String> {
        let _ = scan;
        vec![]
    }

    /// Bytes that it holds at most while it makes `voxels` of `pixels` measured values, beside scan, model, backend and the
    /// volume that comes out: directions, residuals, lists of rays.
    fn working_memory(&self, pixels: u64, voxels: u64) -> u64 {
        let _ = (pixels, voxels);
        0
    }

    /// Bytes that it holds for each parameter of the field, beside model and optimizer.
    fn memory_per_parameter(&self) -> u64 {
        0
    }

    /// Of a solver that lets another one go on where the first ended: the two. `scene` is that of the spec.
    fn successor(&self, scene: &SceneSettings) -> Option<Successor<'_>> {
        let _ = scene;
        None
    }

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// A solver that goes on where another one ended.
pub struct Successor<'a> {
    /// The one that begins.
    pub first: &'a dyn Solver,
    /// The one that goes on.
    pub then: &'a dyn Solver,
    /// What that one is given as its spec; its initializer brings the first one's volume, through [`Job::volumes`].
    pub spec: Spec,
    /// Its steps at most.
    pub passes: u64,
}

/// What pre-training works on.
pub struct PretrainJob<'a> {
    /// The known volumes, in any unit of attenuation.
    pub volumes: &'a [Volume],
    /// The whole spec.
    pub spec: &'a Spec,
    /// Does the work.
    pub backend: &'a dyn Backend,
    /// Seed of everything random.
    pub seed: u64,
    /// Limits that the command line adds to the spec's.
    pub limits: Limits,
}
