//! The way of every run: open a scan, plan a spec or a budget, run, record.
//!
//! [`Session::open`] builds the requested spec and refuses what does not fit into memory, before the scan is read.
//! [`Session::plan`] takes the inputs and, within a budget, measures this machine and chooses the method. [`Run::solve`]
//! runs it, and [`Run::record`] describes all of it.

use crate::files::Interrupted;
use crate::input::{Input, check_reference};
use crate::machine::{Machine, simd_level};
use crate::memory;
use crate::method::{self, Planned, Read};
use crate::record::{History, RunRecord, Stretch, Written};
use crate::tradeoff::calibrate::Bench;
use crate::tradeoff::front::Front;
use crate::tradeoff::schedule::{Budget, Reason, Schedule};
use crate::{plugins, ranks, rehearsal, score, specs};
use conefield_core::backend::Backend;
use conefield_core::checkpoint::Resume;
use conefield_core::method::{Job, Limits, Observer, Reconstruction, Record, Silent, Solution};
use conefield_core::place::Moved;
use conefield_core::scan::{Scan, Volume};
use conefield_core::spec::load::Loaded;
use conefield_core::trained::TrainedField;
use conefield_core::{Error, Result};
use conefield_evaluation::metrics::Scores;
use conefield_evaluation::report::text::bytes;
use std::cell::Cell;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use tracing::info;

/// The request for a run, without the scan.
#[derive(Default)]
pub struct Request<'a> {
    /// Reads the requested spec with overriding settings. Without it, the budget chooses.
    pub spec: Option<Read<'a>>,
    /// The front from which the budget chooses; the shipped front if `None`.
    pub front: Option<Front>,
    /// Overriding settings, as for `--set`.
    pub sets: Vec<String>,
    /// Weights or a volume to start from.
    pub init: Option<PathBuf>,
    /// Ends of training.
    pub limits: Limits,
    /// Seconds for everything.
    pub budget: Option<f64>,
    /// Seed of all random numbers.
    pub seed: u64,
}

/// The method that a request leads to.
enum Wish {
    /// This one.
    Method(Planned),
    /// The best one of this front for this many seconds.
    OneOf(Front, f64),
}

/// A run whose scan is not read yet.
pub struct Session<'a> {
    /// The request without what was read from it.
    request: Request<'static>,
    backend: &'a dyn Backend,
    run: memory::Run,
    begin: Instant,
    wish: Wish,
}

impl<'a> Session<'a> {
    /// Builds the requested spec: its stages, and the weights that it names. `run` is the memory of the run besides the
    /// method; `begin` is the start of the budget. Refuses contradictory ends, an invalid spec, and a method that does
    /// not fit into memory.
    pub fn open(mut request: Request<'_>, backend: &'a dyn Backend, run: memory::Run, begin: Instant) -> Result<Self> {
        if request.budget.is_some() && request.limits != Limits::default() {
            let expected = "a budget, or steps and seconds";
            return Err(Error::invalid("run", "budget", "another end of training", expected));
        }
        let wish = match (request.spec, request.budget) {
            (Some(read), _) => {
                Wish::Method(method::planned(read, &request.sets, request.init.as_deref(), backend, &run, true)?)
            }
            (None, Some(seconds)) => Wish::OneOf(request.front.take().map_or_else(Front::shipped, Ok)?, seconds),
            (None, None) => {
                return Err(Error::invalid("run", "spec", "nothing", "a spec, or a budget to choose one by"));
            }
        };
        let request = Request { spec: None, front: None, ..request };
        Ok(Self { request, backend, run, begin, wish })
    }

    /// The requested spec, unless the budget chooses.
    pub fn requested(&self) -> Option<&Loaded> {
        match &self.wish {
            Wish::Method(method) => Some(&method.loaded),
            Wish::OneOf(..) => None,
        }
    }

    /// Whether the requested method models what lies beyond the volume.
    pub fn surrounded(&self) -> bool {
        let Wish::Method(Planned { plan, .. }) = &self.wish else { return false };
        plan.needs(&self.run.scan.header()).surround > 0
    }

    /// Reads the inputs by `read`. A device meanwhile compiles the kernels of the requested method.
    pub fn reading<T>(&self, read: impl FnOnce() -> Result<T>) -> Result<T> {
        let Wish::Method(Planned { loaded, plan, .. }) = &self.wish else { return read() };
        // The method's parameters are then there beside what reading takes.
        let needs = plan.needs(&self.run.scan.header());
        let both = self.run.reading().total + needs.model + needs.optimizer + needs.backend;
        if both > memory::limit() { read() } else { rehearsal::meanwhile(loaded, self.backend, read) }
    }

