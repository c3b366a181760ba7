//! The driver of iterative methods: passes, records, checkpoints, stopping criteria.

use super::monitor::VolumeMonitor;
use super::problem::{Problem, change, copy};
use super::stop::Stop;
use crate::schedule::Clock;
use crate::waiting::Waited;
use crate::watched;
use conefield_core::Error;
use conefield_core::checkpoint::{Checkpoint, Resume, Standing};
use conefield_core::error::{Result, ensure};
use conefield_core::finite::stray;
use conefield_core::method::{Job, Limits, Observer, Reconstruction, Record, Solution};
use conefield_core::parallel;
use conefield_core::place::{Array, Place, StatePart, squares};
use conefield_core::scan::Volume;
use conefield_core::space::Space;
use ndarray::{Array3, s};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// The results of a pass.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pass {
    /// `‖p − A·x‖²` over all views, each with the volume at the time of its update.
    pub residual: f64,
    /// Root mean square change of the volume relative to its root mean square. The driver adds it for a
    /// method that does not know it, if the run can end by it.
    pub change: Option<f64>,
    /// The value of the prior, if there is one.
    pub prior: Option<f64>,
}

/// The state of an iterative method.
pub trait Iteration {
    /// Whether every [`Pass`] has its `change`. If not, and the run can end by the change, the driver measures it, with
    /// one more volume.
    fn knows_change(&self) -> bool {
        true
    }

    /// Computes what the first pass starts from.
    fn prepare(&mut self, _: &Problem<'_>) -> Result<()> {
        Ok(())
    }

    /// Makes one pass over all views. `pass` counts from 0. A long one calls `within` now and then, with the finished
    /// share of the pass.
    fn pass(&mut self, problem: &Problem<'_>, pass: u64, within: &mut dyn FnMut(f64)) -> Result<Pass>;

    /// The unknowns: voxels in 1/mm, unless [`Iteration::volume`] and [`Iteration::take`] convert them.
    fn x(&mut self) -> &mut Array;

    /// The current volume, in 1/mm.
    fn volume(&mut self, _: &Problem<'_>) -> Result<&Array> {
        Ok(self.x())
    }

    /// The final volume; ends the method.
    fn take(mut self: Box<Self>, _: &Problem<'_>) -> Result<Array> {
        Ok(std::mem::replace(self.x(), Array::nothing()))
    }

    /// The complete state for the next pass, by name, for checkpoints.
    fn state(&mut self) -> Vec<(String, StatePart<'_>)> {
        vec![("x".into(), StatePart::Placed(self.x()))]
    }

    /// An error of a stage since the last call.
    fn fault(&self) -> Result<()> {
        Ok(())
    }

    /// What a user can change if it diverges.
    fn advice(&self) -> Option<&'static str> {
        None
    }

    /// Scalars of the state.
    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![]
    }
}

/// The driver's state in a checkpoint.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    numbers: Vec<f64>,
    waited: Waited,
    /// Whether a stopping rule is met.
    settled: bool,
}

/// Buffers that `stop` needs: for the best volume, if it has `patience`; for the volume before a pass, if it has `change`
/// and the method does not know it ([`Iteration::knows_change`]).
pub(super) fn buffers(stop: &Stop, knows_change: bool, space: &Space) -> Result<[Option<Array>; 2]> {
    let wanted = [stop.patience.is_some(), stop.change.is_some() && !knows_change];
    let [best, before] = wanted.map(|wanted| wanted.then(|| space.volume()).transpose());
    Ok([best?, before?])
}

/// Runs `method` on `job` with its [`buffers`] until `stop` or the job's limits end it. The time since `begun` counts.
pub(super) fn drive(
    job: &Job<'_>,
    stop: &Stop,
    begun: Instant,
    problem: &Problem<'_>,
    buffers: [Option<Array>; 2],
    mut method: Box<dyn Iteration + '_>,
    observer: &mut dyn Observer,
) -> Result<Solution> {
    let mut run = Run::begin(job, stop, begun, problem, buffers, method.as_mut(), observer)?;
    loop {
        let cancelled = problem.place.agree(observer.cancelled());
        if run.step > run.started && (cancelled || problem.place.agree(observer.checkpoint_due())) {
            run.checkpoint(method.as_mut(), observer, cancelled)?;
        }
        if cancelled {
            return Err(Error::Interrupted { step: run.step });
        }
        if run.step > run.started && problem.place.agree(observer.slices_due()) {
            run.slices(method.as_mut(), observer)?;
        }
        if run.over {
            return run.finish(method);
        }
        run.pass(method.as_mut(), observer)?;
    }
}

/// A run between two passes.
struct Run<'a> {
    job: &'a Job<'a>,
    stop: &'a Stop,
    problem: &'a Problem<'a>,
    monitor: VolumeMonitor<'a>,
    clock: Clock,
    kept: Kept,
    /// The volume that predicted held-out views best, see [`Kept::waited`].
    best: Option<Array>,
    /// The volume before a pass, if its change is needed and the method does not know it.
    before: Option<Array>,
    /// The step at which this process started.
    started: u64,
    step: u64,
    /// The last pass's residual, and that of an empty volume.
    residual: Option<f64>,
    empty: f64,
    over: bool,
}

