//! Backends compile a pipeline and run it: training steps, evaluation at points, rendering of rays.

use crate::device::Device;
use crate::error::{Error, Result};
use crate::loss::Loss;
use crate::pipeline::{Model, Pipeline};
use crate::place::{Host, Moved, Place};
use crate::prior::Prior;
use crate::stage::{UnitGrid, UnitRay};
use serde::Serialize;
use std::sync::Arc;

/// A ray with its measured value, both in the scale of the stages.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainRay {
    /// The ray.
    pub ray: UnitRay,
    /// Measured line integral.
    pub target: f32,
}

/// The blocks at which a step evaluates a prior.
#[derive(Clone, Copy)]
pub struct BlockWork<'a> {
    /// The prior; it determines the number of points per block.
    pub prior: &'a dyn Prior,
    /// Lowest corner of each block in the unit cube.
    pub corners: &'a [[f32; 3]],
    /// Distance between neighbouring points along each axis, in cube sides.
    pub spacing: [f32; 3],
}

impl BlockWork<'_> {
    /// Factor of a block's penalty: the prior is a mean over blocks and points.
    pub fn scale(&self) -> f64 {
        let blocks = self.prior.blocks();
        blocks.weight / (self.corners.len() * blocks.points()).max(1) as f64
    }
}

/// Inputs of a training step. The loss of each part is a mean over its entries; the parts are summed.
#[derive(Clone)]
pub struct Work<'a> {
    /// Number of the step; determines random sample positions together with `seed`.
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
    /// Returns an error of the loss or a prior in the calls so far.
    pub fn fault(&self) -> Result<()> {
        self.loss.fault()?;
        self.priors.iter().try_for_each(|p| p.prior.fault())
    }
}

/// Results of a step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct StepStats {
    /// Mean loss of rays and of points.
    pub loss: f64,
    /// Weighted sum of the priors.
    pub prior: f64,
    /// Samples evaluated.
    pub samples: u64,
    /// Seconds in the forward pass and in the backward pass of dense stages.
    pub dense_s: f64,
    /// Seconds in the gradients of scattered parameters.
    pub scatter_s: f64,
}

/// Adam settings for one step.
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
    /// Number of steps, including this one.
    pub step: u64,
}

/// Human-readable description of a compiled pipeline.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Explain {
    /// Name of the backend, with the instruction set or device.
    pub backend: String,
    /// One line per decision.
    pub notes: Vec<String>,
    /// Bytes of working memory, besides model and scan.
    pub scratch_bytes: usize,
}

/// Compiles pipelines.
pub trait Backend: Send + Sync {
    /// Its name on the command line.
    fn name(&self) -> &'static str;
    /// The same with the instruction set or the device, for records.
    fn describe(&self) -> String {
        self.name().into()
    }
    /// Checks that this backend can run every stage and describes how; never falls back silently.
    fn compile(&self, pipeline: &Pipeline) -> Result<(Box<dyn Executable>, Explain)>;
    /// Where this backend keeps volumes and views.
    fn place(&self) -> Arc<dyn Place> {
        Arc::new(Host)
    }
    /// Its device, for a field with its own line integrals; `None` if there is none.
    fn device(&self) -> Option<Box<dyn Device>> {
        None
    }
    /// Bytes moved between the host and this backend's device so far.
    fn moved(&self) -> Moved {
        Moved::default()
    }
    /// Runs a method: `lead` here and, at the same time, `follow` on every other backend that shares the arrays of this
    /// one's place. All make the same calls in the same order.
    fn run(
        &self,
        lead: &mut dyn FnMut() -> Result<()>,
        follow: &(dyn Fn(&dyn Backend) -> Result<()> + Sync),
    ) -> Result<()> {
        let _ = follow;
        lead()
    }
}

/// A compiled pipeline. Compile again after a mask has changed the pipeline. Each call returns the errors that stages
/// report in [`crate::stage::Stage::fault`].
///
/// Parameters, gradients and moments may live on a device: the first call uploads the model's arena, later calls change
/// the uploaded copy. [`Executable::fetch`] downloads it, [`Executable::renew`] makes the next call upload again.
pub trait Executable: Send {
    /// Refuses a loss or prior that cannot run here, at planning time.
    fn admits(&self, _loss: &dyn Loss, _priors: &[Box<dyn Prior>]) -> Result<()> {
        Ok(())
    }
    /// Computes the gradients of `work`'s loss and overwrites the arena's gradients with them.
    fn step(&mut self, model: &mut Model, work: &Work<'_>) -> Result<StepStats>;
    /// One Adam step with the arena's gradients.
    fn update(&mut self, model: &mut Model, adam: &Adam) -> Result<()>;
    /// The field at `points` of the unit cube.
    fn evaluate(&mut self, model: &Model, points: &[[f32; 3]], out: &mut [f32]) -> Result<()>;
    /// The encoder's features at `points`, channel-major.
    fn encode(&mut self, model: &Model, points: &[[f32; 3]]) -> Result<Vec<f32>>;
    /// The field at the points of `grid` (`[x, y, z]`, z fastest), for a field that evaluates whole grids.
    fn values(&mut self, model: &Model, grid: &UnitGrid, out: &mut [f32]) -> Result<()> {
        let field = &model.pipeline.field;
        let no = || Error::unsupported(field.describe(), "it does not evaluate whole grids");
        field.on_grid().ok_or_else(no)?.values(&model.arena.params, grid, out);
        Ok(())
    }
    /// Line integrals of `rays`.
    fn render(&mut self, model: &Model, rays: &[UnitRay], out: &mut [f32]) -> Result<()>;
    /// Brings the model's arena up to date with the calls so far.
    fn fetch(&mut self, _model: &mut Model) -> Result<()> {
        Ok(())
    }
    /// Seconds per kernel since the last call, if the backend measures them.
    fn profile(&mut self) -> Vec<(String, f64)> {
        vec![]
    }
    /// Informs the backend that the model's arena was changed elsewhere: the next call reads it again. Fetch first if
    /// the device's state is needed.
    fn renew(&mut self) {}
}
