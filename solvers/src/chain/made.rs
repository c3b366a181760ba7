//! Results of a chain's finished methods, for the next method and for checkpoints.

use conefield_core::checkpoint::{Checkpoint, Resume, Standing, tensors_of};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::method::{Best, Job, Plan, Reconstruction, Solution};
use conefield_core::parallel;
use conefield_core::scan::Volume;
use conefield_core::trained::{Placement, TrainedField};
use ndarray::Array3;
use serde::{Deserialize, Serialize};

/// Names of tensors in a checkpoint: the start volume of the next method and the sum for the mean; then the name
/// prefixes of the trained field and of the running method.
const START: &str = "chain.start";
const SUM: &str = "chain.sum";
const FIELD: &str = "chain.field.";
const LINK: &str = "link.";

/// Results of the finished methods.
#[derive(Default)]
pub(super) struct Made {
    /// Number of finished methods.
    pub(super) links: usize,
    pub(super) counts: Counts,
    /// The last volume, if it is needed.
    volume: Option<Volume>,
    /// The sum of the volumes for the mean.
    sum: Option<Array3<f32>>,
    /// The last trained field, and the index of its method.
    field: Option<(usize, TrainedField)>,
}

/// Totals over the solutions of all methods.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Counts {
    pub(super) steps: u64,
    pub(super) train_s: f64,
    samples: u64,
    sampling_s: f64,
    rollbacks: u64,
    best: Option<Best>,
}

/// The chain's entry in a checkpoint.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    /// Number of finished methods.
    links: usize,
    counts: Counts,
    /// The index of the method that trained the field, and the field's placement.
    field: Option<(usize, Placement)>,
    /// Progress of the running method; `None` before its first checkpoint.
    link: Option<Standing>,
}

impl Made {
    /// The start volume of the next method.
    pub(super) fn start(&self) -> Option<&Volume> {
        self.volume.as_ref()
    }

    /// Adds a method's result. `counts`: the mean includes its volume; `next`: the next method starts from it.
    pub(super) fn add(&mut self, solution: Solution, counts: bool, next: bool, job: &Job<'_>) -> Result<()> {
        let Solution { result, steps, train_s, samples, sampling_s, rollbacks, best } = solution;
        self.volume = None;
        match result {
            Reconstruction::Volume(volume) => self.volume = Some(dense(volume)),
            Reconstruction::Refined { field, volume } => {
                (self.field, self.volume) = (Some((self.links, *field)), Some(dense(volume)));
            }
            Reconstruction::Field(field) => {
                if counts || next {
                    let voxels = field.voxels(job.backend, field.scene.grid);
                    self.volume = Some(dense(Volume::collect(&mut voxels?)?));
                }
                self.field = Some((self.links, field));
            }
        }
        if let (true, Some(volume)) = (counts, &self.volume) {
            match &mut self.sum {
                Some(sum) => {
                    parallel::over(sum.outer_iter_mut().zip(volume.data.outer_iter()), |_, (mut sum, x)| sum += &x)
                }
                None => self.sum = Some(volume.data.clone()),
            }
        }
        let c = &mut self.counts;
        c.best = best.map(|best| Best { step: c.steps + best.step, ..best });
        c.steps += steps;
        c.train_s += train_s;
        c.samples += samples;
        c.sampling_s += sampling_s;
        c.rollbacks += rollbacks;
        self.links += 1;
        Ok(())
    }

    /// The result of the chain: with several volumes, the mean of the last `mean`.
    pub(super) fn solution(self, mean: usize) -> Result<Solution> {
        let volume = match (self.sum, self.volume) {
            (Some(sum), Some(last)) => Some(Volume { data: sum / mean as f32, affine: None, ..last }),
            (_, last) => last,
        };
        let result = match (volume, self.field) {
            (Some(volume), None) => Reconstruction::Volume(volume),
            (Some(volume), Some((_, field))) => Reconstruction::Refined { field: Box::new(field), volume },
            (None, Some((_, field))) => Reconstruction::Field(field),
            (None, None) => return Err(Error::unsupported("chain", "no method has produced a result")),
        };
        let Counts { steps, train_s, samples, sampling_s, rollbacks, best } = self.counts;
        Ok(Solution { result, steps, train_s, samples, sampling_s, rollbacks, best })
    }