    /// Plans the run on `input`, or the rest of the run `earlier`. Within a budget this measures the machine for a few
    /// seconds.
    pub fn plan(self, input: Input, earlier: Option<&Interrupted>, cancelled: &dyn Fn() -> bool) -> Result<Run<'a>> {
        let Self { request, backend, run, begin, wish } = self;
        let (from_step, spent) = earlier.map_or((0, 0.0), |e| (e.resume.standing.step, e.resume.standing.seconds));
        let mut history = earlier.map(|e| e.history.clone()).unwrap_or_default();
        let load_s = begin.elapsed().as_secs_f64();
        if let Wish::Method(m) = &wish {
            specs::check_held_out(&m.loaded, m.plan.as_ref(), &input.held)?;
        }
        let bench = Bench { job: input.job(backend, request.seed, request.limits, None), cancelled };
        let budget = |seconds| Budget { begin, seconds, spent };
        let (method, schedule) = match wish {
            Wish::Method(mut method) => {
                let reason = history.reason.take().unwrap_or_else(Reason::requested);
                let schedule = request.budget.map(|s| budget(s).plan(&bench, &mut method, reason)).transpose()?;
                (method, schedule)
            }
            Wish::OneOf(front, seconds) => {
                let refused = Cell::new(false);
                let choose = |disk: bool| {
                    budget(seconds).choose(&bench, &front, |spec, own| {
                        let sets = [own, &request.sets].concat();
                        let start = request.init.as_deref();
                        method::planned(&|s| specs::read(spec, s), &sets, start, backend, &run, disk)
                            .inspect_err(|_| refused.set(true))
                    })
                };
                // The disk only if memory holds no method: one that needs it would make all others slow.
                let (method, schedule) =
                    choose(false).or_else(|e| if refused.get() { choose(true) } else { Err(e) })?;
                specs::check_held_out(&method.loaded, method.plan.as_ref(), &input.held)?;
                (method, Some(schedule))
            }
        };
        schedule.iter().flat_map(|s| s.lines(&method.loaded.spec.name)).for_each(|line| info!("{line}"));
        info!("memory: {}", method.memory.line());
        history.reason = schedule.as_ref().map(|schedule| schedule.reason.clone());
        let here = Stretch { backend: backend.describe(), from_step };
        if history.backends.last().is_none_or(|last| last.backend != here.backend) {
            history.backends.push(here);
        }
        let (seed, limits) = (request.seed, request.limits);
        let (budget, moved) = (request.budget, backend.moved());
        Ok(Run { input, method, schedule, history, backend, seed, limits, budget, begin, spent, load_s, moved })
    }
}

/// A planned run.
pub struct Run<'a> {
    /// The inputs.
    pub input: Input,
    /// The method.
    pub method: Planned,
    /// The plan of a budget.
    pub schedule: Option<Schedule>,
    /// What its checkpoints keep for the record.
    pub history: History,
    backend: &'a dyn Backend,
    seed: u64,
    limits: Limits,
    budget: Option<f64>,
    begin: Instant,
    spent: f64,
    load_s: f64,
    /// Bytes that the backend had moved before.
    moved: Moved,
}

/// A solution with the times around it.
pub struct Solved {
    /// The solution.
    pub solution: Solution,
    /// Seconds of solving without training: before the first step, and for metrics.
    pub prepare_s: f64,
}

impl<'a> Run<'a> {
    /// Plans a run on a `scan` in memory, of whose views those with the indices `held` are held out. Refuses a reference of
    /// another shape than the scan's volume; see [`Session::open`] and [`Session::plan`].
    pub fn in_memory(
        scan: Arc<Scan>,
        held: Vec<usize>,
        reference: Option<Volume>,
        peak: Option<f64>,
        request: Request<'_>,
        backend: &'a dyn Backend,
        begin: Instant,
        cancelled: &dyn Fn() -> bool,
    ) -> Result<Self> {
        reference.iter().try_for_each(|r| check_reference("reference", r, &scan))?;
        let (split, scored) = (!held.is_empty(), reference.is_some());
        let kept = Arc::strong_count(&scan) > 1;
        let run = memory::Run { split, kept, reference: scored, ..memory::Run::on_scan(&scan) };
        let session = Session::open(request, backend, run, begin)?;
        session.plan(Input::new(scan, held, reference, peak)?, None, cancelled)
    }

