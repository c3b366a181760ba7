//! What the links of a chain have made so far, as the next one and a checkpoint need it.

use conefield_core::checkpoint::{Checkpoint, Resume, Standing, tensors_of};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::method::{Best, Job, Plan, Reconstruction, Solution};
use conefield_core::scan::Volume;
use conefield_core::trained::{Placement, TrainedField};
use ndarray::{Array3, Zip};
use serde::{Deserialize, Serialize};

/// Names of tensors in a checkpoint: the volume that the next link starts from, the sum of those that the mean is of; and what
/// names begin with: those of the field that was trained, and those of the link that runs.
const START: &str = "chain.start";
const SUM: &str = "chain.sum";
const FIELD: &str = "chain.field.";
const LINK: &str = "link.";

/// What links have made.
#[derive(Default)]
pub(super) struct Made {
    /// How many.
    pub(super) links: usize,
    pub(super) counts: Counts,
    /// The volume of the last one, where it is needed.
    volume: Option<Volume>,
    /// The sum of the volumes that the mean is of.
    sum: Option<Array3<f32>>,
    /// The last field that was trained, and by which link.
    field: Option<(usize, TrainedField)>,
}

/// What the solutions of all links add up to.
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

/// What a checkpoint says of a chain.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    /// Finished links.
    links: usize,
    counts: Counts,
    /// The link that trained the field, and where the field stands.
    field: Option<(usize, Placement)>,
    /// Where the link that runs stands; nothing before its first checkpoint.
    link: Option<Standing>,
}

impl Made {
    /// What the next link starts from.
    pub(super) fn start(&self) -> Option<&Volume> {
        self.volume.as_ref()
    }

    /// Adds what a link made. Its volume `counts` among those that the mean is of, or is what the `next` link starts from.
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
                Some(sum) => Zip::from(sum).and(&volume.data).par_for_each(|sum, x| *sum += x),
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

    /// What came out of all links: of `mean` links the mean.
    pub(super) fn solution(self, mean: usize) -> Result<Solution> {
        let volume = match (self.sum, self.volume) {
            (Some(sum), Some(last)) => Some(Volume { data: sum / mean as f32, affine: None, ..last }),
            (_, last) => last,
        };
        let result = match (volume, self.field) {
            (Some(volume), None) => Reconstruction::Volume(volume),
            (Some(volume), Some((_, field))) => Reconstruction::Refined { field: Box::new(field), volume },
            (None, Some((_, field))) => Reconstruction::Field(field),
            (None, None) => return Err(Error::unsupported("chain", "no method has made anything")),
        };
        let Counts { steps, train_s, samples, sampling_s, rollbacks, best } = self.counts;
        Ok(Solution { result, steps, train_s, samples, sampling_s, rollbacks, best })
    }

    /// A checkpoint of the chain, with that of the `link` that runs.
    pub(super) fn checkpoint<'a>(&'a self, link: Option<&Checkpoint<'a>>) -> Result<Checkpoint<'a>> {
        let mut tensors = vec![];
        let volume = self.volume.as_ref().map(|v| &v.data);
        for (name, data) in [(START, volume), (SUM, self.sum.as_ref())] {
            tensors.extend(data.and_then(|d| Some((name.to_owned(), d.shape(), d.as_slice()?))));
        }
        if let Some((_, TrainedField { model, .. })) = &self.field {
            tensors.extend(tensors_of(FIELD, model.pipeline.layout(), [&model.arena.params]));
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

    /// What stands in a checkpoint, with the part of the link that runs, if that has one.
    pub(super) fn resumed(resume: &Resume, links: &[Box<dyn Plan>], job: &Job<'_>) -> Result<(Self, Option<Resume>)> {
        let place = &resume.place;
        let kept = Kept::deserialize(&resume.standing.method);
        let kept = kept.map_err(|e| Error::invalid(place, "method", e, "what a chain keeps"))?;
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
                resume.load(FIELD, model.pipeline.layout(), [&mut model.arena.params])
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

/// A volume whose numbers follow each other in standard order, as a checkpoint writes them.
fn dense(volume: Volume) -> Volume {
    if volume.data.is_standard_layout() {
        return volume;
    }
    Volume { data: volume.data.as_standard_layout().into_owned(), ..volume }
}
