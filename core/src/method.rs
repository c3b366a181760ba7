//! Methods: scan in, volume out. A [`Method`] holds the settings of a spec; [`Method::plan`] builds it once into a
//! [`Plan`], which is explained, priced and run.

use crate::arena::Weights;
use crate::backend::{Backend, Explain};
use crate::checkpoint::{Checkpoint, Resume};
use crate::error::{Error, Result};
use crate::geometry::VoxelGrid;
use crate::input_file::InputFile;
use crate::parts::{Part, Voxels};
use crate::pipeline::{Model, Pipeline};
use crate::registry::Registered;
use crate::scan::{Scan, ScanHeader, Volume};
use crate::stage::{GradKind, Stage};
use crate::trained::{Placement, TrainedField};
use ndarray::Array3;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Inputs of a method.
#[derive(Clone, Copy)]
pub struct Job<'a> {
    /// Views to reconstruct from.
    pub scan: &'a Scan,
    /// Held-out views, for reporting their error.
    pub held_out: Option<&'a Scan>,
    /// The true volume, if known; used for evaluation only.
    pub reference: Option<&'a Volume>,
    /// The reference's full range in PSNR.
    pub peak: f64,
    /// The compute backend.
    pub backend: &'a dyn Backend,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Limits from the command line, in addition to the spec's.
    pub limits: Limits,
    /// Initial volume, in 1/unit of the scan. Takes precedence over one named in the method's settings.
    pub start: Option<&'a Volume>,
    /// Reads a volume named by the spec, in 1/unit of the scan.
    pub volumes: &'a (dyn Fn(&str) -> Result<Volume> + Sync),
    /// State of an earlier run of the same job to continue from.
    pub resume: Option<&'a Resume>,
}

impl<'a> Job<'a> {
    /// A job with defaults: no held-out views, no reference (and a peak of 1), no limits, seed 0, and no files for the
    /// spec.
    pub fn new(scan: &'a Scan, backend: &'a dyn Backend) -> Self {
        Self {
            scan,
            held_out: None,
            reference: None,
            peak: 1.0,
            backend,
            seed: 0,
            limits: Limits::default(),
            start: None,
            volumes: &|path| Err(Error::unsupported(path, "this job reads no volumes")),
            resume: None,
        }
    }
}

/// Limits of a run; the first one reached stops it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Limits {
    /// Seconds of training.
    pub seconds: Option<f64>,
    /// Steps (iterations).
    pub steps: Option<u64>,
    /// Upper bound of the training seconds. Schedules that depend on the end of the run, such as learning rates, ignore
    /// it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_most: Option<f64>,
    /// Wall-clock end of training. Methods that can stop only at certain points stop before they would pass it.
    #[serde(skip)]
    pub deadline: Option<Instant>,
    /// The same for the later methods of a chain.
    #[serde(skip)]
    pub then: Option<Instant>,
}

/// One line of `metrics.jsonl`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Record {
    /// Finished steps.
    pub step: u64,
    /// Seconds of training so far (without evaluation and export).
    pub seconds: f64,
    /// Mean loss since the last record; for iterative methods the root mean square of the residual `p − A·x`. None for
    /// FDK.
    pub loss: Option<f64>,
    /// Mean weighted prior since the last record.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prior: Option<f64>,
    /// Learning rate, for methods that have one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lr: Option<f64>,
    /// Training samples per second since the last record, for methods that take samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples_per_s: Option<f64>,
    /// Relative root mean square change of the volume in this pass, for iterative methods.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change: Option<f64>,
    /// Root mean square error of the held-out line integrals, relative to their largest value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out: Option<f64>,
    /// PSNR against the reference in dB, over one random voxel of each block of 4³.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr: Option<f64>,
    /// Drift found since the last record, if the spec has the callback `drift`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub drift: Vec<DriftRecord>,
    /// Other events since the last record, e.g. masked channels.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub events: Vec<String>,
}

/// Change of normalizers and field, measured on fixed features.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriftRecord {
    /// Finished steps when the features were recorded.
    pub from_step: u64,
    /// Finished steps when the features were evaluated again.
    pub step: u64,
    /// Finished passes over the views by then.
    pub epoch: f64,
    /// Mean absolute difference of the attenuation, in the scale of the stages.
    pub mean_l1: f64,
}