impl<'a> Run<'a> {
    fn begin(
        job: &'a Job<'a>,
        stop: &'a Stop,
        begun: Instant,
        problem: &'a Problem<'a>,
        [mut best, before]: [Option<Array>; 2],
        method: &mut dyn Iteration,
        observer: &mut dyn Observer,
    ) -> Result<Self> {
        let (mut kept, mut step, mut seconds) = (Kept::default(), 0, 0.0);
        if let Some(resume) = job.resume {
            kept = restore(resume, problem.place, method, best.as_mut())?;
            (step, seconds) = (resume.standing.step, resume.standing.seconds);
            observer.note(&format!("resumed after pass {step}"));
        }
        if stop.patience.is_some() && job.held_out.is_none() {
            observer.note("stop.patience needs held-out views, and there are none: it does not end this run");
        }
        let ends = Limits { steps: stop.passes, seconds: stop.seconds, ..Limits::default() };
        let mut clock = Clock::new(ends, job.limits, seconds + begun.elapsed().as_secs_f64());
        clock.resume();
        let monitor = VolumeMonitor::new(job);
        let empty = problem.scan.projections.as_slice().map_or(f64::MAX, squares);
        let (started, residual, over) = (step, None, false);
        let mut run =
            Self { job, stop, problem, monitor, clock, kept, best, before, started, step, residual, empty, over };
        // Time alone does not end a run before its first pass.
        let share = if step == 0 { run.clock.share_of_steps(step) } else { run.clock.done(step) };
        let over = share >= 1.0 || run.kept.settled || (step > 0 && !run.clock.allows(0.0));
        run.over = problem.place.agree(over);
        if run.over {
            observer.progress(step, 1.0, 0.0);
        }
        Ok(run)
    }

    /// Makes one pass with its record and progress report.
    fn pass(&mut self, method: &mut dyn Iteration, observer: &mut dyn Observer) -> Result<()> {
        let begun = Instant::now();
        let place = self.problem.place;
        if let Some(before) = &mut self.before {
            copy(place, method.x(), before)?;
        }
        let (clock, step) = (&self.clock, self.step);
        let mut pass = method.pass(self.problem, step, &mut |part| {
            let [from, to] = [step, step + 1].map(|step| clock.done(step).min(1.0));
            let share = from + part * (to - from);
            observer.progress(step, share, clock.left(share));
        })?;
        if let Some(before) = &self.before {
            pass.change = Some(change(place, method.x(), before)?);
        }
        method.fault()?;
        self.step += 1;
        self.check(&pass, method)?;
        self.clock.pause();
        let record = self.look(&pass, method)?;
        observer.record(&record);
        self.clock.resume();
        let share = self.clock.done(self.step);
        let over = share >= 1.0 || self.kept.settled || !self.clock.allows(begun.elapsed().as_secs_f64());
        self.over = self.problem.place.agree(over);
        let (share, left) = if self.over { (1.0, 0.0) } else { (share, self.clock.left(share)) };
        observer.progress(self.step, share, left);
        Ok(())
    }

    /// Refuses a growing residual that is ten times that of an empty volume: the iteration diverges.
    fn check(&mut self, pass: &Pass, method: &dyn Iteration) -> Result<()> {
        let away = pass.residual > 100.0 * self.empty && self.residual.is_some_and(|last| pass.residual > last);
        if away || !pass.residual.is_finite() {
            let times = (pass.residual / self.empty).sqrt();
            let advice = method.advice().map(|advice| format!("; {advice}")).unwrap_or_default();
            let what = format!("the residual is {times:.3e} times that of an empty volume{advice}");
            return Err(Error::Diverged { step: self.step, what });
        }
        self.residual = Some(pass.residual);
        Ok(())
    }

    /// Evaluates the volume after a pass, keeps the best one, and checks the stopping rules.
    fn look(&mut self, pass: &Pass, method: &mut dyn Iteration) -> Result<Record> {
        let pixels = self.problem.scan.projections.len() as f64;
        // A method may have to compute its volume first.
        let volume = if self.monitor.looks() { Some(method.volume(self.problem)?) } else { None };
        let (mut held_out, mut psnr) = (None, None);
        if let Some(volume) = volume {
            held_out = self.monitor.held_out(self.problem.place, self.problem.projector, volume)?;
            if self.monitor.has_reference() {
                let scale = self.job.scan.unit.mm as f32;
                psnr = self.monitor.psnr(self.problem.place.read(volume)?.view(), scale);
            }
        }
        let mut record = Record {
            step: self.step,
            seconds: self.clock.seconds(),
            loss: Some((pass.residual / pixels).sqrt()),
            prior: pass.prior,
            change: pass.change,
            held_out,
            psnr,
            ..Record::default()
        };
        let kept = &mut self.kept;
        if let (Some(patience), Some(error), Some(best), Some(volume)) =
            (self.stop.patience, held_out, &mut self.best, volume)
        {
            let better = kept.waited.is_better(error);
            if better {
                copy(self.problem.place, volume, best)?;
            }
            kept.waited.count(self.step, error, better);
            kept.settled |= kept.waited.since >= patience;
        }
        if let (Some(limit), Some(change)) = (self.stop.change, pass.change) {
            kept.settled |= change < limit;
        }
        if kept.settled {
            record.events.push("the stopping rule is met".into());
        }
        Ok(record)
    }

