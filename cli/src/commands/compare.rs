//! `conefield compare`

use super::protocol::RunProtocol;
use super::trial::{self, Start, Trial};
use super::{EndOptions, General};
use crate::boundary::Inputs;
use crate::{out, run_folder};
use clap::Args;
use conefield::backend::BackendChoice;
use conefield::record::ScanRecord;
use conefield::specs;
use conefield::study::method::{FOLDER_NAME, Method};
use conefield::study::outcome::{Columns, Outcome};
use conefield::study::pictures::{self, Shown};
use conefield::tradeoff::trial::TrialInput;
use conefield_core::backend::Backend;
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use conefield_evaluation::report::Table;
use conefield_io::{Contents, Lease, Progressed};
use serde::Serialize;
use std::fs;
use std::path::{Path, PathBuf};
use tracing::info;

/// Reconstruct a scan with several methods under one protocol.
///
/// FOLDER receives table.md, table.json, compare.png and, for every spec, a folder with the output of "conefield
/// reconstruct". Each run is a separate process, so its peak memory is its own, and the others run even if one fails.
/// Every --set applies to every spec. Ctrl-C stops the current run after its step; the same command with --resume
/// continues and skips finished runs.
#[derive(Args)]
pub struct CompareArgs {
    /// The scan.
    scan: PathBuf,
    #[arg(long, required = true, value_name = "SPEC,SPEC", value_delimiter = ',', help = help())]
    specs: Vec<String>,
    /// The folder for the results; new or empty.
    #[arg(short, long = "output", value_name = "FOLDER")]
    output: PathBuf,
    /// Replace an earlier comparison in FOLDER and all its runs.
    #[arg(long)]
    force: bool,
    /// Continue the comparison in FOLDER. Specs may be added; all other options must be the same.
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    #[command(flatten)]
    protocol: RunProtocol,
    /// Print one JSON object: the content of table.json.
    #[arg(long)]
    json: bool,
}

fn help() -> String {
    format!("Specs to compare, in the order of the table. {}", specs::help())
}

/// Files besides the runs.
const FILES: [&str; 3] = ["table.md", "table.json", "compare.png"];

/// The content of `table.json`.
#[derive(Serialize)]
struct Report<'a> {
    protocol: Shared<'a>,
    methods: Vec<Entry>,
}

/// Settings shared by all runs.
#[derive(Serialize)]
struct Shared<'a> {
    version: &'static str,
    scan: ScanRecord,
    held_out_views: Vec<usize>,
    reference: Option<String>,
    peak: f64,
    seed: u64,
    limits: &'a EndOptions,
    budget_s: Option<f64>,
    sets: &'a [String],
    backend: BackendChoice,
    /// What the methods run on.
    device: String,
    memory_limit: Option<u64>,
}

/// A row of the table.
#[derive(Serialize)]
struct Entry {
    name: String,
    spec: String,
    run: String,
    #[serde(flatten)]
    outcome: Outcome,
}

impl CompareArgs {
    pub fn run(self, general: &General) -> Result<()> {
        // Errors in the input are reported before anything is created.
        let backend = self.protocol.backend.open_for_run(self.protocol.budget)?;
        let (methods, device) = (self.methods(backend.as_ref())?, backend.describe());
        drop(backend);
        let input = trial::input(&self.scan, &self.protocol, &|_| Ok(()))?;
        methods.iter().try_for_each(|m| specs::check_held_out(&m.loaded, m.plan.as_ref(), &input.held))?;
        let mut lease = Lease::take(&self.output, CONTENTS)?;
        self.look_into_folder()?;
        self.spare_inputs(&methods)?;
        let start = |m: &Method| if self.resume { self.trial(m).start(&m.loaded, &input) } else { Ok(Start::Anew) };
        let starts: Vec<Start> = methods.iter().map(start).collect::<Result<_>>()?;
        trial::begin(&mut lease, self.resume && self.output.exists())?;
        let mut entries = vec![];
        for (i, (method, start)) in methods.iter().zip(starts).enumerate() {
            let part = format!("{} ({} of {})", method.name, i + 1, methods.len());
            entries.push(self.entry(method, start, part, general)?);
        }
        // Without any result there is no comparison: an earlier one is kept.
        if entries.iter().all(|e| e.outcome.figures.is_none()) {
            let why = |e: &Entry| format!("{}: {}", e.name, e.outcome.error.as_deref().unwrap_or("no result"));
            let why: Vec<String> = entries.iter().map(why).collect();
            return Err(Error::unsupported("compare: every method failed", why.join("; ")));
        }
        let TrialInput { scan, held, reference, peak, .. } = input;
        let protocol = self.shared(scan, held, peak, device, general);
        let report = Report { protocol, methods: entries };
        let table = table(&report);
        conefield_io::write_text_atomic(self.output.join("table.json"), &out::to_json(&report)?)?;
        conefield_io::write_text_atomic(self.output.join("table.md"), &table.markdown())?;
        let path = self.output.join("compare.png");
        let drawn = pictures::slices(&path, reference.as_ref(), &self.shown(&report.methods), None)?;
        lease.complete()?;
        if self.json {
            out::json(&report)?;
        } else {
            out::say(&out::fitted(&table))?;
            let picture = if drawn { format!("picture: {}\n", path.display()) } else { String::new() };
            out::say(&format!("\n{}table and runs in {}", picture, self.output.display()))?;
        }
        let failed: Vec<&str> =
            report.methods.iter().filter(|m| m.outcome.error.is_some()).map(|m| &m.name[..]).collect();
        match failed.len() {
            0 => Ok(()),
            n => {
                let all = out::counted(methods.len(), "method");
                let why = format!("{n} of {all} failed: {}", failed.join(", "));
                Err(Error::unsupported("compare", why))
            }
        }
    }

