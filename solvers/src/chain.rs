//! Runs methods one after the other, each starting from the volume of the previous one.
//!
//! A field and total variation have different errors. Training a field first and then running total variation with a
//! pull towards the field's volume (`pull` of `fista`) is more accurate than either alone. Likewise, one prior on grids
//! of different spacing has different errors: the mean of the volumes is more accurate than each of them.

mod made;

use conefield_core::checkpoint::Checkpoint;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::geometry::VoxelGrid;
use conefield_core::method::StartFile;
use conefield_core::method::{
    Context, Findings, Job, Limits, Line, Method, Needs, Observer, Outline, Plan, PretrainJob, Record, Solution,
};
use conefield_core::parts::Part;
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::spec::stage;
use conefield_core::trained::{Placement, TrainedField};
use made::Made;
use ndarray::Array3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `chain`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Chain {
    /// The methods, in order. An entry may use `extends`. The command line's limits on steps and seconds apply to the
    /// first method.
    #[serde(deserialize_with = "stage::list")]
    #[schemars(schema_with = "stage::schema_of_list::<dyn Method>")]
    pub methods: Vec<Box<dyn Method>>,
    /// Number of final methods whose volumes are averaged; 1 returns the last volume.
    #[serde(default = "one")]
    pub mean: usize,
    /// Skip a method that has the same unknowns and pixels as the next one, which then does its passes too. Two levels
    /// of a small volume can have the same grid, and restarting an iteration in between loses its momentum. The mean
    /// then includes fewer volumes.
    #[serde(default)]
    pub merge: bool,
}

fn one() -> usize {
    1
}

conefield_core::stage_type!(
    Method,
    "chain",
    Chain,
    "methods in sequence, each starting from the volume of the previous one"
);

impl Method for Chain {
    fn plan(&self, context: &Context<'_>) -> Result<Box<dyn Plan>> {
        let count = self.methods.len();
        ensure(count > 1, "spec", "methods", count, "at least 2 methods")?;
        let expected = format!("1 to {count}, the number of methods");
        ensure((1..=count).contains(&self.mean), "spec", "mean", self.mean, expected)?;
        let mut links = vec![];
        for (i, method) in self.methods.iter().enumerate() {
            let mut link = method.plan(context).map_err(|e| e.within(&at(i)))?;
            ensure(link.links().is_empty(), "spec", &at(i), "a chain in a chain", "a method that is none")?;
            let starts = i == 0 || link.starts_from_volume();
            ensure(starts, "spec", &at(i), method.type_name(), "a method that starts from a volume")?;
            links.push(link);
        }
        Ok(Box::new(ChainPlan { links, mean: self.mean, merge: self.merge }))
    }

    fn start_setting(&self, file: &StartFile) -> Option<(String, serde_json::Value)> {
        let (path, value) = self.methods.first()?.start_setting(file)?;
        Some((format!("methods.0.{path}"), value))
    }
}

/// Limits of the next of `left` methods after `spent` seconds: its `passes`, and time. The last method ends before the
/// deadline; an earlier one leaves each remaining method at least the time that it may take itself.
fn later(limits: &Limits, spent: f64, left: usize, passes: Option<u64>) -> Limits {
    let most = limits.at_most.map(|all| (all - spent).max(0.0));
    if left == 1 {
        return Limits { steps: passes, at_most: most, deadline: limits.then, ..Limits::default() };
    }
    let part = limits.then.map(|end| end.saturating_duration_since(Instant::now()).as_secs_f64() / left as f64);
    let at_most = most.into_iter().chain(part).reduce(f64::min);
    Limits { steps: passes, at_most, ..Limits::default() }
}

/// The key of a method.
fn at(i: usize) -> String {
    format!("methods.{i}")
}

/// The plan of [`Chain`].
struct ChainPlan {
    /// At least two methods.
    links: Vec<Box<dyn Plan>>,
    /// Number of last volumes to average.
    mean: usize,
    /// Whether to merge methods on the same grid.
    merge: bool,
}

