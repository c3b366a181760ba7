//! The search: every candidate under the smallest budget, the best share of them under the next one, and so on. The
//! state is kept in the search's folder, from which it can be resumed.

use crate::files::is_one_of;
use crate::record::ScanRecord;
use crate::study::outcome::{Outcome, Status};
use crate::tradeoff::front::Unknowns;
use crate::tradeoff::halving::{TrialOutcome, go_on, to_come};
use crate::tradeoff::json::{read_json, to_json};
use crate::tradeoff::levers::Candidate;
use crate::tradeoff::schedule::TOO_SHORT;
use crate::tradeoff::statistics::mean;
use crate::tradeoff::trial::Figures;
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use conefield_evaluation::report::text::duration;
use conefield_io::{Contents, Progressed};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use tracing::info;

/// Content of a search's folder: files, then folders.
pub(crate) const FILES: [&str; 4] = ["tradeoff.json", "tradeoff.md", "front.png", "front.toml"];
pub(crate) const FOLDERS: [&str; 2] = ["front", "trials"];
/// Files of a trial that are not needed after its results are read.
const HEAVY: [&str; 3] = ["volume.nii.gz", "weights.safetensors", "checkpoint.safetensors"];

/// Everything that determines the trials: a search may be resumed only if all of it is unchanged.
#[derive(Debug, Serialize)]
pub struct Search {
    /// Version of the program.
    pub version: &'static str,
    /// Scans to tune on.
    pub scans: Vec<ScanRecord>,
    /// The reference volumes, one per scan; empty if held-out views rank.
    pub references: Vec<PathBuf>,
    /// Held-out views, as on the command line.
    pub hold_out: Option<String>,
    /// The data range for PSNR and SSIM.
    pub peak: Option<f64>,
    /// Seed of all randomness.
    pub seed: u64,
    /// Time of a whole run in seconds, ascending.
    pub budgets_s: Vec<f64>,
    /// Share of candidates kept for the next budget.
    pub keep: f64,
    /// The candidates under the first budget.
    pub candidates: Vec<Candidate>,
    /// As on the command line.
    pub backend: String,
    /// What it runs on: the processor's instructions and threads, or an adapter.
    pub device: String,
    /// Memory limit of a run in bytes, if set.
    pub memory_limit: Option<u64>,
}

/// A finished trial.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Over {
    /// Its budget in seconds.
    pub budget_s: f64,
    /// The candidate's name.
    pub candidate: String,
    /// Index of the scan.
    pub scan: usize,
    /// How it ended.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// The candidates of a budget.
#[derive(Debug, Serialize)]
pub struct Rung {
    /// Budget of every trial in seconds.
    pub budget_s: f64,
    /// Names of the candidates.
    pub tried: Vec<String>,
    /// Names of the candidates that were kept.
    pub kept: Vec<String>,
}

/// A trial to run.
#[derive(Debug)]
pub struct Due<'a> {
    /// The method.
    pub candidate: &'a Candidate,
    /// Its budget in seconds.
    pub budget_s: f64,
    /// Index of the scan.
    pub scan: usize,
    /// The folder of its run, which may contain the remains of an interrupted trial.
    pub output: PathBuf,
    /// A description for the message about an interruption.
    pub part: String,
}

impl Search {
    /// Checks the folder: refuses one with other content, or with an earlier search that is neither to be replaced
    /// (`force`) nor resumed. Returns the finished trials of a resumed search.
    pub fn look(&self, folder: &Path, force: bool, resume: bool) -> Result<Vec<Over>> {
        let place = folder.display().to_string();
        let old = CONTENTS.entries(folder)?;
        let expected = "a new or empty folder, --resume to continue or --force to replace it";
        let state = folder.join(FILES[0]);
        ensure(old.is_empty() || force || resume, &place, "output", "an earlier search", expected)?;
        if force {
            // Only a folder with a search's state may be removed with its content.
            let marked = old.is_empty() || state.is_file();
            ensure(marked, &place, "output", "a folder without tradeoff.json", "an earlier search to replace")?;
        }
        if resume && state.is_file() { self.done(&state) } else { Ok(vec![]) }
    }

    /// The finished trials in the state of this search; refuses the state of another search.
    fn done(&self, state: &Path) -> Result<Vec<Over>> {
        #[derive(Deserialize)]
        struct Then {
            search: Value,
            trials: Vec<Over>,
        }
        let then: Then = read_json(state)?;
        let now = serde_json::to_value(self).map_err(|e| Error::unsupported("the search", e.to_string()))?;
        for (key, now) in now.as_object().into_iter().flatten() {
            let then = &then.search[key];
            let expected = format!("{} as in the earlier search; --force starts over", short(then));
            ensure(then == now, &state.display().to_string(), &format!("--resume: {key}"), short(now), expected)?;
        }
        Ok(then.trials)
    }

