//! `conefield study`

use super::protocol::RunProtocol;
use super::trial::{self, Start, Trial, is_done};
use super::{EndOptions, General};
use crate::boundary::{Inputs, refuse_existing};
use crate::{out, program, signals};
use clap::Args;
use conefield::study::definition::{Cell, Source, Study};
use conefield::study::layout::{CONTENTS, Layout, group};
use conefield::study::outcome::Outcome;
use conefield::study::pictures::{self, Shown};
use conefield::study::report::{CaseRecord, StudyReport};
use conefield::study::slurm::Jobs;
use conefield::tradeoff::trial::TrialInput;
use conefield::{parse, specs};
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use conefield_io::{Lease, SharedLease, try_alone};
use serde_json::json;
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tracing::info;

/// Reconstruct many scans with several methods and seeds.
///
/// The table has means, standard deviations and paired differences. STUDY is a TOML file with volumes to simulate or
/// scans, specs, seeds and numbers of views (docs/guide/many-scans.md; "conefield schema --study" has every key).
/// FOLDER receives table.md, table.json, slices/, curves/, the simulated scans in scans/ and the output of each
/// "conefield reconstruct" in runs/. Each run is a separate process; the others run even if one fails. Ctrl-C stops the
/// current run after its step; the same command with --resume continues and skips finished runs.
#[derive(Args)]
pub struct StudyArgs {
    /// The study file.
    study: PathBuf,
    /// The folder for the results; new or empty.
    #[arg(short, long = "output", value_name = "FOLDER")]
    output: PathBuf,
    /// Replace an earlier study in FOLDER and all its runs.
    #[arg(long)]
    force: bool,
    /// Continue the study in FOLDER. Methods, seeds, scans and volumes may be added; the rest must be the same.
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    /// Run the K-th of N shares of the runs. Other processes may run the other shares in the same FOLDER, also on other
    /// machines. Existing runs are continued. The last process to finish writes the table.
    #[arg(long, value_name = "K/N", value_parser = parse::part, conflicts_with = "force")]
    shard: Option<[usize; 2]>,
    /// Run nothing; write a script that runs the study as an array of Slurm jobs.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["resume", "shard", "json"])]
    slurm: Option<PathBuf>,
    /// Jobs of that array [default: one per run, 1000 at most].
    #[arg(long, value_name = "N", requires = "slurm", value_parser = clap::value_parser!(u16).range(1..))]
    jobs: Option<u16>,
    /// Print one JSON object: the content of table.json.
    #[arg(long)]
    json: bool,
    /// The study is part of another program: the end of standard input stops it like a signal.
    #[arg(long, hide = true)]
    as_part: bool,
}

/// Time between two attempts to take a lock held by another process.
const LOOK: Duration = Duration::from_millis(50);

/// Default maximum number of jobs of an array: the limit of an unconfigured Slurm.
const MOST_JOBS: usize = 1000;

/// Access to the study's folder, exclusive or shared with other processes.
enum Hold {
    Alone(Lease),
    Shared(SharedLease),
}

impl StudyArgs {
    pub fn run(self, general: &General) -> Result<()> {
        if self.as_part {
            signals::follow_input();
        }
        // Errors in the input are reported before anything is created.
        let study = Study::read(&self.study)?;
        let inputs = study.methods.iter().fold(Inputs::of(study.inputs()), |i, m| i.and_spec(&m.loaded));
        if let Some(file) = &self.slurm {
            inputs.spare_file(file)?;
            return self.write_script(&study, file, general);
        }
        let work = Work { study: &study, layout: Layout(&self.output), general };
        let [share, of] = self.shard.unwrap_or([1, 1]);
        let cells: Vec<Cell> = study.cells().into_iter().skip(share - 1).step_by(of).collect();
        work.check_scans()?;
        let hold = self.take(&work, &cells, &inputs)?;
        conefield_io::write_text_atomic(work.layout.study(), &study.text)?;
        work.carry_out(&cells)?;
        let lease = match hold {
            Hold::Alone(lease) => Some(lease),
            Hold::Shared(share) => share.alone(CONTENTS)?,
        };
        match lease {
            Some(lease) if work.is_over() => self.finish(&work, lease),
            _ => self.leave_to_others(&work, &cells),
        }
    }

