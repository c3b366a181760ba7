//! Two solvers one after the other: the second, on voxels, starts from the volume of the first, and may be held to it.
//!
//! A field and total variation err in different places. A field that is trained first, and total variation that is held to its
//! volume (`pull` of `fista-tv`), come closer than either alone.

use conefield_core::checkpoint::Checkpoint;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::pipeline::Model;
use conefield_core::scan::Scan;
use conefield_core::solver::{Job, Limits, Observer, PretrainJob, Reconstruction, Record, Solution, Solver, Successor};
use conefield_core::spec::{InitializerSpec, SceneSettings, SolverSpec, Spec, VolumeStart};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

/// Settings of `sequence`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sequence {
    /// The solver that begins: of a field, with the spec's stages, or of voxels. Limits of steps and seconds are its.
    #[serde(deserialize_with = "conefield_core::spec::stage::needed")]
    #[schemars(schema_with = "solver")]
    pub first: Box<dyn SolverSpec>,
    /// The solver on voxels that goes on.
    #[serde(deserialize_with = "conefield_core::spec::stage::needed")]
    #[schemars(schema_with = "solver")]
    pub then: Box<dyn SolverSpec>,
    /// Its passes at most; its own `stop` may end it before.
    #[serde(default = "passes")]
    pub passes: u64,
}

fn solver(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "x-stage": "solver" })
}

fn passes() -> u64 {
    5
}

conefield_core::stage_type!(Solver, "sequence", Sequence, "a solver, then another one on voxels from where it ended");

#[typetag::serde(name = "sequence")]
impl SolverSpec for Sequence {
    fn build(&self) -> Result<Box<dyn Solver>> {
        ensure(self.passes > 0, "spec", "solver.passes", 0, "at least 1")?;
        let first = self.first.build().map_err(|e| inside("first", e))?;
        let then = self.then.build().map_err(|e| inside("then", e))?;
        let nested = first.successor(&SceneSettings::default()).or(then.successor(&SceneSettings::default())).is_some();
        ensure(!nested, "spec", "solver", "a sequence in a sequence", "two solvers that are none")?;
        // The second sees a spec without a field's stages, whose initializer brings the first one's volume.
        let alone = spec_of(self.then.as_ref(), &SceneSettings::default())?;
        if then.trains_field(&alone).map_err(|e| inside("then", e))? {
            let found = format!("{:?}, which trains a field", self.then.typetag_name());
            return Err(Error::invalid("spec", "solver.then.type", found, "a solver on voxels"));
        }
        Ok(Box::new(Turns { first, then, settings: copy(self.then.as_ref())?, passes: self.passes }))
    }
}

/// The error of one of the two with the way to it.
fn inside(which: &str, error: Error) -> Error {
    match error {
        Error::Invalid { place, field, found, expected } => {
            let field = match field.strip_prefix("solver.") {
                Some(rest) => format!("solver.{which}.{rest}"),
                None if field == "solver" => format!("solver.{which}"),
                None => field,
            };
            Error::Invalid { place, field, found, expected }
        }
        other => other,
    }
}

/// The same settings again.
fn copy(settings: &dyn SolverSpec) -> Result<Box<dyn SolverSpec>> {
    let again = serde_json::to_value(settings).and_then(serde_json::from_value);
    again.map_err(|e| Error::invalid("spec", "solver.then", e, "settings that can be written and read"))
}

/// The spec that the second solver sees.
fn spec_of(then: &dyn SolverSpec, scene: &SceneSettings) -> Result<Spec> {
    Ok(Spec { initializer: Some(Box::new(Handed)), ..Spec::voxels(copy(then)?, scene.clone()) })
}

/// Stands for the first solver's volume in the second one's spec. No user can name it: it is no registered type.
#[derive(Serialize, Deserialize)]
struct Handed;

#[typetag::serde(name = "handed")]
impl InitializerSpec for Handed {
    fn volume(&self) -> Result<Option<VolumeStart>> {
        Ok(Some(VolumeStart { path: "the first solver's volume".into(), steps: 0 }))
    }
}

/// What [`Sequence`] builds.
struct Turns {
    first: Box<dyn Solver>,
    then: Box<dyn Solver>,
    settings: Box<dyn SolverSpec>,
    passes: u64,
}