impl ChainPlan {
    /// Whether the mean includes the volume of method `i`.
    fn counts(&self, i: usize) -> bool {
        self.mean > 1 && i + self.mean >= self.links.len()
    }

    /// The passes of method `i` that the next method makes instead. The first method obeys the command line's limits
    /// and is never merged.
    fn merged(&self, i: usize, scan: &ScanHeader) -> Option<u64> {
        let next = self.links.get(i + 1).filter(|next| self.merge && i > 0 && next.passes().is_some())?;
        let seen = self.links[i].seen(scan)?;
        self.links[i].passes().filter(|_| next.seen(scan) == Some(seen))
    }

    /// The method whose field is returned: the last one that trains a field.
    fn trains(&self) -> &dyn Plan {
        let last = self.links.iter().rfind(|l| l.pipeline().is_some());
        last.unwrap_or(&self.links[0]).as_ref()
    }
}

impl Plan for ChainPlan {
    fn outline(&self) -> Outline {
        let links: Vec<Outline> = self.links.iter().map(|l| l.outline()).collect();
        let kinds: Vec<&str> = links.iter().map(|l| &l.method.kind[..]).collect();
        let mean = if self.mean > 1 { format!("; the mean of the last {} volumes", self.mean) } else { String::new() };
        let merge = if self.merge { "; methods on one grid are merged" } else { "" };
        let what = format!("{}{mean}{merge}", kinds.join(", then "));
        Outline { method: Line::new("method", "chain", &what), links, ..Outline::default() }
    }

    /// The methods run one after the other. Later ones also hold their start volume and the sum of earlier volumes; a
    /// checkpoint has both, and the parameters of a trained field.
    fn needs(&self, scan: &ScanHeader) -> Needs {
        let volumes = 4 * scan.voxels() * if self.mean > 1 { 2 } else { 1 };
        let mut parameters = 0;
        let mut all = self.links[0].needs(scan);
        for (link, before) in self.links[1..].iter().zip(&self.links) {
            parameters = before.pipeline().map_or(parameters, |p| 4 * p.layout().len() as u64);
            let needs = link.needs(scan);
            let (working, resume) = (needs.working + volumes, needs.resume + volumes + parameters);
            all = all.most(Needs { working, resume, ..needs });
        }
        all
    }

    fn inspect(&self, scan: &Scan) -> Result<Findings> {
        let mut all = Findings::default();
        for (i, link) in self.links.iter().enumerate() {
            let found = link.inspect(scan).map_err(|e| e.within(&at(i)))?;
            let new: Vec<String> = found.lines.into_iter().filter(|line| !all.lines.contains(line)).collect();
            all.lines.extend(new);
            if let Some(passes) = self.merged(i, &scan.header()) {
                let next = at(i + 1);
                all.lines.push(format!("{} has the same grid as {next}, which does its {passes} passes too", at(i)));
            }
            all.attenuation = all.attenuation.or(found.attenuation);
            all.samples = all.samples.or(found.samples);
        }
        Ok(all)
    }

    fn run(&mut self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let (mut made, mut kept) = match job.resume {
            Some(resume) => Made::resumed(resume, &self.links, job)?,
            None => (Made::default(), None),
        };
        let count = self.links.len();
        let merged: Vec<Option<u64>> = (0..count).map(|i| self.merged(i, &job.scan.header())).collect();
        for i in made.links..count {
            if merged[i].is_some() {
                made.links += 1;
                continue;
            }
            let left = merged[i..].iter().filter(|merged| merged.is_none()).count();
            let before: u64 = merged[..i].iter().rev().map_while(|passes| *passes).sum();
            // A number of passes here replaces the method's own end in seconds.
            let passes = self.links[i].passes().map(|own| own + before);
            let passes = passes.filter(|_| before > 0 || job.limits.then.is_some());
            let limits = match i {
                0 => job.limits,
                _ => later(&job.limits, made.counts.train_s, left, passes),
            };
            let resume = kept.take();
            let link = Job { start: made.start().or(job.start), limits, resume: resume.as_ref(), ..*job };
            let mut heard = LinkObserver { observer: &mut *observer, made: &made };
            let solution = self.links[i].run(&link, &mut heard).map_err(|e| match e {
                Error::Interrupted { step } => Error::Interrupted { step: made.counts.steps + step },
                e => e.within(&at(i)),
            })?;
            made.add(solution, self.counts(i), i + 1 < count, job)?;
            if i + 1 < count {
                // The next method resumes here if it is interrupted before its own first checkpoint.
                observer.keep(&made.checkpoint(None)?, false)?;
            }
        }
        let mean = (0..count).filter(|&i| self.counts(i) && merged[i].is_none()).count();
        made.solution(mean)
    }