    /// Takes the folder. Refuses one with other files, or an earlier study without --force or --resume.
    fn take(&self, work: &Work<'_>, cells: &[Cell], inputs: &Inputs) -> Result<Hold> {
        let lease = self.shard.is_none().then(|| Lease::take(&self.output, CONTENTS)).transpose()?;
        let any = work.layout.look()?;
        inputs.spare_folder(&self.output)?;
        let goes_on = self.resume || self.shard.is_some();
        let expected = "a new or empty folder, --resume to continue or --force to replace it";
        ensure(
            !any || goes_on || self.force,
            &self.output.display().to_string(),
            "output",
            "an earlier study",
            expected,
        )?;
        if goes_on {
            work.check_runs(cells)?;
        }
        let Some(mut lease) = lease else {
            signals::listen();
            return SharedLease::take(&self.output).map(Hold::Shared);
        };
        trial::begin(&mut lease, goes_on && any)?;
        Ok(Hold::Alone(lease))
    }

    /// Writes tables and pictures when all runs have ended, and reports the result.
    fn finish(&self, work: &Work<'_>, lease: Lease) -> Result<()> {
        if self.shard.is_some() {
            // Runs of other processes must belong to this study, too.
            work.check_runs(&work.study.cells())?;
        }
        let report = work.report()?;
        report.write(&self.output)?;
        lease.complete()?;
        if self.json {
            out::json(&report)?;
        } else {
            out::say(&report.text(&out::fitted))?;
            out::say(&format!("\ntable, pictures and runs in {}", self.output.display()))?;
        }
        refuse_failures(&report.failures(), work.study.cells().len())
    }

    /// Reports the result of this share while other shares are unfinished.
    fn leave_to_others(&self, work: &Work<'_>, cells: &[Cell]) -> Result<()> {
        let failed: Vec<String> = cells.iter().filter_map(|c| work.failure(c)).collect();
        let done = cells.len() - failed.len();
        if self.json {
            out::json(&json!({ "done": done, "failed": failed, "table": null }))?;
        } else {
            out::say(&format!(
                "{done} of {} of this share done; the last share to finish writes the table",
                out::counted(cells.len(), "run")
            ))?;
        }
        refuse_failures(&failed, cells.len())
    }

    fn write_script(&self, study: &Study, file: &Path, general: &General) -> Result<()> {
        let runs = study.cells().len();
        let count = self.jobs.map_or(runs.min(MOST_JOBS), |n| runs.min(n.into()));
        let text = |word: OsString| {
            word.into_string().map_err(|w| Error::invalid("--slurm", "option", w.display(), "text in UTF-8"))
        };
        let program: Vec<String> = program::words()?.into_iter().map(text).collect::<Result<_>>()?;
        let general: Vec<String> = general.arguments().into_iter().map(text).collect::<Result<_>>()?;
        let jobs = Jobs {
            name: &study.name,
            program: &program,
            study: &self.study,
            output: &self.output,
            count,
            general: &general,
        };
        refuse_existing(file, self.force)?;
        conefield_io::write_text_atomic(file, &jobs.script()?)?;
        let (jobs, all) = (out::counted(count, "job"), out::counted(runs, "run"));
        out::say(&format!("{0}: {jobs} for {all}; sbatch {0} submits the script", file.display()))
    }
}

/// Failed runs make the study fail, after everything is reported.
fn refuse_failures(failed: &[String], all: usize) -> Result<()> {
    match failed.len() {
        0 => Ok(()),
        n => {
            let why = format!("{n} of {} failed, the first: {}", out::counted(all, "run"), failed[0]);
            Err(Error::unsupported("study", why))
        }
    }
}

/// A study in its folder.
struct Work<'a> {
    study: &'a Study,
    layout: Layout<'a>,
    general: &'a General,
}