/// Receives the progress of a run and may stop it.
pub trait Observer {
    /// Called after every step, and within long ones, with the number of finished steps, the finished share in [0, 1]
    /// and the method's estimate of the seconds left.
    fn progress(&mut self, step: u64, share: f64, seconds_left: f64);
    /// Receives a record.
    fn record(&mut self, record: &Record);
    /// Receives a message for the log.
    fn note(&mut self, text: &str);
    /// Receives a warning for the log.
    fn warn(&mut self, text: &str) {
        self.note(text);
    }
    /// Whether to stop after this step, with [`crate::Error::Interrupted`].
    fn cancelled(&self) -> bool {
        false
    }
    /// Whether it is time to call [`Observer::checkpoint`].
    fn checkpoint_due(&self) -> bool {
        false
    }
    /// Stores a checkpoint: when one is due, and before an interrupted run ends. Methods call it by `keep`.
    fn checkpoint(&mut self, checkpoint: &Checkpoint<'_>) -> Result<()> {
        let _ = checkpoint;
        Ok(())
    }
    /// Whether it is time to call [`Observer::slices`].
    fn slices_due(&self) -> bool {
        false
    }
    /// Receives the three middle slices of the current state, each with its part of `grid`, in 1/unit of the scan.
    fn slices(&mut self, grid: VoxelGrid, slices: &[(Part, Array3<f32>)]) -> Result<()> {
        let _ = (grid, slices);
        Ok(())
    }
}

impl dyn Observer + '_ {
    /// Stores a checkpoint. A run that goes on needs none: if it cannot be stored, that is a warning. Only a run that
    /// `ends` needs it.
    pub fn keep(&mut self, checkpoint: &Checkpoint<'_>, ends: bool) -> Result<()> {
        match self.checkpoint(checkpoint) {
            Err(e) if !ends => self.warn(&format!("no checkpoint, the run goes on: {e}")),
            done => return done,
        }
        Ok(())
    }
}

/// An observer that ignores everything.
pub struct Silent;

impl Observer for Silent {
    fn progress(&mut self, _: u64, _: f64, _: f64) {}
    fn record(&mut self, _: &Record) {}
    fn note(&mut self, _: &str) {}
}

/// An observer that ignores everything, and says when to stop.
pub struct Quiet<'a>(pub &'a dyn Fn() -> bool);

impl Observer for Quiet<'_> {
    fn progress(&mut self, _: u64, _: f64, _: f64) {}
    fn record(&mut self, _: &Record) {}
    fn note(&mut self, _: &str) {}
    fn cancelled(&self) -> bool {
        (self.0)()
    }
}

/// The result of a method, in 1/unit of the scan.
pub enum Reconstruction {
    /// Voxels.
    Volume(Volume),
    /// A field that can be evaluated on any grid.
    Field(TrainedField),
    /// Voxels that a later method of a chain computed from a field, and that field.
    Refined {
        /// The final volume.
        volume: Volume,
        /// The field it was computed from.
        field: Box<TrainedField>,
    },
}

impl Reconstruction {
    /// The voxels requested by the scan, part by part; a field is evaluated by `backend`.
    pub fn voxels<'a>(&'a self, backend: &dyn Backend) -> Result<Box<dyn Voxels + 'a>> {
        Ok(match self {
            Self::Volume(volume) | Self::Refined { volume, .. } => Box::new(volume),
            Self::Field(field) => Box::new(field.voxels(backend, field.scene.grid)?),
        })
    }

    /// The voxels requested by the scan, all at once.
    pub fn volume(&self, backend: &dyn Backend) -> Result<Volume> {
        Volume::collect(self.voxels(backend)?.as_mut())
    }

    /// The field, if the method trains one.
    pub fn field(&self) -> Option<&TrainedField> {
        match self {
            Self::Volume(_) => None,
            Self::Field(field) => Some(field),
            Self::Refined { field, .. } => Some(field),
        }
    }
}

/// The outcome of a run.
pub struct Solution {
    /// The reconstruction.
    pub result: Reconstruction,
    /// Steps done.
    pub steps: u64,
    /// Seconds of training.
    pub train_s: f64,
    /// Training samples.
    pub samples: u64,
    /// Seconds of `train_s` spent on those samples; 0 for iterative methods.
    pub sampling_s: f64,
    /// Number of returns to an earlier state after training diverged.
    pub rollbacks: u64,
    /// The record whose state was kept, if held-out views selected it.
    pub best: Option<Best>,
}

/// The record with the smallest error on held-out views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Best {
    /// Its [`Record::step`].
    pub step: u64,
    /// Its [`Record::held_out`].
    pub held_out: f64,
}

/// The environment in which a method is built.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// Compiles and computes.
    pub backend: &'a dyn Backend,
    /// Reads a weights file named by the spec.
    pub weights: &'a dyn Fn(&str) -> Result<Weights>,
    /// Whether to read weights. Not needed to explain a spec or to restore a field.
    pub reads_weights: bool,
}

impl<'a> Context<'a> {
    /// A context without initial weights, for inspection only.
    pub fn without_weights(backend: &'a dyn Backend) -> Self {
        Self { reads_weights: false, ..Self::new(backend) }
    }

