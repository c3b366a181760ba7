//! How much normalizers and field change for the same features: NI-NeRF's measure of stability.
//!
//! At regular intervals, the encoder's features of a fixed batch of points are recorded with the attenuation that
//! normalizers and field compute from them. At the next interval, the recorded features are evaluated with the current
//! normalizers and field; the mean absolute difference from the recorded attenuation is the drift (L1, in the scale
//! that stages see). This includes a LayerNorm: features are recorded at the encoder's output, before it.

use super::needs_features;
use crate::training::run::{HINT, Run};
use crate::training::{Callback, CallbackSpec, Kept, State};
use conefield_core::host;
use conefield_core::method::DriftRecord;
use conefield_core::pipeline::Pipeline;
use conefield_core::prelude::*;
use conefield_core::random::stream;
use conefield_core::scene::Scene;
use rand::RngExt;

/// Its name in specs and checkpoints, and the names of its tensors.
const NAME: &str = "drift";
const FEATURES: &str = "drift.features";
const ATTENUATION: &str = "drift.attenuation";

/// Settings of `drift`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Drift {
    /// Epochs from recording features to evaluating them again (published: 100).
    pub every: f64,
    /// Points of the batch.
    pub points: usize,
}

impl Default for Drift {
    fn default() -> Self {
        Self { every: 10.0, points: 4096 }
    }
}

conefield_core::stage_type!(CallbackSpec, "drift", Drift, "logs how much a field changes under the same features");

impl CallbackSpec for Drift {
    fn build(&self) -> Result<Box<dyn Callback>> {
        let every = self.every.is_finite() && self.every > 0.0;
        ensure(every, "spec", "every", self.every, "a positive finite number of epochs")?;
        ensure((1..=1 << 16).contains(&self.points), "spec", "points", self.points, "1 to 65536")?;
        Ok(Box::new(Watch { settings: self.clone(), every: 1, points: vec![], looked: None, recorded: None }))
    }
}

/// The callback that [`Drift`] builds.
struct Watch {
    settings: Drift,
    /// Steps between evaluations.
    every: u64,
    points: Vec<[f32; 3]>,
    /// The step before which it was last evaluated.
    looked: Option<u64>,
    recorded: Option<Recorded>,
}

/// Features with the attenuation computed from them.
struct Recorded {
    /// Channels and points.
    shape: [usize; 2],
    features: Vec<f32>,
    attenuation: Vec<f32>,
}

/// The state besides the recording.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Looked {
    step: Option<u64>,
    recorded: bool,
}

impl Callback for Watch {
    fn name(&self) -> &'static str {
        NAME
    }

    fn check(&self, pipeline: &Pipeline) -> Result<()> {
        needs_features(NAME, pipeline)
    }

    /// Draws points inside the object's support.
    fn begin(&mut self, run: &mut Run<'_>) -> Result<()> {
        self.every = (self.settings.every * run.steps_an_epoch as f64).round().max(1.0) as u64;
        self.points = points(run.scene, run.job.seed, self.settings.points);
        Ok(())
    }

    fn between_steps(&mut self, run: &mut Run<'_>) -> Result<()> {
        if !run.step.is_multiple_of(self.every) || self.looked == Some(run.step) {
            return Ok(());
        }
        run.clock.pause();
        self.look(run)?;
        run.clock.resume();
        Ok(())
    }

    fn masked(&mut self) {
        self.recorded = None;
    }

    fn state<'a>(&'a self, _: &'a Layout) -> Result<State<'a>> {
        let of = |r: &'a Recorded| {
            [(FEATURES.into(), &r.shape[..], &r.features[..]), (ATTENUATION.into(), &r.shape[1..], &r.attenuation[..])]
        };
        let looked = Looked { step: self.looked, recorded: self.recorded.is_some() };
        State::new(NAME, &looked, self.recorded.iter().flat_map(of).collect())
    }

    fn restore(&mut self, kept: &Kept<'_>, run: &Run<'_>) -> Result<()> {
        let Looked { step, recorded } = kept.value()?;
        self.looked = step;
        if recorded {
            let shape = [run.model.pipeline.encoder.info().output, self.settings.points];
            let features = kept.tensor(FEATURES, &shape)?;
            let attenuation = kept.tensor(ATTENUATION, &shape[1..])?;
            self.recorded = Some(Recorded { shape, features, attenuation });
        }
        Ok(())
    }
}

impl Watch {
    /// Evaluates the recorded features and records new ones. If channels were masked in the meantime, the stages no
    /// longer accept the features: there is no drift, and the record says so.
    fn look(&mut self, run: &mut Run<'_>) -> Result<()> {
        run.exe.fetch(&mut run.model)?;
        let (step, n, from) = (run.step, self.points.len(), self.looked.unwrap_or(0));
        if let Some(then) = &self.recorded {
            let now = host::attenuation(&run.model, &then.features, n)?;
            let sum: f64 = now.iter().zip(&then.attenuation).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).sum();
            let mean_l1 = sum / n as f64;
            if !mean_l1.is_finite() {
                let what = format!("the field at recorded features has moved by {mean_l1}; {HINT}");
                return Err(Error::Diverged { step, what });
            }
            let found = DriftRecord { from_step: from, step, epoch: run.epoch(), mean_l1 };
            run.tally.window.drift.push(found);
        } else if self.looked.is_some() {
            let said = format!("no drift from step {from} to {step}: channels were masked in between");
            run.tally.window.events.push(said);
        }
        let features = run.exe.encode(&run.model, &self.points)?;
        let attenuation = host::attenuation(&run.model, &features, n)?;
        self.recorded = Some(Recorded { shape: [features.len() / n, n], features, attenuation });
        self.looked = Some(step);
        Ok(())
    }
}

/// Random points of the volume inside the object's support.
fn points(scene: &Scene, seed: u64, count: usize) -> Vec<[f32; 3]> {
    let mut rng = stream(seed ^ 0x6472_6966_7421, 0);
    let [low, high] = scene.bounds;
    let mut draw = || std::array::from_fn(|k| low[k] + (high[k] - low[k]) * rng.random::<f64>());
    (0..count)
        .map(|_| {
            // A support that is a tiny part of its bounding box must not cause a long loop.
            let first = draw();
            let held = std::iter::once(first).chain((0..1000).map(|_| draw())).find(|p| scene.holds(*p));
            scene.to_unit(held.unwrap_or(first))
        })
        .collect()
}
