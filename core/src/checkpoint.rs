//! The state of a run between two steps: enough to continue to the same bits.

use crate::arena::{Arena, Layout, Weights};
use crate::error::{Error, Result};
use crate::pipeline::Model;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The state of a run besides the arena. All random numbers follow from seed and step.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Standing {
    /// Finished steps.
    pub step: u64,
    /// The last of them of which the records so far may tell: what comes after it is told again.
    pub recorded: u64,
    /// Training samples so far.
    pub samples: u64,
    /// Seconds of training so far.
    pub seconds: f64,
    /// The encoder's channels that stayed each time some were removed, in order; see [`Model::masks`].
    pub masks: Vec<Vec<usize>>,
    /// What the method keeps for itself, such as sums that are not reported yet.
    pub method: serde_json::Value,
}

/// A run between two steps, to be written.
pub struct Checkpoint<'a> {
    /// Name, shape and values of all that the next step depends on.
    pub tensors: Vec<(String, &'a [usize], &'a [f32])>,
    /// All else.
    pub standing: Standing,
}

/// Parts of the arena that go into a checkpoint, under these names; gradients are zero between steps.
const PARTS: [&str; 3] = ["params", "first", "second"];

/// A model's tensors for a checkpoint: `params.…`, `first.…` and `second.…` of each block of the layout.
pub fn tensors(model: &Model) -> Vec<(String, &[usize], &[f32])> {
    let Arena { params, first, second, .. } = &model.arena;
    tensors_of("", model.pipeline.layout(), [params, first, second])
}

/// Parameters of `layout`, or these and both moments, under the names of [`tensors`], with `prefix` before them.
pub fn tensors_of<'a, const N: usize>(
    prefix: &str,
    layout: &'a Layout,
    parts: [&'a [f32]; N],
) -> Vec<(String, &'a [usize], &'a [f32])> {
    let mut all = vec![];
    for (part, values) in PARTS.into_iter().zip(parts) {
        for b in &layout.blocks {
            all.push((format!("{prefix}{part}.{}", b.name), &b.shape[..], &values[b.range.clone()]));
        }
    }
    all
}

/// A checkpoint read back, or the part of it that one method of a chain wrote.
#[derive(Debug, Clone, PartialEq)]
pub struct Resume {
    /// The file, for messages.
    pub place: String,
    /// All but the tensors.
    pub standing: Standing,
    /// The tensors of the whole file.
    pub weights: Arc<Weights>,
    /// What the names of this part's tensors begin with.
    prefix: String,
}

impl Resume {
    /// What stands in the file `place`.
    pub fn new(place: String, standing: Standing, weights: Weights) -> Self {
        Self { place, standing, weights: Arc::new(weights), prefix: String::new() }
    }

    /// The part whose tensors have `prefix` before their names, with a standing of its own.
    pub fn part(&self, prefix: &str, standing: Standing) -> Self {
        let prefix = format!("{}{prefix}", self.prefix);
        Self { place: self.place.clone(), standing, weights: self.weights.clone(), prefix }
    }

    /// Names of its [`Checkpoint::tensors`].
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.weights.tensors.keys().filter_map(|name| name.strip_prefix(&self.prefix))
    }

    /// Shape and values of one of its tensors.
    pub fn tensor(&self, name: &str) -> Option<&(Vec<usize>, Vec<f32>)> {
        self.weights.tensors.get(&format!("{}{name}", self.prefix))
    }

    /// The values of one of its tensors, which is to have this shape.
    pub fn shaped(&self, name: &str, shape: &[usize]) -> Result<&[f32]> {
        match self.tensor(name) {
            Some((found, values)) if found == shape => Ok(values),
            other => {
                let found = other.map_or("nothing".into(), |(shape, _)| format!("shape {shape:?}"));
                Err(Error::invalid(&self.place, name, found, format!("a tensor of shape {shape:?}")))
            }
        }
    }

    /// Brings a model that was built from the same spec to where the run stood: masked channels leave it again, and
    /// parameters and moments are replaced. Refuses a checkpoint that does not fit.
    pub fn restore(&self, model: &mut Model) -> Result<()> {
        for keep in &self.standing.masks {
            model.mask(keep.clone())?;
        }
        let Arena { params, first, second, .. } = &mut model.arena;
        self.load("", model.pipeline.layout(), [params, first, second])
    }

    /// What [`tensors_of`] gave of `layout` under `prefix`.
    pub fn load<const N: usize>(&self, prefix: &str, layout: &Layout, parts: [&mut [f32]; N]) -> Result<()> {
        for (part, values) in PARTS.into_iter().zip(parts) {
            let prefix = format!("{}{prefix}{part}.", self.prefix);
            let own =
                |(k, v): (&String, &(Vec<usize>, Vec<f32>))| Some((k.strip_prefix(&prefix)?.to_owned(), v.clone()));
            let tensors = self.weights.tensors.iter().filter_map(own).collect();
            let weights = Weights { tensors, ..Weights::default() };
            let report = weights.load(&self.place, layout, values, |_| true)?;
            if let Some((tensor, why)) = report.unused.first() {
                return Err(Error::invalid(&self.place, tensor, why, "only tensors of this pipeline"));
            }
        }
        Ok(())
    }
}