    /// Sends the middle slices of the current volume.
    fn slices(&mut self, method: &mut dyn Iteration, observer: &mut dyn Observer) -> Result<()> {
        self.clock.pause();
        let mm = self.job.scan.unit.mm as f32;
        let volume = self.problem.place.read(method.volume(self.problem)?)?;
        let slices = watched::middle(volume.dim().into()).map(|part| {
            let [x, y, z] = part.clone();
            (part, volume.slice(s![x, y, z]).mapv(|v| v * mm))
        });
        observer.slices(self.job.scan.geometry.volume, &slices)?;
        self.clock.resume();
        Ok(())
    }

    fn checkpoint(&mut self, method: &mut dyn Iteration, observer: &mut dyn Observer, ends: bool) -> Result<()> {
        self.clock.pause();
        self.kept.numbers = method.numbers().iter().map(|x| **x).collect();
        let (step, seconds) = (self.step, self.clock.seconds());
        let kept = serde_json::json!(self.kept);
        let standing = Standing { step, recorded: step, seconds, method: kept, ..Standing::default() };
        let mut state = method.state();
        if let (Some(best), Some(_)) = (&mut self.best, self.kept.waited.best) {
            state.push((BEST.into(), StatePart::Placed(best)));
        }
        let read = state.iter().map(|(n, x)| Ok((n, [x.count()], x.read(self.problem.place)?)));
        let read = read.collect::<Result<Vec<_>>>()?;
        let tensors = read.iter().map(|(n, size, x)| ((*n).clone(), &size[..], &**x)).collect();
        observer.keep(&Checkpoint { tensors, standing }, ends)?;
        self.clock.resume();
        Ok(())
    }

    fn finish(mut self, method: Box<dyn Iteration + '_>) -> Result<Solution> {
        self.clock.pause();
        let Self { kept, step, job, .. } = self;
        let volume = match self.best.filter(|_| kept.waited.best.is_some()) {
            Some(best) => best,
            None => method.take(self.problem)?,
        };
        let mut data = self.problem.place.take(volume)?;
        let mm = job.scan.unit.mm as f32;
        parallel::scale(&mut data, mm);
        finite(&data, step)?;
        let volume = Volume { data, grid: job.scan.geometry.volume, affine: None };
        Ok(Solution {
            result: Reconstruction::Volume(volume),
            steps: step,
            train_s: self.clock.seconds(),
            samples: 0,
            sampling_s: 0.0,
            rollbacks: 0,
            best: kept.waited.best,
        })
    }
}

/// Name of the best volume in a checkpoint.
const BEST: &str = "best";

/// Refuses a volume with a value that is not finite.
pub(crate) fn finite(volume: &Array3<f32>, step: u64) -> Result<()> {
    match stray(volume) {
        Some((at, x)) => Err(Error::Diverged { step, what: format!("voxel {at:?} is {x}") }),
        None => Ok(()),
    }
}

/// Restores method, best volume and driver from a checkpoint.
fn restore(resume: &Resume, place: &dyn Place, method: &mut dyn Iteration, best: Option<&mut Array>) -> Result<Kept> {
    let kept: std::result::Result<Kept, _> = serde_json::from_value(resume.standing.method.clone());
    let kept = kept.map_err(|e| Error::invalid(&resume.place, "method", e, "the state of this method"))?;
    let best = best.filter(|_| kept.waited.best.is_some()).map(|best| (BEST.to_owned(), StatePart::Placed(best)));
    for (name, mut values) in method.state().into_iter().chain(best) {
        let found = resume.tensor(&name).map(|t| &t.1);
        let fits = found.filter(|t| t.len() == values.count());
        let said = found.map_or("nothing".into(), |t| format!("{} numbers", t.len()));
        let fits = fits.ok_or_else(|| {
            Error::invalid(&resume.place, name, said, format!("{} numbers, as this run needs", values.count()))
        })?;
        values.load(place, fits)?;
    }
    let numbers = method.numbers();
    let (found, want) = (kept.numbers.len(), numbers.len());
    ensure(found == want, &resume.place, "method.numbers", found, format!("{want} numbers"))?;
    for (number, saved) in numbers.into_iter().zip(&kept.numbers) {
        *number = *saved;
    }
    Ok(kept)
}