    /// A checkpoint of the chain, including that of the running method `link`.
    pub(super) fn checkpoint<'a>(&'a self, link: Option<&Checkpoint<'a>>) -> Result<Checkpoint<'a>> {
        let mut tensors = vec![];
        let volume = self.volume.as_ref().map(|v| &v.data);
        for (name, data) in [(START, volume), (SUM, self.sum.as_ref())] {
            tensors.extend(data.and_then(|d| Some((name.to_owned(), d.shape(), d.as_slice()?))));
        }
        if let Some((_, TrainedField { model, .. })) = &self.field {
            tensors.extend(tensors_of(FIELD, model.pipeline.layout(), &[&model.arena.params]));
        }
        let own = link.into_iter().flat_map(|link| &link.tensors);
        tensors.extend(own.map(|(name, shape, values)| (format!("{LINK}{name}"), *shape, *values)));
        let link = link.map(|link| link.standing.clone());
        let Standing { step, recorded, samples, seconds, .. } = link.clone().unwrap_or_default();
        let c = &self.counts;
        let field = self.field.as_ref().map(|(by, field)| (*by, field.placement()));
        let kept = serde_json::to_value(Kept { links: self.links, counts: c.clone(), field, link });
        let standing = Standing {
            step: c.steps + step,
            recorded: c.steps + recorded,
            samples: c.samples + samples,
            seconds: c.train_s + seconds,
            masks: vec![],
            method: kept.map_err(|e| Error::unsupported("checkpoint", e.to_string()))?,
        };
        Ok(Checkpoint { tensors, standing })
    }

    /// Restores the state from a checkpoint, with the running method's own part if there is one.
    pub(super) fn resumed(resume: &Resume, links: &[Box<dyn Plan>], job: &Job<'_>) -> Result<(Self, Option<Resume>)> {
        let place = &resume.place;
        let kept = serde_json::from_value::<Kept>(resume.standing.method.clone());
        let kept = kept.map_err(|e| Error::invalid(place, "method", e, "the state of a chain"))?;
        let expected = format!("fewer than {}", links.len());
        ensure(kept.links < links.len(), place, "method.links", kept.links, expected)?;
        let grid = job.scan.geometry.volume;
        let read = |name: &str| -> Result<Array3<f32>> {
            let values = resume.shaped(name, &grid.shape)?.to_vec();
            Array3::from_shape_vec(grid.shape, values).map_err(|e| Error::invalid(place, name, e, "a volume"))
        };
        let volume = (kept.links > 0).then(|| read(START)).transpose()?;
        let field = |(by, placement): (usize, Placement)| {
            let expected = format!("fewer than {}", kept.links);
            ensure(by < kept.links, place, "method.field", by, expected)?;
            let field = links[by].restore(&placement, &mut |model| {
                resume.load(FIELD, model.pipeline.layout(), &mut [&mut model.arena.params])
            })?;
            Ok::<_, Error>((by, field))
        };
        let made = Self {
            links: kept.links,
            counts: kept.counts,
            volume: volume.map(|data| Volume { data, grid, affine: None }),
            sum: resume.tensor(SUM).map(|_| read(SUM)).transpose()?,
            field: kept.field.map(field).transpose()?,
        };
        Ok((made, kept.link.map(|standing| resume.part(LINK, standing))))
    }
}

/// A volume in standard memory order, as checkpoints require.
fn dense(volume: Volume) -> Volume {
    if volume.data.is_standard_layout() {
        return volume;
    }
    Volume { data: volume.data.as_standard_layout().into_owned(), ..volume }
}
