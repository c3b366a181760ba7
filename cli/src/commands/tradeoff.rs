//! `conefield tradeoff`

mod halving;
mod levers;
mod pareto;
mod report;

use super::protocol::RunProtocol;
use super::record::ScanRecord;
use super::trial::{Figures, Trial, TrialInput, read_json};
use super::{EndOptions, General, backends::simd_level};
use crate::backend::{self, BackendChoice};
use crate::parse::{self, HoldOut};
use crate::{out, signals};
use clap::Args;
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use conefield_tradeoff::front::Unknowns;
use conefield_tradeoff::schedule::TOO_SHORT;
use conefield_tradeoff::statistics::mean;
use halving::{TrialOutcome, go_on, to_come};
use levers::{Candidate, Levers};
use report::TradeoffReport;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use tracing::info;

/// Search what to spend time and memory on: accuracy against both, measured.
///
/// Candidates are drawn from levers and tried under the smallest budget; the best share of them goes on to the next one
/// (fields and methods on voxels apart). Each trial is a whole "conefield reconstruct --budget", a process of its own.
/// FOLDER receives tradeoff.md, tradeoff.json, front.png, front.toml (for "reconstruct --front") and in front/ a spec for
/// every point that no other one beats in time, memory and accuracy. Ctrl-C ends the trial under way; the same command
/// with --resume goes on and repeats no finished trial.
#[derive(Args)]
pub struct TradeoffArgs {
    /// The scans to be good on; what is told is the mean over them.
    #[arg(required_unless_present = "show_levers", value_name = "SCAN")]
    scans: Vec<PathBuf>,
    /// The folder for the results; new or empty.
    #[arg(short, long = "output", value_name = "FOLDER", required_unless_present = "show_levers")]
    output: Option<PathBuf>,
    /// Times that a whole reconstruction may take, from the smallest.
    #[arg(long, value_name = "TIME,TIME", value_delimiter = ',', default_value = "10s,60s,300s", value_parser = parse::seconds)]
    budgets: Vec<f64>,
    /// What may be turned [default: the shipped levers].
    #[arg(long, value_name = "FILE")]
    levers: Option<PathBuf>,
    /// Only these bases of the levers, by name.
    #[arg(long, value_name = "BASE,BASE", value_delimiter = ',')]
    bases: Vec<String>,
    /// Print the shipped levers and end.
    #[arg(long)]
    show_levers: bool,
    /// Methods under the smallest budget.
    #[arg(long, value_name = "N", default_value_t = 24, value_parser = clap::value_parser!(u16).range(1..=1000))]
    candidates: u16,
    /// Share of them that goes on to the next budget.
    #[arg(long, value_name = "SHARE", default_value_t = 0.5, value_parser = parse::share)]
    keep: f64,
    /// The volume sought, to rank by PSNR instead of by held-out views: a file for each scan in turn, or "truth" for what
    /// the scans come with.
    #[arg(long, value_name = "VOLUME")]
    reference: Vec<PathBuf>,
    /// The data range for PSNR and SSIM.
    #[arg(long, default_value = "1", value_parser = parse::above_zero)]
    peak: f64,
    /// Views to keep aside and predict, such as 3,17 or every:10; with a reference also none.
    #[arg(long, value_name = "VIEWS", default_value = "every:10", value_parser = parse::hold_out_or_none)]
    hold_out: parse::HoldOutOrNone,
    #[arg(long, value_name = "BACKEND", default_value_t, help = backend::HELP)]
    backend: BackendChoice,
    /// Seed of everything random, the drawing of candidates included.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Replace an earlier search in FOLDER with all its trials.
    #[arg(long)]
    force: bool,
    /// Go on with the search in FOLDER; all else must be as it was.
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    /// Print one JSON object: what tradeoff.json holds.
    #[arg(long)]
    json: bool,
}