    /// Reads and builds every spec. Names must be distinct and valid as folder names.
    fn methods(&self, backend: &dyn Backend) -> Result<Vec<Method>> {
        let mut methods: Vec<Method> = vec![];
        for spec in &self.specs {
            let method = Method::read(spec, None, &self.protocol.sets, None, backend)?;
            let free = !FILES.contains(&&method.name.to_lowercase()[..]);
            ensure(free, &method.loaded.source, "name", format!("{:?}", method.name), FOLDER_NAME)?;
            method.differs(&methods)?;
            methods.push(method);
        }
        Ok(methods)
    }

    /// The run of a method.
    fn trial<'a>(&self, method: &'a Method) -> Trial<'a> {
        let (scan, output) = (self.scan.clone(), self.output.join(&method.name));
        Trial { scan, spec: &method.spec, init: None, output, protocol: self.protocol.clone() }
    }

    /// Runs a method unless that run is finished. Returns its row of the table.
    fn entry(&self, method: &Method, start: Start, part: String, general: &General) -> Result<Entry> {
        info!("{part}{}", if start == Start::Done { " is already finished" } else { "" });
        let trial = self.trial(method);
        let outcome = Outcome::of_run(&trial.output, trial.run(start, part, general)?)?;
        Ok(Entry {
            name: method.name.clone(),
            spec: method.spec.clone(),
            run: trial.output.display().to_string(),
            outcome,
        })
    }

    /// The results, for a picture.
    fn shown(&self, entries: &[Entry]) -> Vec<Shown> {
        let shown = |e: &Entry| {
            let (psnr, run) = (e.outcome.figures.as_ref()?.psnr(), self.output.join(&e.name));
            Some(Shown { name: e.name.clone(), psnr, run })
        };
        entries.iter().filter_map(shown).collect()
    }

    /// Refuses to replace an input.
    fn spare_inputs(&self, methods: &[Method]) -> Result<()> {
        let named = self.protocol.reference.iter().filter(|r| !conefield::input::is_truth(r));
        let inputs = Inputs::of([&self.scan]).and(named);
        methods.iter().fold(inputs, |inputs, m| inputs.and_spec(&m.loaded)).spare_folder(&self.output)
    }

    /// Refuses a folder with files that no comparison writes, and an earlier comparison without --force or --resume.
    fn look_into_folder(&self) -> Result<()> {
        CONTENTS.entries(&self.output)?;
        let expected = "a new or empty folder, --resume to continue or --force to replace it";
        let free = self.force || self.resume || progressed(&self.output) == Progressed::Nothing;
        ensure(free, &self.output.display().to_string(), "output", "an earlier comparison", expected)
    }

    fn shared(
        &self,
        scan: ScanRecord,
        held_out_views: Vec<usize>,
        peak: f64,
        device: String,
        general: &General,
    ) -> Shared<'_> {
        Shared {
            version: env!("CARGO_PKG_VERSION"),
            scan,
            held_out_views,
            reference: self.protocol.named_reference(),
            peak,
            seed: self.protocol.seed,
            limits: &self.protocol.ends,
            budget_s: self.protocol.budget,
            sets: &self.protocol.sets,
            backend: self.protocol.backend.clone(),
            device,
            memory_limit: general.memory,
        }
    }
}

/// The contents of a comparison's folder.
const CONTENTS: Contents = Contents { known, progressed };

/// Whether a comparison may have written this path: one of its files, or a run's folder.
fn known(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default();
    let run = || fs::read_dir(path).is_ok_and(|all| all.flatten().all(|e| run_folder::known(&e.path())));
    let own = if path.is_dir() { run() } else { FILES.iter().any(|f| name == *f) };
    own || conefield_io::is_unfinished(name) || conefield_io::is_aside(name)
}

/// The progress of the comparison in `folder`.
fn progressed(folder: &Path) -> Progressed {
    if folder.join("table.json").exists() {
        return Progressed::Complete;
    }
    let runs = fs::read_dir(folder).into_iter().flatten().flatten();
    let any = runs.map(|e| run_folder::progressed(&e.path())).any(|p| p != Progressed::Nothing);
    if any { Progressed::Begun } else { Progressed::Nothing }
}

fn table(report: &Report) -> Table {
    let protocol = &report.protocol;
    let columns = Columns::of(protocol.reference.is_some(), !protocol.held_out_views.is_empty());
    let mut rows = vec![columns.heads("method")];
    let mut notes = vec![protocol.line()];
    for Entry { name, outcome, .. } in &report.methods {
        rows.push(columns.cells(name, outcome));
        notes.extend(outcome.error.as_ref().map(|e| format!("{name} failed: {e}")));
    }
    Table { rows, notes }
}

impl Shared<'_> {
    /// The protocol in a sentence.
    fn line(&self) -> String {
        let mut parts = vec![self.scan.line()];
        match self.held_out_views.len() {
            0 => {}
            n => parts.push(format!("{} held out", out::counted(n, "view"))),
        }
        parts.extend(self.reference.as_ref().map(|r| format!("reference {r}, peak {}", self.peak)));
        parts.extend(self.limits.steps.map(|n| format!("{} {}", out::number(n), out::plural(n, "step"))));
        parts.extend(self.limits.seconds.map(|t| format!("{} of training", out::duration(t))));
        parts.extend(self.budget_s.map(|t| format!("budget {}", out::duration(t))));
        parts.extend(self.limits.at_most.map(|t| format!("at most {}", out::duration(t))));
        parts.extend(self.sets.iter().map(|s| format!("`{s}`")));
        parts.push(format!("seed {}, {}, conefield {}", self.seed, self.device, self.version));
        parts.join("; ")
    }
}
