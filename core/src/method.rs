//! A method: scan in, volume out. [`Method`] is what a spec says; [`Method::plan`] builds it once into a [`Plan`], which is
//! explained, priced and run.

use crate::arena::Weights;
use crate::backend::{Backend, Explain};
use crate::checkpoint::{Checkpoint, Resume};
use crate::error::{Error, Result};
use crate::geometry::VoxelGrid;
use crate::parts::{Part, Voxels};
use crate::pipeline::{Model, Pipeline};
use crate::scan::{Scan, ScanHeader, Volume};
use crate::stage::{GradKind, Stage};
use crate::trained::{Placement, TrainedField};
use ndarray::Array3;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// What a method works on.
#[derive(Clone, Copy)]
pub struct Job<'a> {
    /// Views to learn from.
    pub scan: &'a Scan,
    /// Held-out views, whose error is reported.
    pub held_out: Option<&'a Scan>,
    /// The volume sought, if known; it is only looked at, never learned from.
    pub reference: Option<&'a Volume>,
    /// The value that PSNR takes for the reference's full range.
    pub peak: f64,
    /// Does the work.
    pub backend: &'a dyn Backend,
    /// Seed of everything random.
    pub seed: u64,
    /// Limits that the command line adds to the spec's.
    pub limits: Limits,
    /// The volume to start from, in 1/unit of the scan. It goes before one that the method's settings name.
    pub start: Option<&'a Volume>,
    /// Reads a volume that the spec names, in 1/unit of the scan.
    pub volumes: &'a dyn Fn(&str) -> Result<Volume>,
    /// Where an earlier run of the same job stood, to go on from.
    pub resume: Option<&'a Resume>,
}

impl<'a> Job<'a> {
    /// A job with nothing beside what every one has: no held-out views, no reference (and a peak of 1), no limits, seed 0,
    /// and no files that the spec may name.
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
            volumes: &no_volumes,
            resume: None,
        }
    }
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
    /// When training is to be over by the clock on the wall, whatever happens beside it. Methods that cannot stop anywhere
    /// stop before they would pass it.
    pub deadline: Option<Instant>,
    /// The same for the later methods of a chain.
    pub then: Option<Instant>,
}

/// One line of `metrics.jsonl`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Record {
    /// Finished steps.
    pub step: u64,
    /// Seconds of training so far (evaluation and export left out).
    pub seconds: f64,
    /// Mean loss since the last record; of iterative methods, the root mean square of the residual `p − A·x`. FDK has none.
    pub loss: Option<f64>,
    /// Mean weighted prior since the last record.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prior: Option<f64>,
    /// Learning rate, of methods that have one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lr: Option<f64>,
    /// Training samples a second since the last record, of methods that take samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples_per_s: Option<f64>,
    /// Root mean square change of the volume by this pass over its root mean square, of iterative methods.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change: Option<f64>,
    /// Root mean square error of the held-out views' line integrals, over their largest value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out: Option<f64>,
    /// PSNR against the reference over one voxel, drawn, of each block of 4³, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr: Option<f64>,
    /// Drift found since the last record, of a spec with the callback `drift`.
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
    /// After every step: finished share in [0, 1] and the seconds left by the method's own estimate.
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
    /// Whether it is time to call [`Observer::slices`].
    fn slices_due(&self) -> bool {
        false
    }
    /// Sees the three middle slices of what takes shape, each with the part of `grid` that it is, in 1/unit of the scan.
    fn slices(&mut self, grid: VoxelGrid, slices: &[(Part, Array3<f32>)]) -> Result<()> {
        let _ = (grid, slices);
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
    /// Voxels that a later method of a chain made of a field's, and that field.
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

    /// The field, of methods that train one.
    pub fn field(&self) -> Option<&TrainedField> {
        match self {
            Self::Volume(_) => None,
            Self::Field(field) => Some(field),
            Self::Refined { field, .. } => Some(field),
        }
    }
}

/// What a method made.
pub struct Solution {
    /// What came out.
    pub result: Reconstruction,
    /// Steps done.
    pub steps: u64,
    /// Seconds of training.
    pub train_s: f64,
    /// Training samples.
    pub samples: u64,
    /// Seconds of `train_s` that they took; iterative methods take none.
    pub sampling_s: f64,
    /// Times that training ran away and went back to an earlier state.
    pub rollbacks: u64,
    /// The record whose state came out, where held-out views chose it.
    pub best: Option<Best>,
}

/// A record that predicted held-out views best.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Best {
    /// Its [`Record::step`].
    pub step: u64,
    /// Its [`Record::held_out`].
    pub held_out: f64,
}

/// What a method is built with.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// Compiles and computes.
    pub backend: &'a dyn Backend,
    /// Reads a weights file that the spec names.
    pub weights: &'a dyn Fn(&str) -> Result<Weights>,
    /// Whether weights are read: a spec is explained, and a field restored, without those that it starts from.
    pub reads_weights: bool,
}

impl<'a> Context<'a> {
    /// A context whose plans start from no weights: they are for looking at.
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

/// The settings of a method with the stages that it owns: what a spec says.
#[typetag::serde(tag = "type")]
pub trait Method: Send + Sync {
    /// Checks the settings, builds every stage, compiles, and reads the weights that the settings name; each once.
    fn plan(&self, context: &Context<'_>) -> Result<Box<dyn Plan>>;
}

/// A method that is built and checked: it is explained, priced and run.
pub trait Plan: Send {
    /// What it consists of.
    fn outline(&self) -> Outline;