    /// A context without files.
    pub fn new(backend: &'a dyn Backend) -> Self {
        Self {
            backend,
            weights: &|path| Err(Error::unsupported(path, "no weights are read here")),
            reads_weights: true,
        }
    }
}

/// The settings of a method and of the stages it owns, as given by a spec.
pub trait Method: Registered + Send + Sync {
    /// Checks the settings, builds and compiles every stage, and reads the weights named in the settings, each once.
    fn plan(&self, context: &Context<'_>) -> Result<Box<dyn Plan>>;

    /// The setting, by its path in the spec, with which the method starts from `file`; `None` if it cannot.
    fn start_setting(&self, file: &StartFile) -> Option<(String, serde_json::Value)> {
        let _ = file;
        None
    }
}

crate::settings_of!(Method, Method);

/// A file that a run starts from.
#[derive(Debug, Clone, PartialEq)]
pub enum StartFile {
    /// Weights of a field.
    Weights(InputFile),
    /// A volume.
    Volume(InputFile),
}

impl StartFile {
    /// What the file holds.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Weights(_) => "weights",
            Self::Volume(_) => "a volume",
        }
    }

    /// The setting `start` of methods on voxels: a volume.
    pub fn as_volume(&self) -> Option<(String, serde_json::Value)> {
        match self {
            Self::Weights(_) => None,
            Self::Volume(file) => Some(("start".into(), file.0.clone().into())),
        }
    }
}

/// A method that is built and checked, ready to be explained, priced and run.
pub trait Plan: Send {
    /// What it consists of.
    fn outline(&self) -> Outline;

    /// Memory needed for a scan of this size.
    fn needs(&self, scan: &ScanHeader) -> Needs;

    /// How often it goes through the views and the volume if no more than `room` bytes of an array are in memory at once;
    /// one line for each method of a chain.
    fn reads(&self, scan: &ScanHeader, room: u64) -> Vec<String> {
        let _ = (scan, room);
        vec![]
    }

    /// Analyses a scan before the start.
    fn inspect(&self, scan: &Scan) -> Result<Findings>;

    /// Reconstructs.
    fn run(&mut self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution>;

    /// Trains its field on known volumes, voxel by voxel; the weights are reused for other scans.
    fn pretrain(&mut self, job: &PretrainJob<'_>, observer: &mut dyn Observer) -> Result<Model> {
        let _ = (job, observer);
        let what = self.outline().method.kind;
        Err(Error::unsupported(what, "this method has nothing to pre-train"))
    }

    /// Restores a trained field with the parameters that `load` puts into its model.
    fn restore(&self, placement: &Placement, load: &mut dyn FnMut(&mut Model) -> Result<()>) -> Result<TrainedField> {
        let _ = (placement, load);
        Err(Error::unsupported(self.outline().method.kind, "this method trains no field"))
    }

    /// The stages of the field, if the method trains one.
    fn pipeline(&self) -> Option<&Pipeline> {
        None
    }

    /// The setting that requires held-out views, if any: it has no effect without them.
    fn needs_held_out(&self) -> Option<String> {
        None
    }

    /// Whether [`Job::start`] has an effect.
    fn starts_from_volume(&self) -> bool {
        true
    }

    /// Maximum number of passes (for an iterative method) or steps, even if time is left: more of them may fit the
    /// noise. `None` if only time limits it.
    fn passes(&self) -> Option<u64> {
        None
    }

    /// Cost of one pass over a scan of this size, in samples along rays. Times of passes over scans of different sizes
    /// are about proportional to it.
    fn work(&self, scan: &ScanHeader) -> f64 {
        scan.samples()
    }

    /// The size of the scan for an iterative method: pixels after binning, and unknowns in place of voxels.
    fn seen(&self, scan: &ScanHeader) -> Option<ScanHeader> {
        let _ = scan;
        None
    }

    /// The plans of a chain, in order; empty for other methods.
    fn links(&mut self) -> &mut [Box<dyn Plan>] {
        &mut []
    }
}

/// The parts of a method, for display and records.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Outline {
    /// The method itself.
    pub method: Line,
    /// Stages of a field, in order.
    pub stages: Vec<StageLine>,
    /// All other stages.
    pub beside: Vec<Line>,
    /// The compiled stages of a field.
    pub compiled: Option<Explain>,
    /// The methods of a chain.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub links: Vec<Outline>,
}

impl Outline {
    /// The compiled stages of the first field.
    pub fn backend(&self) -> Explain {
        let links = self.links.iter().map(Self::backend).find(|e| !e.backend.is_empty());
        self.compiled.clone().or(links).unwrap_or_default()
    }