    /// Runs the method from `start`, a volume, or from the checkpoint `resume`.
    pub fn solve(
        &mut self,
        start: Option<&Volume>,
        resume: Option<&Resume>,
        observer: &mut dyn Observer,
    ) -> Result<Solved> {
        let begin = Instant::now();
        let job = self.input.job(self.backend, self.seed, self.limits, self.schedule.as_ref());
        let job = Job { start, resume, ..job };
        let Planned { loaded, plan, .. } = &mut self.method;
        let mut solution = None;
        let lead = &mut || plan.run(&job, observer).map(|found| solution = Some(found));
        let follow =
            |backend: &dyn Backend| method::plan(loaded, backend)?.run(&Job { backend, ..job }, &mut Silent).map(drop);
        self.backend.run(lead, &follow).map_err(|e| loaded.locate(e))?;
        let solution = solution.unwrap_or_else(|| unreachable!("the leading backend has run"));
        let prepare_s = (begin.elapsed().as_secs_f64() + self.spent - solution.train_s).max(0.0);
        Ok(Solved { solution, prepare_s })
    }

    /// Bytes moved since the run was planned.
    fn moved(&self) -> Moved {
        let (before, now) = (self.moved, self.backend.moved());
        Moved { to_device: now.to_device - before.to_device, from_device: now.from_device - before.from_device }
    }

    /// Scores of `volume`, called `place` in errors, against the reference, if there is one.
    pub fn scores(&self, place: &str, volume: &Volume) -> Result<Option<Scores>> {
        self.input.reference.as_ref().map(|r| score::score(place, volume, r, self.input.peak)).transpose()
    }

    /// The volume of a solution, in attenuation per unit of the scan, with its scores, if there is a reference, and the time
    /// for both. `collect` computes its voxels.
    pub fn scored(
        &self,
        solved: &Solved,
        collect: &dyn Fn(&Reconstruction, &dyn Backend) -> Result<Volume>,
    ) -> Result<(Volume, Written)> {
        let start = Instant::now();
        let mut volume = collect(&solved.solution.result, self.backend)?;
        volume.affine = volume.affine.or(self.input.reference.as_ref().and_then(|r| r.affine));
        let export_s = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let scores = self.scores("the volume", &volume)?;
        let parameters = parameters(&solved.solution.result);
        let written = Written { parameters, export_s, picture_s: 0.0, score_s: start.elapsed().as_secs_f64(), scores };
        Ok((volume, written))
    }

    /// The record of the whole run, after the export; `last` is its last record of progress. The caller adds the names of
    /// files.
    pub fn record(&self, solved: &Solved, last: Option<&Record>, written: Written) -> RunRecord {
        let Solved { solution, prepare_s } = solved;
        let (method, best) = (&self.method, solution.best);
        let mut backend = method.plan.outline().backend();
        if backend.backend.is_empty() {
            // Only a field is compiled when it is planned.
            backend.backend = self.backend.describe();
        }
        let backends = if self.history.backends.len() > 1 { self.history.backends.clone() } else { vec![] };
        let moved = self.moved();
        if moved.to_device > 0 {
            info!("moved {} to the device and {} from it", bytes(moved.to_device), bytes(moved.from_device));
        }
        RunRecord {
            version: env!("CARGO_PKG_VERSION"),
            spec: method.loaded.spec.name.clone(),
            seed: self.seed,
            scan: None,
            held_out_views: self.input.held.clone(),
            limits: self.limits,
            budget_s: self.budget,
            plan: self.schedule.clone(),
            init: None,
            reference: None,
            reference_fnv1a64: self.input.reference_fnv1a64.clone(),
            files: BTreeMap::new(),
            hounsfield: None,
            plugins: plugins::used(&method.loaded.tree),
            backend,
            backends,
            processes: ranks::count(),
            moved,
            simd: simd_level(),
            threads: rayon::current_num_threads(),
            machine: Machine::here(),
            memory: method.memory,
            peak_bytes: memory::peak(),
            steps: solution.steps,
            rollbacks: solution.rollbacks,
            load_s: self.load_s,
            prepare_s: *prepare_s,
            train_s: solution.train_s,
            written,
            total_s: self.begin.elapsed().as_secs_f64() + self.spent,
            samples: solution.samples,
            samples_per_s: (solution.sampling_s > 0.0).then(|| solution.samples as f64 / solution.sampling_s),
            loss: last.and_then(|r| r.loss),
            held_out: best.map(|b| b.held_out).or(last.and_then(|r| r.held_out)),
            best_step: best.map(|b| b.step),
            peak: self.input.peak,
        }
    }
}

/// Number of parameters of the field in `result`; 0 without a field.
pub fn parameters(result: &Reconstruction) -> usize {
    result.field().map_or(0, |f| f.model.pipeline.layout().len())
}

/// The trained field in `result`, if there is one.
pub fn field(result: Reconstruction) -> Option<TrainedField> {
    match result {
        Reconstruction::Volume(_) => None,
        Reconstruction::Field(field) => Some(field),
        Reconstruction::Refined { field, .. } => Some(*field),
    }
}
