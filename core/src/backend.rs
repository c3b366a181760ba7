//! A backend compiles a pipeline and does its work: training steps, evaluation at points, rendering of rays.

use crate::error::Result;
use crate::loss::Loss;
use crate::pipeline::{Model, Pipeline};
use crate::prior::Prior;
use crate::stage::UnitRay;
use crate::voxel::{VoxelProjector, VoxelView};
use ndarray::{ArrayView3, ArrayViewMut3};
use serde::Serialize;

/// A ray with its measured value, both scaled to what stages see.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainRay {
    /// The ray.
    pub ray: UnitRay,
    /// Measured line integral.
    pub target: f32,
}

/// The blocks on which a step looks at a prior.
#[derive(Clone, Copy)]
pub struct BlockWork<'a> {
    /// The prior. It says how many points a block has.
    pub prior: &'a dyn Prior,
    /// Lowest corner of each block in the unit cube.
    pub corners: &'a [[f32; 3]],
    /// Distance of neighbouring points along each axis, in cube sides.
    pub spacing: [f32; 3],
}

impl BlockWork<'_> {
    /// What the penalty of a block counts by: the prior is a mean over blocks and points.
    pub fn scale(&self) -> f64 {
        let blocks = self.prior.blocks();
        blocks.weight / (self.corners.len() * blocks.points()).max(1) as f64
    }
}

/// What a step learns from. Each part's loss is a mean over its entries; parts add.
#[derive(Clone)]
pub struct Work<'a> {
    /// Which step this is; decides random sample positions together with `seed`.
    pub step: u64,
    /// Seed of the run.
    pub seed: u64,
    /// The loss of rays and points.
    pub loss: &'a dyn Loss,
    /// Rays with measured line integrals.
    pub rays: &'a [TrainRay],
    /// Points of the unit cube with known attenuation.
    pub points: &'a [([f32; 3], f32)],
    /// Priors of the field.
    pub priors: &'a [BlockWork<'a>],
}

impl Work<'_> {
    /// An error of the loss or a prior in the calls so far.
    pub fn fault(&self) -> Result<()> {
        self.loss.fault()?;
        self.priors.iter().try_for_each(|p| p.prior.fault())
    }
}

/// What a step found.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct StepStats {
    /// Mean loss of rays and of points.
    pub loss: f64,
    /// Weighted sum of the priors.
    pub prior: f64,
    /// Samples evaluated.
    pub samples: u64,
    /// Seconds in forward and in the backward passes of dense stages.
    pub dense_s: f64,
    /// Seconds in gradients of scattered parameters.
    pub scatter_s: f64,
}

/// Adam's settings for one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Adam {
    /// Learning rate of this step.
    pub lr: f64,
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub eps: f64,
    /// Steps taken, this one included.
    pub step: u64,
}

/// What a backend made of a pipeline, for people.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Explain {
    /// Name of the backend, with the instruction set or device.
    pub backend: String,
    /// One line a decision.
    pub notes: Vec<String>,
    /// Bytes beyond model and scan.
    pub scratch_bytes: usize,
}

/// Makes a pipeline ready to run.
pub trait Backend: Send + Sync {
    /// Its name on the command line.
    fn name(&self) -> &'static str;
    /// Checks that every stage can run here and says how; never falls back silently.
    fn compile(&self, pipeline: &Pipeline) -> Result<(Box<dyn Executable>, Explain)>;
    /// The projector with its work on this backend's device; as it is where the backend has none of its own.
    fn place(&self, projector: Box<dyn VoxelProjector>) -> Result<Box<dyn VoxelProjector>> {
        Ok(projector)
    }
    /// Adds to each voxel of `volume` `Σ s/U²·p(row, column)` over the views whose pixels are `images`
    /// (`[view, row, column]`), bilinear between pixels and 0 outside the detector. Returns whether it did: a backend
    /// without a device leaves it to the method.
    fn backproject(
        &self,
        _views: &[VoxelView],
        _images: ArrayView3<'_, f32>,
        _volume: ArrayViewMut3<'_, f32>,
    ) -> Result<bool> {
        Ok(false)
    }
}

/// A compiled pipeline. After a mask changed the pipeline, compile again. What a stage reports with
/// [`crate::stage::Stage::fault`] during a call is the call's error.
///
/// Parameters, gradients and moments may live on a device: the first call takes the arena of its model there, later
/// ones change that copy. [`Executable::fetch`] brings it back, [`Executable::renew`] takes another arena there.
pub trait Executable: Send {
    /// Refuses a loss, or a prior, that cannot run here: told when a plan is made, before the first step.
    fn admits(&self, _loss: &dyn Loss, _priors: &[Box<dyn Prior>]) -> Result<()> {
        Ok(())
    }
    /// Gradients of `work`'s loss, written over the arena's gradients.
    fn step(&mut self, model: &mut Model, work: &Work<'_>) -> Result<StepStats>;
    /// One Adam step with the arena's gradients.
    fn update(&mut self, model: &mut Model, adam: &Adam) -> Result<()>;
    /// The field at `points` of the unit cube.
    fn evaluate(&mut self, model: &Model, points: &[[f32; 3]], out: &mut [f32]) -> Result<()>;
    /// The encoder's features at `points`, channel-major.
    fn encode(&mut self, model: &Model, points: &[[f32; 3]]) -> Result<Vec<f32>>;
    /// Line integrals of `rays`.
    fn render(&mut self, model: &Model, rays: &[UnitRay], out: &mut [f32]) -> Result<()>;
    /// Brings the model's arena to where the calls so far have left it.
    fn fetch(&mut self, _model: &mut Model) -> Result<()> {
        Ok(())
    }
    /// Seconds of each of its kernels since this was last asked, of a backend that was told to measure them.
    fn profile(&mut self) -> Vec<(String, f64)> {
        vec![]
    }
    /// Says that something else has changed the model's arena, after it was fetched if its state was wanted: the next
    /// call takes it as it is then.
    fn renew(&mut self) {}
}