    /// Runs all trials, budget by budget, except those already in `over`, and appends them to it. `run` makes one and
    /// returns its error message, if it failed; an `Err` ends the search, which can be resumed.
    pub fn climb(
        &self,
        folder: &Path,
        over: &mut Vec<Over>,
        run: &mut dyn FnMut(&Due<'_>) -> Result<Option<String>>,
    ) -> Result<Vec<Rung>> {
        let mut rungs: Vec<Rung> = vec![];
        let mut going: Vec<&Candidate> = self.candidates.iter().collect();
        for (r, &budget_s) in self.budgets_s.iter().enumerate() {
            let mut tried = vec![];
            for (c, &candidate) in going.iter().enumerate() {
                for scan in 0..self.scans.len() {
                    let same = |o: &Over| o.budget_s == budget_s && o.candidate == candidate.name && o.scan == scan;
                    if over.iter().any(same) {
                        continue;
                    }
                    let left = self.left(&going, r, c, scan);
                    let (on, of) = (self.scans[scan].name(), going.len());
                    let name = &candidate.name;
                    let part = format!("{name} on {on}, {} of {of} at {}", c + 1, duration(budget_s));
                    info!("{part}: at most {} left", duration(left));
                    let output = folder.join(FOLDERS[1]).join(format!("{budget_s}s")).join(format!("{name}_{scan}"));
                    over.push(settle(&Due { candidate, budget_s, scan, output, part }, run)?);
                    self.write_state(folder, &rungs, over)?;
                }
                tried.push((candidate.kind, self.outcome(over, candidate, budget_s)));
            }
            let last = r + 1 == self.budgets_s.len();
            let on = if last { vec![] } else { go_on(&tried, self.keep) };
            let name = |c: &&Candidate| c.name.clone();
            let kept: Vec<&Candidate> = on.iter().map(|i| going[*i]).collect();
            let (tried, names) = (going.iter().map(name).collect(), kept.iter().map(name).collect());
            rungs.push(Rung { budget_s, tried, kept: names });
            going = kept;
        }
        Ok(rungs)
    }

    /// Upper bound of the remaining seconds: trial `c` on `scan` of budget `r` is next.
    fn left(&self, going: &[&Candidate], r: usize, c: usize, scan: usize) -> f64 {
        let fields = going.iter().filter(|c| c.kind == Unknowns::Field).count();
        let rungs = self.budgets_s.len() - r;
        let later = to_come(fields, going.len() - fields, rungs, self.keep);
        let all = later.iter().zip(&self.budgets_s[r..]).map(|(n, budget)| *n as f64 * budget).sum::<f64>();
        let scans = self.scans.len() as f64;
        scans * all - (c as f64 * scans + scan as f64) * self.budgets_s[r]
    }

    /// Saves the state, so that the search can be resumed.
    fn write_state(&self, folder: &Path, rungs: &[Rung], trials: &[Over]) -> Result<()> {
        #[derive(Serialize)]
        struct State<'a> {
            search: &'a Search,
            rungs: &'a [Rung],
            trials: &'a [Over],
        }
        conefield_io::write_text_atomic(folder.join(FILES[0]), &to_json(&State { search: self, rungs, trials })?)
    }

    /// Accuracy of `figures`, higher is better: PSNR if there is a reference, else the negative held-out error.
    pub(crate) fn accuracy(&self, figures: &Figures) -> Option<f64> {
        if self.references.is_empty() { figures.held_out.map(|e| -e) } else { figures.psnr() }
    }

    /// The result of a candidate under a budget on all scans together.
    fn outcome(&self, over: &[Over], candidate: &Candidate, budget: f64) -> TrialOutcome {
        let here: Vec<&Over> = over.iter().filter(|o| o.budget_s == budget && o.candidate == candidate.name).collect();
        if here.iter().any(|o| o.outcome.status == Status::TooShort) {
            return TrialOutcome::TooShort;
        }
        let accuracies = here.iter().map(|o| o.outcome.figures.as_ref().and_then(|f| self.accuracy(f)));
        mean(accuracies).map_or(TrialOutcome::Failed, TrialOutcome::Accuracy)
    }
}

/// Content of a search's folder.
pub const CONTENTS: Contents = Contents { known, progressed };

/// Whether a search may have written `path`.
fn known(path: &Path) -> bool {
    is_one_of(path, &FOLDERS, &FILES)
}

/// Progress of the search in `folder`: its state is written after every trial, the table at the end.
fn progressed(folder: &Path) -> Progressed {
    match FILES[..2].iter().rev().position(|f| folder.join(f).exists()) {
        Some(0) => Progressed::Complete,
        Some(_) => Progressed::Begun,
        None => Progressed::Nothing,
    }
}

/// Runs a trial, reads its results and removes its large files.
fn settle(due: &Due<'_>, run: &mut dyn FnMut(&Due<'_>) -> Result<Option<String>>) -> Result<Over> {
    let mut outcome = Outcome::of_run(&due.output, run(due)?)?;
    if outcome.error.as_ref().is_some_and(|error| error.starts_with(TOO_SHORT)) {
        outcome.status = Status::TooShort;
    }
    for file in HEAVY {
        let path = due.output.join(file);
        match fs::remove_file(&path) {
            Err(e) if e.kind() != ErrorKind::NotFound => return Err(Error::io(&path, e)),
            _ => {}
        }
    }
    Ok(Over { budget_s: due.budget_s, candidate: due.candidate.name.clone(), scan: due.scan, outcome })
}

/// A short text for a value.
fn short(value: &Value) -> String {
    let text = value.to_string();
    if text.chars().count() <= 80 { text } else { text.chars().take(77).chain("...".chars()).collect() }
}
