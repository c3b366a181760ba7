//! How much normalizers and field change under the same features: NI-NeRF's measure of stability.
//!
//! Every so often the encoder's features of a fixed batch of points are recorded with the attenuation that normalizers
//! and field make of them. The next time these recorded features go through normalizers and field as they are by then,
//! and the mean absolute difference to the recorded attenuation is the drift (L1, in the scale that stages see). A
//! LayerNorm is within what is evaluated again: features are recorded as they leave the encoder, before it.

use conefield_core::backend::Executable;
use conefield_core::checkpoint::Resume;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::host;
use conefield_core::pipeline::Model;
use conefield_core::random::stream;
use conefield_core::scene::Scene;
use conefield_core::solver::DriftRecord;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Logs how much normalizers and field change under the same features.
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

impl Drift {
    /// Refuses times and sizes that are none.
    pub fn validate(&self) -> Result<()> {
        let every = self.every.is_finite() && self.every > 0.0;
        ensure(every, "spec", "solver.drift.every", self.every, "a positive finite number of epochs")?;
        ensure((1..=1 << 16).contains(&self.points), "spec", "solver.drift.points", self.points, "1 to 65536")
    }
}

/// The parts of a recording in a checkpoint.
const PARTS: [&str; 2] = ["drift.features", "drift.attenuation"];

/// Follows the drift of a run.
pub struct DriftWatch {
    /// Steps between two looks.
    every: u64,
    steps_an_epoch: f64,
    points: Vec<[f32; 3]>,
    /// The step before which it was last looked.
    looked: Option<u64>,
    recorded: Option<Recorded>,
}

/// Features with what was made of them.
struct Recorded {
    /// Channels and points.
    shape: [usize; 2],
    features: Vec<f32>,
    attenuation: Vec<f32>,
    /// How often channels had been masked.
    masks: usize,
}

impl DriftWatch {
    /// Points where the object can be, by `seed`; with what `resume` has recorded of `model`.
    pub fn new(
        settings: &Drift,
        scene: &Scene,
        seed: u64,
        steps_an_epoch: f64,
        resume: Option<&Resume>,
        model: &Model,
    ) -> Result<Self> {
        let every = (settings.every * steps_an_epoch).round().max(1.0) as u64;
        let points = points(scene, seed, settings.points);
        let mut watch = Self { every, steps_an_epoch, points, looked: None, recorded: None };
        if let Some(resume) = resume {
            watch.looked = Some(resume.standing.step / every * every);
            watch.recorded = watch.read(resume, model)?;
        }
        Ok(watch)
    }

    /// Whether it is time for [`DriftWatch::look`], before step `step` (from 0).
    pub fn due(&self, step: u64) -> bool {
        step.is_multiple_of(self.every) && self.looked != Some(step)
    }

    /// Evaluates what was recorded again and records anew. Channels that were masked since then are gone from the
    /// stages, which can make nothing of the features any more: there is no drift then, and `events` gets a line.
    pub fn look(
        &mut self,
        step: u64,
        model: &mut Model,
        exe: &mut dyn Executable,
        events: &mut Vec<String>,
    ) -> Result<Option<DriftRecord>> {
        exe.fetch(model)?;
        let n = self.points.len();
        let (from, masks) = (self.looked.unwrap_or(0), model.masks().len());
        let found = match &self.recorded {
            Some(then) if then.masks == masks => {
                let now = host::attenuation(model, &then.features, n)?;
                let sum: f64 =
                    now.iter().zip(&then.attenuation).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).sum();
                let mean_l1 = sum / n as f64;
                if !mean_l1.is_finite() {
                    let what =
                        format!("the field at recorded features has moved by {mean_l1}; try a smaller solver.lr");
                    return Err(Error::Diverged { step, what });
                }
                Some(DriftRecord { from_step: from, step, epoch: step as f64 / self.steps_an_epoch, mean_l1 })
            }
            _ => {
                if self.looked.is_some() {
                    events.push(format!("no drift from step {from} to {step}: channels were masked in between"));
                }
                None
            }
        };
        let features = exe.encode(model, &self.points)?;
        let attenuation = host::attenuation(model, &features, n)?;
        self.recorded = Some(Recorded { shape: [features.len() / n, n], features, attenuation, masks });
        self.looked = Some(step);
        Ok(found)
    }

    /// What a checkpoint needs to have: name, shape and values. Nothing where masked channels have spoilt it.
    pub fn tensors(&self, model: &Model) -> Vec<(String, &[usize], &[f32])> {
        let recorded = self.recorded.iter().filter(|r| r.masks == model.masks().len());
        let [features, attenuation] = PARTS.map(str::to_owned);
        let both = recorded.map(|r| [(&r.shape[..], &r.features[..]), (&r.shape[1..], &r.attenuation[..])]);
        both.flatten().zip([features, attenuation]).map(|((shape, values), name)| (name, shape, values)).collect()
    }

    /// What [`DriftWatch::tensors`] has left.
    fn read(&self, resume: &Resume, model: &Model) -> Result<Option<Recorded>> {
        let shape = [model.pipeline.encoder.info().output, self.points.len()];
        let all = &resume.weights.tensors;
        let take = |name: &str, expected: &[usize]| match all.get(name) {
            Some((shape, values)) if shape == expected => Ok(values.clone()),
            other => {
                let found = other.map_or("nothing".into(), |(shape, _)| format!("shape {shape:?}"));
                Err(Error::invalid(&resume.place, name, found, format!("a tensor of shape {expected:?}")))
            }
        };
        if PARTS.iter().all(|name| !all.contains_key(*name)) {
            return Ok(None);
        }
        let (features, attenuation) = (take(PARTS[0], &shape)?, take(PARTS[1], &shape[1..])?);
        Ok(Some(Recorded { shape, features, attenuation, masks: model.masks().len() }))
    }
}

/// Random points of the volume where the object can be.
fn points(scene: &Scene, seed: u64, count: usize) -> Vec<[f32; 3]> {
    let mut rng = stream(seed ^ 0x6472_6966_7421, 0);
    let [low, high] = scene.bounds;
    let mut draw = || std::array::from_fn(|k| low[k] + (high[k] - low[k]) * rng.random::<f64>());
    (0..count)
        .map(|_| {
            // A support that is a tiny part of its box must not hold us up.
            let first = draw();
            let held = std::iter::once(first).chain((0..1000).map(|_| draw())).find(|p| scene.holds(*p));
            scene.to_unit(held.unwrap_or(first))
        })
        .collect()
}
