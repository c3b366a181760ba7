//! The state of a run between two steps: enough to continue bit-identically.

use crate::arena::{Arena, Block, Layout, Weights};
use crate::error::{Error, Result};
use crate::pipeline::Model;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The state of a run besides the arena. Random numbers depend on seed and step only.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Standing {
    /// Finished steps.
    pub step: u64,
    /// Last step that existing records may cover; later steps are recorded again.
    pub recorded: u64,
    /// Training samples so far.
    pub samples: u64,
    /// Seconds of training so far.
    pub seconds: f64,
    /// The encoder's remaining channels after each masking, in order; see [`Model::masks`].
    pub masks: Vec<Vec<usize>>,
    /// The method's own state, such as sums not yet reported.
    pub method: serde_json::Value,
}

/// A run between two steps, ready to be written.
pub struct Checkpoint<'a> {
    /// Name, shape and values of every tensor that the next step depends on.
    pub tensors: Vec<(String, &'a [usize], &'a [f32])>,
    /// Everything else.
    pub standing: Standing,
}

/// Parts of the arena in a checkpoint, by name. Gradients are zero between steps.
const PARTS: [&str; 3] = ["params", "first", "second"];

/// A model's tensors for a checkpoint: `params.…`, `first.…` and `second.…` of each block of the layout.
pub fn tensors(model: &Model) -> Vec<(String, &[usize], &[f32])> {
    let Arena { params, first, second, .. } = &model.arena;
    tensors_of("", model.pipeline.layout(), &[params, first, second])
}

/// Parameters of `layout`, optionally with both moments, named as in [`tensors`] after `prefix`.
pub fn tensors_of<'a>(prefix: &str, layout: &'a Layout, parts: &[&'a [f32]]) -> Vec<(String, &'a [usize], &'a [f32])> {
    let mut all = vec![];
    for (part, values) in PARTS.into_iter().zip(parts) {
        for b in &layout.blocks {
            all.push((format!("{prefix}{part}.{}", b.name), &b.shape[..], &values[b.range.clone()]));
        }
    }
    all
}

/// A checkpoint read from a file, or the part of one method of a chain.
#[derive(Debug, Clone, PartialEq)]
pub struct Resume {
    /// File name, for messages.
    pub place: String,
    /// Everything but the tensors.
    pub standing: Standing,
    /// The tensors of the whole file.
    pub weights: Arc<Weights>,
    /// Name prefix of this part's tensors.
    prefix: String,
}

impl Resume {
    /// The content of the file `place`.
    pub fn new(place: String, standing: Standing, weights: Weights) -> Self {
        Self { place, standing, weights: Arc::new(weights), prefix: String::new() }
    }

    /// The part of the tensors with name prefix `prefix`, with its own standing.
    pub fn part(&self, prefix: &str, standing: Standing) -> Self {
        let prefix = format!("{}{prefix}", self.prefix);
        Self { place: self.place.clone(), standing, weights: self.weights.clone(), prefix }
    }

    /// Names of its tensors.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.weights.tensors.keys().filter_map(|name| name.strip_prefix(&self.prefix))
    }

    /// Shape and values of one of its tensors.
    pub fn tensor(&self, name: &str) -> Option<&(Vec<usize>, Vec<f32>)> {
        self.weights.tensors.get(&format!("{}{name}", self.prefix))
    }

    /// The values of one of its tensors; fails unless it has this shape.
    pub fn shaped(&self, name: &str, shape: &[usize]) -> Result<&[f32]> {
        match self.tensor(name) {
            Some((found, values)) if found == shape => Ok(values),
            other => {
                let found = other.map_or("nothing".into(), |(shape, _)| format!("shape {shape:?}"));
                Err(Error::invalid(&self.place, name, found, format!("a tensor of shape {shape:?}")))
            }
        }
    }

    /// Restores a model that was built from the same spec: removes masked channels again and replaces parameters and
    /// moments. Refuses a checkpoint that does not fit.
    pub fn restore(&self, model: &mut Model) -> Result<()> {
        for keep in &self.standing.masks {
            model.mask(keep.clone())?;
        }
        let Arena { params, first, second, .. } = &mut model.arena;
        self.load("", model.pipeline.layout(), &mut [params, first, second])
    }

    /// Loads what [`tensors_of`] returned for `layout` under `prefix`.
    pub fn load(&self, prefix: &str, layout: &Layout, parts: &mut [&mut [f32]]) -> Result<()> {
        for (part, values) in PARTS.into_iter().zip(parts) {
            let prefix = format!("{prefix}{part}.");
            for Block { name, shape, range } in &layout.blocks {
                let from = self.shaped(&format!("{prefix}{name}"), shape)?;
                if let Some(x) = from.iter().find(|x| !x.is_finite()) {
                    return Err(Error::invalid(&self.place, name, x, "finite weights"));
                }
                values[range.clone()].copy_from_slice(from);
            }
            let mut names = self.names().filter_map(|name| name.strip_prefix(&*prefix));
            if let Some(name) = names.find(|name| layout.find(name).is_none()) {
                return Err(Error::invalid(&self.place, name, "not in this pipeline", "only tensors of this pipeline"));
            }
        }
        Ok(())
    }
}