impl Work<'_> {
    /// Refuses existing scans that are unreadable or do not suit a method, and methods that need held-out views if
    /// there are none.
    fn check_scans(&self) -> Result<()> {
        for (case, c) in self.study.cases.iter().enumerate() {
            let cell = Cell { case, seed: self.study.seeds[0], method: 0 };
            // For simulations the volume has been read already.
            let held = match c.source {
                Source::Scan { .. } => self.input(&cell)?.held,
                Source::Simulated(_) => self.study.protocol.hold_out.iter().map(|_| 0).collect(),
            };
            self.study.methods.iter().try_for_each(|m| specs::check_held_out(&m.loaded, m.plan.as_ref(), &held))?;
        }
        Ok(())
    }

    /// Refuses simulated scans and runs in the folder that belong to another study.
    fn check_runs(&self, cells: &[Cell]) -> Result<()> {
        for cells in cells.chunk_by(same_scan) {
            // A missing scan is simulated again bit-identically, and is checked then.
            if self.scan(&cells[0]).exists() && cells.iter().any(|c| self.run(c).exists()) {
                let input = self.input(&cells[0])?;
                cells.iter().try_for_each(|c| self.start(c, &input).map(drop))?;
            }
        }
        Ok(())
    }

    /// Simulates missing scans and does all unfinished runs.
    fn carry_out(&self, cells: &[Cell]) -> Result<()> {
        let begin = Instant::now();
        let (mut number, mut made) = (0, 0);
        for same in cells.chunk_by(same_scan) {
            self.make_scan(&same[0])?;
            let input = self.input(&same[0])?;
            for cell in same {
                number += 1;
                let part = format!("{} ({number} of {})", self.study.run_name(cell), cells.len());
                self.await_run(cell, &part)?;
                let start = self.start(cell, &input)?;
                if start == Start::Done {
                    info!("{part} is already finished");
                    continue;
                }
                let left = begin.elapsed().as_secs_f64() / f64::from(made) * (cells.len() + 1 - number) as f64;
                let left = if made > 0 { format!(", about {} left", out::duration(left)) } else { String::new() };
                info!("{part}{left}");
                made += 1;
                self.make_run(cell, start, part)?;
            }
        }
        Ok(())
    }

    /// Does a run. A failure is recorded in its folder.
    fn make_run(&self, cell: &Cell, start: Start, part: String) -> Result<()> {
        let failure = self.failure_file(cell);
        if failure.exists() {
            fs::remove_file(&failure).map_err(|e| Error::io(&failure, e))?;
        }
        let Some(error) = self.trial(cell).run(start, part, self.general)? else { return Ok(()) };
        let folder = failure.parent().unwrap_or(Path::new(""));
        fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        conefield_io::write_text_atomic(&failure, &error)
    }

    /// Simulates the scan of a run, unless it exists or another process is simulating it.
    fn make_scan(&self, cell: &Cell) -> Result<()> {
        let Source::Simulated(simulation) = &self.study.cases[cell.case].source else { return Ok(()) };
        let (scan, all) = (self.scan(cell), self.layout.scans());
        fs::create_dir_all(&all).map_err(|e| Error::io(&all, e))?;
        let part = format!("simulation of {}", group(&self.study.cases[cell.case].name, cell.seed));
        let _one_at_a_time = await_lock(&all, &part)?;
        if scan.exists() {
            return Ok(());
        }
        info!("{part}");
        simulation.make(cell.seed, &scan)?;
        if signals::caught().is_some() { Err(Error::Stopped { part }) } else { Ok(()) }
    }

    /// Waits until no process writes to the run: the child of a killed process ends after its step.
    fn await_run(&self, cell: &Cell, part: &str) -> Result<()> {
        let run = self.run(cell);
        if run.exists() {
            await_lock(&run, part)?;
        }
        Ok(())
    }

    /// The scan of a run.
    fn input(&self, cell: &Cell) -> Result<TrialInput> {
        let scan = self.scan(cell);
        trial::input(&scan, &self.protocol(cell), &|s| match &self.study.cases[cell.case].source {
            Source::Simulated(simulation) => simulation.check_made(cell.seed, s, &scan),
            Source::Scan { .. } => Ok(()),
        })
    }

    /// A run with its scan and options.
    fn trial(&self, cell: &Cell) -> Trial<'_> {
        let method = &self.study.methods[cell.method];
        let (scan, output, protocol) = (self.scan(cell), self.run(cell), self.protocol(cell));
        Trial { scan, spec: &method.spec, init: method.init.as_deref(), output, protocol }
    }

    /// How a run starts. Refuses a folder with a different run.
    fn start(&self, cell: &Cell, input: &TrialInput) -> Result<Start> {
        self.trial(cell).start(&self.study.methods[cell.method].loaded, input)
    }

    /// The options of a run.
    fn protocol(&self, cell: &Cell) -> RunProtocol {
        let p = &self.study.protocol;
        RunProtocol {
            checkpoint_every: p.checkpoint_every.unwrap_or(60.0),
            sets: self.study.methods[cell.method].sets.clone(),
            ends: EndOptions { seconds: p.seconds, steps: p.steps.map(u64::from), at_most: p.at_most },
            budget: p.budget,
            backend: p.backend.clone().unwrap_or_default(),
            reference: match &self.study.cases[cell.case].source {
                Source::Simulated(_) => Some("truth".into()),
                Source::Scan { reference, .. } => reference.clone(),
            },
            peak: p.peak,
            hold_out: p.hold_out.clone(),
            seed: cell.seed,
        }
    }

    fn scan(&self, cell: &Cell) -> PathBuf {
        let case = &self.study.cases[cell.case];
        match &case.source {
            Source::Simulated(_) => self.layout.scan(&case.name, cell.seed),
            Source::Scan { path, .. } => path.clone(),
        }
    }

    fn run(&self, cell: &Cell) -> PathBuf {
        self.layout.run(&self.study.run_name(cell))
    }

    fn failure_file(&self, cell: &Cell) -> PathBuf {
        self.layout.failure(&self.study.run_name(cell))
    }

    /// The error of a failed run.
    fn failure(&self, cell: &Cell) -> Option<String> {
        // A run repeated separately since then has a result.
        let failed = !is_done(&self.run(cell));
        let text = failed.then(|| fs::read(self.failure_file(cell)).ok()).flatten();
        text.map(|text| String::from_utf8_lossy(&text).into_owned())
    }

    /// Whether every run of the study has ended.
    fn is_over(&self) -> bool {
        self.study.cells().iter().all(|c| is_done(&self.run(c)) || self.failure_file(c).exists())
    }

    /// The outcomes of all runs, after all have ended; draws the pictures.
    fn report(&self) -> Result<StudyReport<'_>> {
        let outcome = |c: &Cell| Ok((*c, Outcome::of_run(&self.run(c), self.failure(c))?));
        let outcomes: Vec<(Cell, Outcome)> = self.study.cells().iter().map(outcome).collect::<Result<_>>()?;
        if outcomes.iter().all(|(_, o)| o.figures.is_none()) {
            let why: Vec<&str> = outcomes.iter().filter_map(|(_, o)| o.error.as_deref()).take(3).collect();
            return Err(Error::unsupported("study: every run failed", why.join("; ")));
        }
        let mut cases = vec![];
        for (case, c) in self.study.cases.iter().enumerate() {
            let seed = self.study.seeds[0];
            let input = self.input(&Cell { case, seed, method: 0 })?;
            cases.push(CaseRecord::new(&c.name, &c.source, &input));
            self.draw(case, &input, &outcomes)?;
        }
        Ok(StudyReport::new(self.study, &self.layout, cases, outcomes))
    }

    /// Draws the results on a case: slices with the first seed, curves of all.
    fn draw(&self, case: usize, input: &TrialInput, outcomes: &[(Cell, Outcome)]) -> Result<()> {
        let Study { cases, methods, seeds, .. } = self.study;
        let here = || outcomes.iter().filter(|(c, o)| c.case == case && o.figures.is_some());
        let shown = here().filter(|(c, _)| c.seed == seeds[0]).map(|(c, o)| Shown {
            name: match seeds.len() {
                1 => methods[c.method].name.clone(),
                _ => format!("{}, seed {},", methods[c.method].name, c.seed),
            },
            psnr: o.figures.as_ref().and_then(|f| f.psnr()),
            run: self.run(c),
        });
        let (slices, curves) = (self.layout.slices(&cases[case].name), self.layout.curves(&cases[case].name));
        for folder in [&slices, &curves].into_iter().filter_map(|p| p.parent()) {
            fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        }
        pictures::slices(&slices, input.reference.as_ref(), &shown.collect::<Vec<_>>(), cases[case].window)?;
        let of = |method| here().filter(|(c, _)| c.method == method).map(|(c, _)| self.run(c)).collect();
        let runs: Vec<(String, Vec<PathBuf>)> =
            methods.iter().enumerate().map(|(m, x)| (x.name.clone(), of(m))).collect();
        pictures::curves(&curves, &cases[case].name, &runs)?;
        Ok(())
    }
}

/// Whether two runs use the same scan.
fn same_scan(a: &Cell, b: &Cell) -> bool {
    (a.case, a.seed) == (b.case, b.seed)
}

/// Waits for the lock on `folder`.
fn await_lock(folder: &Path, part: &str) -> Result<conefield_io::FolderLock> {
    let mut reported = false;
    loop {
        if let Some(lock) = try_alone(folder) {
            return Ok(lock);
        }
        if !reported {
            info!("{}: waiting for another conefield process that is writing to it", folder.display());
            reported = true;
        }
        if signals::caught().is_some() {
            return Err(Error::Stopped { part: part.into() });
        }
        std::thread::sleep(LOOK);
    }
}
