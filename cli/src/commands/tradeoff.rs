//! `conefield tradeoff`

use super::protocol::RunProtocol;
use super::trial::{self, Start, Trial};
use super::{EndOptions, General};
use crate::boundary::Inputs;
use crate::out;
use clap::Args;
use conefield::backend::{self, BackendChoice};
use conefield::input::is_truth;
use conefield::parse::{self, HoldOut};
use conefield::specs;
use conefield::tradeoff::levers::{self, Candidate, Levers};
use conefield::tradeoff::report::TradeoffReport;
use conefield::tradeoff::search::{CONTENTS, Due, Search};
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use conefield_io::Lease;
use std::path::PathBuf;

/// Search for the best methods under time budgets.
///
/// Candidates are drawn from levers and tried under the smallest budget; the better ones advance to the next budget
/// (neural fields and voxel methods separately). Each trial is a whole "conefield reconstruct --budget" in a separate
/// process. FOLDER receives tradeoff.md, tradeoff.json, front.png, front.toml (for "reconstruct --front") and, in
/// front/, a spec for every point that no other beats in time, memory and accuracy. Ctrl-C stops the current trial; the
/// same command with --resume continues and skips finished trials.
#[derive(Args)]
pub struct TradeoffArgs {
    /// Scans to tune on; results are averaged over them.
    #[arg(required_unless_present = "show_levers", value_name = "SCAN")]
    scans: Vec<PathBuf>,
    /// The folder for the results; new or empty.
    #[arg(short, long = "output", value_name = "FOLDER", required_unless_present = "show_levers")]
    output: Option<PathBuf>,
    /// Time budgets of a whole reconstruction, in ascending order.
    #[arg(long, value_name = "TIME,TIME", value_delimiter = ',', default_value = "10s,60s,300s", value_parser = parse::seconds)]
    budgets: Vec<f64>,
    /// The settings to vary [default: the shipped levers].
    #[arg(long, value_name = "FILE")]
    levers: Option<PathBuf>,
    /// Only these bases of the levers, by name.
    #[arg(long, value_name = "BASE,BASE", value_delimiter = ',')]
    bases: Vec<String>,
    /// Print the shipped levers and exit.
    #[arg(long)]
    show_levers: bool,
    /// Number of candidates under the smallest budget.
    #[arg(long, value_name = "N", default_value_t = 24, value_parser = clap::value_parser!(u16).range(1..=1000))]
    candidates: u16,
    /// Share of the candidates that advances to the next budget.
    #[arg(long, value_name = "SHARE", default_value_t = 0.5, value_parser = parse::share)]
    keep: f64,
    /// The reference, to rank by PSNR instead of held-out views: a file for each scan in turn, or "truth" for the ones
    /// in the scans.
    #[arg(long, value_name = "VOLUME")]
    reference: Vec<PathBuf>,
    /// The data range for PSNR and SSIM [default: 1 for a reference in [0, 1] that exceeds 0.5, else its range].
    #[arg(long, value_parser = parse::above_zero)]
    peak: Option<f64>,
    /// Views to hold out and predict, such as 3,17 or every:10; the value none needs --reference.
    #[arg(long, value_name = "VIEWS", default_value = "every:10", value_parser = parse::hold_out_or_none)]
    hold_out: parse::HoldOutOrNone,
    #[arg(long, value_name = "BACKEND", default_value_t, help = backend::HELP)]
    backend: BackendChoice,
    /// Seed of all random numbers, including the candidates.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Replace an earlier search in FOLDER and all its trials.
    #[arg(long)]
    force: bool,
    /// Continue the search in FOLDER; all other options must be the same.
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    /// Print one JSON object: the content of tradeoff.json.
    #[arg(long)]
    json: bool,
}

/// No checkpoints: they take time from the budget, and an interrupted trial is repeated.
const NEVER: f64 = 1e9;