    /// What it holds in memory for a scan of this size.
    fn needs(&self, scan: &ScanHeader) -> Needs;

    /// What it finds out about a scan before it starts.
    fn inspect(&self, scan: &Scan) -> Result<Findings>;

    /// Reconstructs.
    fn run(&mut self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution>;

    /// Trains its field on known volumes, voxel by voxel, for weights that other scans reuse.
    fn pretrain(&mut self, job: &PretrainJob<'_>, observer: &mut dyn Observer) -> Result<Model> {
        let _ = (job, observer);
        let what = self.outline().method.kind;
        Err(Error::unsupported(what, "this method has nothing to pre-train"))
    }

    /// A field that it has trained, with the parameters that `load` puts into its model.
    fn restore(&self, placement: &Placement, load: &mut dyn FnMut(&mut Model) -> Result<()>) -> Result<TrainedField> {
        let _ = (placement, load);
        Err(Error::unsupported(self.outline().method.kind, "this method trains no field"))
    }

    /// The stages of a field, of a method that trains one.
    fn pipeline(&self) -> Option<&Pipeline> {
        None
    }

    /// The setting that looks at held-out views, if there is one: it has no effect in a job without such views.
    fn needs_held_out(&self) -> Option<String> {
        None
    }

    /// Whether [`Job::start`] means something to it.
    fn starts_from_volume(&self) -> bool {
        true
    }

    /// Passes over the views that it makes at most, of an iterative method that counts them.
    fn passes(&self) -> Option<u64> {
        None
    }

    /// What a pass over a scan of this size takes, in samples along rays: passes over two sizes of a scan take times that are
    /// about in proportion.
    fn work(&self, scan: &ScanHeader) -> f64 {
        scan.samples()
    }

    /// A scan of this size as an iterative method sees it: the pixels that binning leaves, and its unknowns in the place of
    /// voxels.
    fn seen(&self, scan: &ScanHeader) -> Option<ScanHeader> {
        let _ = scan;
        None
    }

    /// The plans of a chain, in order; nothing of any other method.
    fn links(&mut self) -> &mut [Box<dyn Plan>] {
        &mut []
    }
}

/// What a method consists of, for people and for records.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Outline {
    /// The method itself.
    pub method: Line,
    /// Stages of a field, in order.
    pub stages: Vec<StageLine>,
    /// All other stages.
    pub beside: Vec<Line>,
    /// What the backend makes of the stages of a field.
    pub compiled: Option<Explain>,
    /// The methods of a chain.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub links: Vec<Outline>,
}

impl Outline {
    /// What the backend makes of its first field.
    pub fn backend(&self) -> Explain {
        let links = self.links.iter().map(Self::backend).find(|e| !e.backend.is_empty());
        self.compiled.clone().or(links).unwrap_or_default()
    }

    /// Parameters of all fields.
    pub fn parameters(&self) -> usize {
        let own: usize = self.stages.iter().map(|s| s.parameters).sum();
        own + self.links.iter().map(Self::parameters).sum::<usize>()
    }
}

/// A stage in a line.
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
    /// The line of a stage whose description may begin with the name of its type.
    pub fn new(stage: &str, kind: &str, what: &str) -> Self {
        Self { stage: stage.into(), kind: kind.into(), what: untitled(kind, what) }
    }
}

/// A description without the name of the type before it.
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
    /// Bytes that forward leaves for backward, a sample.
    pub tape_bytes_per_sample: usize,
    /// Multiply-adds a sample, forward.
    pub macs_per_sample: usize,
    /// How gradients arrive.
    pub gradient: GradKind,
    /// Whether it runs on a GPU as well.
    pub wgsl: bool,
    /// Output equals input: it does no work.
    pub left_out: bool,
}

impl StageLine {
    /// The line of a stage under its key and the name of its type.
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

/// What a method finds out about a scan before it starts.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Findings {
    /// In words, a line each.
    pub lines: Vec<String>,
    /// The attenuation that the stages of a field see as 1, in 1/unit of the scan.
    pub attenuation: Option<f64>,
    /// Samples that a field takes on the middle ray of the first view.
    pub samples: Option<usize>,
}

/// Bytes that a method holds, beside the scan and the reference.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Needs {
    /// While it looks beyond the volume, before all else.
    pub surround: u64,
    /// A copy of the scan without what is beyond the volume.
    pub subtracted: u64,
    /// Parameters and gradients.
    pub model: u64,
    /// Moments, and copies of parameters that callbacks keep.
    pub optimizer: u64,
    /// What the backend works in.
    pub backend: u64,
    /// What else it works in: iterates, directions, residuals, lists of rays.
    pub working: u64,
    /// What an interrupted run reads again, beside all that.
    pub resume: u64,
    /// Whether it makes the voxels of the scan itself: its last iterate is the volume.
    pub volume: bool,
    /// What evaluating voxels takes, of a field.
    pub evaluating: u64,
}

impl Needs {
    /// The larger of each: what two methods take one after the other.
    pub fn most(self, other: Self) -> Self {
        Self {
            surround: self.surround.max(other.surround),
            subtracted: self.subtracted.max(other.subtracted),
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

/// What pre-training works on.
pub struct PretrainJob<'a> {
    /// The known volumes, in any unit of attenuation.
    pub volumes: &'a [Volume],
    /// Does the work.
    pub backend: &'a dyn Backend,
    /// Seed of everything random.
    pub seed: u64,
    /// Limits that the command line adds to the spec's.
    pub limits: Limits,
}