/// What a search leaves in its folder: files, then folders.
const FILES: [&str; 4] = ["tradeoff.json", "tradeoff.md", "front.png", "front.toml"];
const FOLDERS: [&str; 2] = ["front", "trials"];
/// Of a trial's files, what only its own result needs.
const HEAVY: [&str; 3] = ["volume.nii.gz", "weights.safetensors", "checkpoint.safetensors"];
/// Checkpoints would take time from the budget, and a trial that was interrupted is made anew: never.
const NEVER: f64 = 1e9;

/// What decides about every trial: a search may go on only where all of it is as it was.
#[derive(Debug, Serialize)]
struct Search {
    version: &'static str,
    scans: Vec<ScanRecord>,
    references: Vec<PathBuf>,
    hold_out: Option<String>,
    peak: f64,
    seed: u64,
    budgets_s: Vec<f64>,
    keep: f64,
    candidates: Vec<Candidate>,
    backend: BackendChoice,
    simd: String,
    threads: usize,
    memory_limit: Option<u64>,
}

/// A trial that is over.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Over {
    budget_s: f64,
    candidate: String,
    /// Which of the scans.
    scan: usize,
    status: Status,
    error: Option<String>,
    #[serde(flatten)]
    figures: Option<Figures>,
}

/// How a trial ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Status {
    Done,
    TooShort,
    Failed,
}

/// What happened under a budget.
#[derive(Debug, Serialize)]
struct Rung {
    budget_s: f64,
    tried: Vec<String>,
    /// Those that went on.
    kept: Vec<String>,
}

impl TradeoffArgs {
    pub fn run(self, general: &General) -> Result<()> {
        if self.show_levers {
            return out::say(levers::SHIPPED.trim_end());
        }
        // Whatever is wrong with the input is told before anything is made.
        let Some(output) = &self.output else { return Err(Error::invalid("tradeoff", "-o", "nothing", "a folder")) };
        let levers = self.levers.as_deref().map_or_else(Levers::shipped, Levers::read)?.only(&self.bases)?;
        let search = self.search(levers.candidates(self.candidates.into(), self.seed)?, general)?;
        let mut over = self.open(output, &search)?;
        signals::listen()?;
        let rungs = self.climb(output, &search, &mut over, general)?;
        let report = TradeoffReport::new(search, rungs, over)?;
        report.write(output)?;
        if self.json { out::json(&report) } else { out::say(&report.text(output)) }
    }

    /// Everything that decides, once it was looked at.
    fn search(&self, candidates: Vec<Candidate>, general: &General) -> Result<Search> {
        let rising = self.budgets.windows(2).all(|w| w[0] < w[1]);
        ensure(rising, "tradeoff", "--budgets", format!("{:?} seconds", self.budgets), "times that rise")?;
        let all = self.reference.len();
        let truth = all == 1 && self.reference[0] == Path::new("truth");
        let fits = all == 0 || truth || all == self.scans.len();
        ensure(fits, "tradeoff", "--reference", format!("{all} volumes"), format!("{}, one a scan", self.scans.len()))?;
        let told = all > 0 || self.hold_out.0.is_some();
        ensure(told, "tradeoff", "--hold-out", "none", "views to rank by, as there is no --reference")?;
        let references: Vec<PathBuf> =
            if truth { vec![self.reference[0].clone(); self.scans.len()] } else { self.reference.clone() };
        let mut scans = vec![];
        for (i, scan) in self.scans.iter().enumerate() {
            let again = self.scans[..i].contains(scan);
            ensure(!again, "tradeoff", "SCAN", scan.display(), "every scan once")?;
            let input = TrialInput::read(scan, &self.protocol(references.get(i), 1.0, &[]))?;
            ensure(all > 0 || !input.held.is_empty(), "tradeoff", "--hold-out", "no view", "at least one")?;
            scans.push(input.scan);
        }
        Ok(Search {
            version: env!("CARGO_PKG_VERSION"),
            scans,
            references,
            hold_out: self.hold_out.0.as_ref().map(HoldOut::to_string),
            peak: self.peak,
            seed: self.seed,
            budgets_s: self.budgets.clone(),
            keep: self.keep,
            candidates,
            backend: self.backend,
            simd: simd_level(),
            threads: rayon::current_num_threads(),
            memory_limit: general.memory,
        })
    }