impl TradeoffArgs {
    pub fn run(self, general: &General) -> Result<()> {
        if self.show_levers {
            return out::say(levers::LEVERS.trim_end());
        }
        // Errors in the input are reported before anything is created.
        let Some(output) = &self.output else { return Err(Error::invalid("tradeoff", "-o", "nothing", "a folder")) };
        let levers = match &self.levers {
            Some(path) => Levers::read(path)?,
            None => Levers::shipped()?,
        };
        let levers = levers.only(&self.bases)?;
        let search = self.search(levers.candidates(self.candidates.into(), self.seed)?, general)?;
        let named = self.reference.iter().filter(|r| !is_truth(r));
        let inputs = Inputs::of(&self.scans).and(named).and(&self.levers);
        // Also the specs that a list of levers names.
        let bases: Vec<_> = search.candidates.iter().map(|c| specs::read(&c.spec, &c.sets)).collect::<Result<_>>()?;
        bases.iter().fold(inputs, |inputs, base| inputs.and_spec(base)).spare_folder(output)?;
        let mut lease = Lease::take(output, CONTENTS)?;
        let mut over = search.look(output, self.force, self.resume)?;
        trial::begin(&mut lease, self.resume && output.exists())?;
        let rungs = search.climb(output, &mut over, &mut |due| self.trial(&search, due, general))?;
        let report = TradeoffReport::new(search, rungs, over)?;
        report.write(output)?;
        lease.complete()?;
        if self.json { out::json(&report) } else { out::say(&report.text(output)) }
    }

    /// All settings of the search, after checking.
    fn search(&self, candidates: Vec<Candidate>, general: &General) -> Result<Search> {
        let rising = self.budgets.windows(2).all(|w| w[0] < w[1]);
        ensure(rising, "tradeoff", "--budgets", format!("{:?} seconds", self.budgets), "ascending times")?;
        let all = self.reference.len();
        let truth = all == 1 && is_truth(&self.reference[0]);
        let fits = all == 0 || truth || all == self.scans.len();
        ensure(
            fits,
            "tradeoff",
            "--reference",
            format!("{all} volumes"),
            format!("{}, one per scan", self.scans.len()),
        )?;
        let device = self.backend.open_for_run(self.budgets.first().copied())?.describe();
        let ranked = all > 0 || self.hold_out.0.is_some();
        ensure(ranked, "tradeoff", "--hold-out", "none", "views to rank by, as there is no --reference")?;
        let references: Vec<PathBuf> =
            if truth { vec![self.reference[0].clone(); self.scans.len()] } else { self.reference.clone() };
        let mut scans = vec![];
        for (i, scan) in self.scans.iter().enumerate() {
            let again = self.scans[..i].contains(scan);
            ensure(!again, "tradeoff", "SCAN", scan.display(), "every scan once")?;
            let input = trial::input(scan, &self.protocol(references.get(i), 1.0, &[]), &|_| Ok(()))?;
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
            backend: self.backend.to_string(),
            device,
            memory_limit: general.memory,
        })
    }

    fn protocol(&self, reference: Option<&PathBuf>, budget: f64, sets: &[String]) -> RunProtocol {
        RunProtocol {
            checkpoint_every: NEVER,
            sets: sets.to_vec(),
            ends: EndOptions { steps: None, seconds: None, at_most: None },
            budget: Some(budget),
            backend: self.backend.clone(),
            reference: reference.cloned(),
            peak: self.peak,
            hold_out: self.hold_out.0.clone(),
            seed: self.seed,
        }
    }

    /// Runs one trial in a separate process.
    fn trial(&self, search: &Search, due: &Due<'_>, general: &General) -> Result<Option<String>> {
        let Due { candidate, budget_s, scan, output, part } = due;
        let protocol = self.protocol(search.references.get(*scan), *budget_s, &candidate.sets);
        let (scan, output) = (self.scans[*scan].clone(), output.clone());
        // Replaces the remains of an interrupted trial.
        Trial { scan, spec: &candidate.spec, init: None, output, protocol }.run(Start::Replacing, part.clone(), general)
    }
}