    fn pretrain(&mut self, job: &PretrainJob<'_>, observer: &mut dyn Observer) -> Result<Model> {
        self.links[0].pretrain(job, observer).map_err(|e| e.within(&at(0)))
    }

    fn restore(&self, placement: &Placement, load: &mut dyn FnMut(&mut Model) -> Result<()>) -> Result<TrainedField> {
        self.trains().restore(placement, load)
    }

    fn pipeline(&self) -> Option<&Pipeline> {
        self.trains().pipeline()
    }

    fn reads(&self, scan: &ScanHeader, room: u64) -> Vec<String> {
        let all = self.links.iter().enumerate();
        all.flat_map(|(i, l)| l.reads(scan, room).into_iter().map(move |line| format!("{}: {line}", at(i)))).collect()
    }

    fn needs_held_out(&self) -> Option<String> {
        let mut all = self.links.iter().enumerate();
        all.find_map(|(i, l)| l.needs_held_out().map(|setting| format!("{}.{setting}", at(i))))
    }

    fn links(&mut self) -> &mut [Box<dyn Plan>] {
        &mut self.links
    }
}

/// Observes one method: adds the steps and seconds of earlier methods, and their results to its checkpoints.
struct LinkObserver<'a> {
    observer: &'a mut dyn Observer,
    made: &'a Made,
}

impl Observer for LinkObserver<'_> {
    fn progress(&mut self, step: u64, share: f64, seconds_left: f64) {
        self.observer.progress(self.made.counts.steps + step, share, seconds_left);
    }

    fn record(&mut self, record: &Record) {
        let (step, seconds) = (self.made.counts.steps + record.step, self.made.counts.train_s + record.seconds);
        self.observer.record(&Record { step, seconds, ..record.clone() });
    }

    fn note(&mut self, text: &str) {
        self.observer.note(text);
    }

    fn warn(&mut self, text: &str) {
        self.observer.warn(text);
    }

    fn cancelled(&self) -> bool {
        self.observer.cancelled()
    }

    fn checkpoint_due(&self) -> bool {
        self.observer.checkpoint_due()
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint<'_>) -> Result<()> {
        self.observer.checkpoint(&self.made.checkpoint(Some(checkpoint))?)
    }

    fn slices_due(&self) -> bool {
        self.observer.slices_due()
    }

    fn slices(&mut self, grid: VoxelGrid, slices: &[(Part, Array3<f32>)]) -> Result<()> {
        self.observer.slices(grid, slices)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn links_before_the_last_leave_time_for_it() {
        let end = Instant::now() + Duration::from_secs(60);
        let all = Limits { at_most: Some(100.0), then: Some(end), ..Limits::default() };
        let middle = later(&all, 10.0, 3, Some(4));
        assert_eq!(middle.deadline, None);
        assert!(middle.at_most.is_some_and(|s| (19.0..=20.0).contains(&s)), "{middle:?}");
        assert_eq!(later(&all, 95.0, 2, Some(4)).at_most, Some(5.0));
        let last = later(&all, 10.0, 1, Some(4));
        assert_eq!((last.deadline, last.at_most, last.steps), (Some(end), Some(90.0), Some(4)));
        assert_eq!(later(&Limits::default(), 10.0, 2, None), Limits::default());
        assert_eq!(later(&Limits::default(), 10.0, 2, Some(9)).steps, Some(9));
    }
}