    /// Number of parameters of all fields.
    pub fn parameters(&self) -> usize {
        let own: usize = self.stages.iter().map(|s| s.parameters).sum();
        own + self.links.iter().map(Self::parameters).sum::<usize>()
    }
}

/// A description of one stage.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Line {
    /// Its key in the spec.
    pub stage: String,
    /// The name of its type.
    #[serde(rename = "type")]
    pub kind: String,
    /// Its settings in words.
    pub what: String,
}

impl Line {
    /// A line from a description that may begin with the type name.
    pub fn new(stage: &str, kind: &str, what: &str) -> Self {
        Self { stage: stage.into(), kind: kind.into(), what: untitled(kind, what) }
    }
}

/// A description without a leading type name.
fn untitled(kind: &str, what: &str) -> String {
    let rest = what.strip_prefix(kind).map(|rest| rest.trim_start_matches([':', ',', ' ']));
    rest.unwrap_or(what).to_owned()
}

/// A stage of a field with its size and cost.
#[derive(Debug, Clone, Serialize)]
pub struct StageLine {
    /// Its key in the spec.
    pub stage: String,
    /// The name of its type.
    #[serde(rename = "type")]
    pub kind: String,
    /// Its settings in words.
    pub what: String,
    /// Channels in.
    pub input: usize,
    /// Channels out.
    pub output: usize,
    /// Parameters.
    pub parameters: usize,
    /// Their bytes.
    pub parameter_bytes: usize,
    /// Bytes of their gradients.
    pub gradient_bytes: usize,
    /// Bytes of their moments.
    pub moment_bytes: usize,
    /// Bytes kept from forward to backward, per sample.
    pub tape_bytes_per_sample: usize,
    /// Multiply-adds of the forward pass, per sample.
    pub macs_per_sample: usize,
    /// How its gradients are accumulated.
    pub gradient: GradKind,
    /// Whether it also runs on a GPU.
    pub wgsl: bool,
    /// The stage is an identity and is skipped.
    pub left_out: bool,
}

impl StageLine {
    /// The description of a stage with this key and type name.
    pub fn new(stage: &str, kind: &str, built: &dyn Stage) -> Self {
        let info = built.info();
        Self {
            stage: stage.into(),
            kind: kind.into(),
            what: untitled(kind, &built.describe()),
            input: info.input,
            output: info.output,
            parameters: info.params,
            parameter_bytes: 4 * info.params,
            gradient_bytes: 4 * info.params,
            moment_bytes: 8 * info.params,
            tape_bytes_per_sample: 4 * info.tape,
            macs_per_sample: info.macs,
            gradient: info.grads,
            wgsl: built.wgsl().is_some(),
            left_out: info.identity,
        }
    }
}

/// Results of the analysis of a scan.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Findings {
    /// Readable results, one per line.
    pub lines: Vec<String>,
    /// The attenuation that counts as 1 for the stages of a field, in 1/unit of the scan.
    pub attenuation: Option<f64>,
    /// Samples of a field on the middle ray of the first view.
    pub samples: Option<usize>,
}

/// Memory of a method in bytes, besides the scan and the reference.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Needs {
    /// The reconstruction of the surroundings of the volume, before everything else.
    pub surround: u64,
    /// A copy of the scan without beam hardening or the contribution of the surroundings.
    pub corrected: u64,
    /// Parameters and gradients.
    pub model: u64,
    /// Moments, and copies of parameters kept by callbacks.
    pub optimizer: u64,
    /// Working memory of the backend.
    pub backend: u64,
    /// Other working memory: iterates, directions, residuals, lists of rays; without the resulting volume.
    pub working: u64,
    /// Additional memory to resume an interrupted run.
    pub resume: u64,
    /// Whether the method produces the scan's voxels itself: its last iterate is the volume. The memory check then adds
    /// that volume.
    pub volume: bool,
    /// Evaluation of a field at voxels.
    pub evaluating: u64,
}

impl Needs {
    /// The element-wise maximum: memory of two methods that run one after the other.
    pub fn most(self, other: Self) -> Self {
        Self {
            surround: self.surround.max(other.surround),
            corrected: self.corrected.max(other.corrected),
            model: self.model.max(other.model),
            optimizer: self.optimizer.max(other.optimizer),
            backend: self.backend.max(other.backend),
            working: self.working.max(other.working),
            resume: self.resume.max(other.resume),
            volume: self.volume || other.volume,
            evaluating: self.evaluating.max(other.evaluating),
        }
    }
}

/// Inputs of pre-training.
pub struct PretrainJob<'a> {
    /// The known volumes, in any unit of attenuation.
    pub volumes: &'a [Volume],
    /// The compute backend.
    pub backend: &'a dyn Backend,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Limits from the command line, in addition to the spec's.
    pub limits: Limits,
}