impl Solver for Turns {
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let first = self.first.solve(job, &mut First { observer: &mut *observer, over: false })?;
        let volume = first.result.volume(job.backend)?;
        let spec = spec_of(self.settings.as_ref(), &job.spec.scene)?;
        let handed = |_: &str| Ok(volume.clone());
        let limits = Limits {
            steps: Some(self.passes),
            seconds: None,
            at_most: job.limits.at_most.map(|all| (all - first.train_s).max(0.0)),
            deadline: job.limits.then,
            then: None,
        };
        let next = Job { spec: &spec, limits, volumes: &handed, resume: None, ..*job };
        let mut then = Then { observer, steps: first.steps, seconds: first.train_s };
        let second = self.then.solve(&next, &mut then)?;
        let volume = second.result.volume(job.backend)?;
        let best = second.best.map(|mut best| {
            best.step += first.steps;
            best
        });
        Ok(Solution {
            result: match first.result {
                Reconstruction::Field(field) => Reconstruction::Refined { field: Box::new(field), volume },
                _ => Reconstruction::Volume(volume),
            },
            steps: first.steps + second.steps,
            train_s: first.train_s + second.train_s,
            samples: first.samples,
            sampling_s: first.sampling_s,
            rollbacks: first.rollbacks + second.rollbacks,
            best,
        })
    }

    fn pretrain(&self, job: &PretrainJob<'_>, observer: &mut dyn Observer) -> Result<Model> {
        self.first.pretrain(job, observer)
    }

    fn trains_field(&self, spec: &Spec) -> Result<bool> {
        self.first.trains_field(spec)
    }

    fn needs_held_out(&self) -> Option<&'static str> {
        self.first.needs_held_out().or(self.then.needs_held_out())
    }

    fn plan(&self, scan: &Scan) -> Vec<String> {
        [self.first.plan(scan), self.then.plan(scan)].concat()
    }

    /// The second also holds the volume that it began with and the one that it makes.
    fn working_memory(&self, pixels: u64, voxels: u64) -> u64 {
        self.first.working_memory(pixels, voxels).max(self.then.working_memory(pixels, voxels) + 8 * voxels)
    }

    fn memory_per_parameter(&self) -> u64 {
        self.first.memory_per_parameter()
    }

    fn successor(&self, scene: &SceneSettings) -> Option<Successor<'_>> {
        let spec = spec_of(self.settings.as_ref(), scene).ok()?;
        Some(Successor { first: self.first.as_ref(), then: self.then.as_ref(), spec, passes: self.passes })
    }

    fn describe(&self) -> String {
        let (first, then) = (self.first.describe(), self.then.describe());
        format!("sequence: {first}; then at most {} passes of {then}", self.passes)
    }
}

/// Hears of the first solver. A checkpoint is due when steps or time end it: that is what an interrupted second one starts from. (A
/// field that held-out views end goes on from its last checkpoint instead, to the same end.)
struct First<'a> {
    observer: &'a mut dyn Observer,
    over: bool,
}

impl Observer for First<'_> {
    fn progress(&mut self, step: u64, share: f64, seconds_left: f64) {
        self.over = share >= 1.0;
        self.observer.progress(step, share, seconds_left);
    }

    fn record(&mut self, record: &Record) {
        self.observer.record(record);
    }

    fn note(&mut self, text: &str) {
        self.observer.note(text);
    }

    fn cancelled(&self) -> bool {
        self.observer.cancelled()
    }

    fn checkpoint_due(&self) -> bool {
        self.over || self.observer.checkpoint_due()
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint<'_>) -> Result<()> {
        self.over = false;
        self.observer.checkpoint(checkpoint)
    }
}

/// Hears of the second solver, whose passes count on from the first one's steps. It keeps no checkpoints: it is begun anew from
/// the first one's last.
struct Then<'a> {
    observer: &'a mut dyn Observer,
    steps: u64,
    seconds: f64,
}

impl Observer for Then<'_> {
    fn progress(&mut self, step: u64, share: f64, seconds_left: f64) {
        self.observer.progress(self.steps + step, share, seconds_left);
    }

    fn record(&mut self, record: &Record) {
        let (step, seconds) = (self.steps + record.step, self.seconds + record.seconds);
        self.observer.record(&Record { step, seconds, ..record.clone() });
    }

    fn note(&mut self, text: &str) {
        self.observer.note(text);
    }

    fn cancelled(&self) -> bool {
        self.observer.cancelled()
    }
}