    fn protocol(&self, reference: Option<&PathBuf>, budget: f64, sets: &[String]) -> RunProtocol {
        RunProtocol {
            checkpoint_every: NEVER,
            sets: sets.to_vec(),
            ends: EndOptions { steps: None, seconds: None, at_most: None },
            budget: Some(budget),
            backend: self.backend,
            reference: reference.cloned(),
            peak: self.peak,
            hold_out: self.hold_out.0.clone(),
            seed: self.seed,
        }
    }

    /// The folder; with `--resume` what an earlier search got done.
    fn open(&self, folder: &Path, search: &Search) -> Result<Vec<Over>> {
        let place = folder.display().to_string();
        let mut old = vec![];
        match fs::read_dir(folder) {
            Err(e) if e.kind() == ErrorKind::NotFound => {}
            entries => {
                for entry in entries.map_err(|e| Error::io(folder, e))? {
                    let entry = entry.map_err(|e| Error::io(folder, e))?;
                    let (name, is_dir) = (entry.file_name(), entry.path().is_dir());
                    let known = if is_dir {
                        FOLDERS.iter().any(|f| name == *f)
                    } else {
                        FILES.iter().any(|f| name == *f) || conefield_io::is_unfinished(&name)
                    };
                    let found = format!("a folder with {} in it", name.to_string_lossy());
                    ensure(known, &place, "output", found, "a new or empty folder")?;
                    old.push((entry.path(), is_dir));
                }
            }
        }
        let expected = "a new or empty folder, --resume to go on or --force to replace it";
        let state = folder.join(FILES[0]);
        ensure(old.is_empty() || self.force || self.resume, &place, "output", "an earlier search", expected)?;
        if self.force {
            // Only what bears a search's mark goes with all that is in it.
            let marked = old.is_empty() || state.is_file();
            ensure(marked, &place, "output", "a folder without tradeoff.json", "an earlier search to replace")?;
            for (path, is_dir) in old {
                let gone = if is_dir { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
                gone.map_err(|e| Error::io(&path, e))?;
            }
        }
        fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        if !(self.resume && state.is_file()) {
            return Ok(vec![]);
        }
        #[derive(Deserialize)]
        struct Then {
            search: Value,
            trials: Vec<Over>,
        }
        let then: Then = read_json(&state)?;
        let now = serde_json::to_value(search).map_err(|e| Error::unsupported("the search", e.to_string()))?;
        for (key, now) in now.as_object().into_iter().flatten() {
            let then = &then.search[key];
            let expected = format!("{} as in the earlier search; --force starts anew", short(then));
            ensure(then == now, &state.display().to_string(), &format!("--resume: {key}"), short(now), expected)?;
        }
        Ok(then.trials)
    }

    /// All trials, budget by budget.
    fn climb(&self, folder: &Path, search: &Search, over: &mut Vec<Over>, general: &General) -> Result<Vec<Rung>> {
        let mut rungs: Vec<Rung> = vec![];
        let mut going: Vec<&Candidate> = search.candidates.iter().collect();
        for (r, &budget) in search.budgets_s.iter().enumerate() {
            let mut tried = vec![];
            for (c, candidate) in going.iter().enumerate() {
                for scan in 0..search.scans.len() {
                    let same = |o: &&Over| o.budget_s == budget && o.candidate == candidate.name && o.scan == scan;
                    if over.iter().any(|o| same(&o)) {
                        continue;
                    }
                    let left = self.left(search, &going, r, c, scan);
                    let name = &search.scans[scan].name();
                    let part = format!(
                        "{} on {name}, {} of {} at {}",
                        candidate.name,
                        c + 1,
                        going.len(),
                        out::duration(budget)
                    );
                    info!("{part}: at most {} left", out::duration(left));
                    over.push(self.trial(folder, search, candidate, budget, scan, part, general)?);
                    write_state(folder, search, &rungs, over)?;
                }
                tried.push((candidate.kind, outcome(search, over, candidate, budget)));
            }
            let last = r + 1 == search.budgets_s.len();
            let on = if last { vec![] } else { go_on(&tried, search.keep) };
            let name = |c: &&Candidate| c.name.clone();
            let kept: Vec<&Candidate> = on.iter().map(|i| going[*i]).collect();
            rungs.push(Rung {
                budget_s: budget,
                tried: going.iter().map(name).collect(),
                kept: kept.iter().map(name).collect(),
            });
            going = kept;
        }
        Ok(rungs)
    }

    /// Seconds that the search takes from here at most: trial `c` on `scan` of budget `r` is next.
    fn left(&self, search: &Search, going: &[&Candidate], r: usize, c: usize, scan: usize) -> f64 {
        let fields = going.iter().filter(|c| c.kind == Unknowns::Field).count();
        let rungs = search.budgets_s.len() - r;
        let later = to_come(fields, going.len() - fields, rungs, search.keep);
        let all = later.iter().zip(&search.budgets_s[r..]).map(|(n, budget)| *n as f64 * budget).sum::<f64>();
        let scans = search.scans.len() as f64;
        scans * all - (c as f64 * scans + scan as f64) * search.budgets_s[r]
    }

    /// Runs one trial in a process of its own.
    fn trial(
        &self,
        folder: &Path,
        search: &Search,
        candidate: &Candidate,
        budget: f64,
        scan: usize,
        part: String,
        general: &General,
    ) -> Result<Over> {
        let run = folder.join(FOLDERS[1]).join(format!("{budget}s")).join(format!("{}_{scan}", candidate.name));
        let protocol = self.protocol(search.references.get(scan), budget, &candidate.sets);
        let trial = Trial {
            scan: &self.scans[scan],
            spec: &candidate.spec,
            output: &run,
            protocol: &protocol,
            // What an interrupted trial left.
            more: &["--force"],
        };
        let error = trial.run(part, general)?;
        let figures = if error.is_none() { Some(Figures::of_run(&run)?) } else { None };
        for file in HEAVY {
            let path = run.join(file);
            match fs::remove_file(&path) {
                Err(e) if e.kind() != ErrorKind::NotFound => return Err(Error::io(&path, e)),
                _ => {}
            }
        }
        let status = match &error {
            None => Status::Done,
            Some(e) if e.starts_with(TOO_SHORT) => Status::TooShort,
            Some(_) => Status::Failed,
        };
        let candidate = candidate.name.clone();
        Ok(Over { budget_s: budget, candidate, scan, status, error, figures })
    }
}

/// Keeps what is done so far where `--resume` finds it.
fn write_state(folder: &Path, search: &Search, rungs: &[Rung], trials: &[Over]) -> Result<()> {
    #[derive(Serialize)]
    struct State<'a> {
        search: &'a Search,
        rungs: &'a [Rung],
        trials: &'a [Over],
    }
    conefield_io::write_text_atomic(folder.join(FILES[0]), &out::to_json(&State { search, rungs, trials })?)
}

/// How accurate `figures` are, higher is better: PSNR where there is a reference, else the held-out error with its sign
/// turned.
fn accuracy(search: &Search, figures: &Figures) -> Option<f64> {
    if search.references.is_empty() { figures.held_out.map(|e| -e) } else { figures.psnr() }
}

/// What a candidate came to under a budget on all scans together.
fn outcome(search: &Search, over: &[Over], candidate: &Candidate, budget: f64) -> TrialOutcome {
    let here: Vec<&Over> = over.iter().filter(|o| o.budget_s == budget && o.candidate == candidate.name).collect();
    if here.iter().any(|o| o.status == Status::TooShort) {
        return TrialOutcome::TooShort;
    }
    let accuracies = here.iter().map(|o| o.figures.as_ref().and_then(|f| accuracy(search, f)));
    mean(accuracies).map_or(TrialOutcome::Failed, TrialOutcome::Accuracy)
}

/// A value in few words.
fn short(value: &Value) -> String {
    let text = value.to_string();
    if text.chars().count() <= 80 { text } else { text.chars().take(77).chain("...".chars()).collect() }
}
