//! `conefield compare`

use super::protocol::RunProtocol;
use super::reconstruct::{budget, identity};
use super::trial::{self, Trial};
use super::{EndOptions, General, backends::simd_level};
use crate::backend::BackendChoice;
use crate::boundary::Inputs;
use crate::memory::Memory;
use crate::method;
use crate::plugins::{self, Used};
use crate::table::{SCORES, Table, score_cells};
use crate::{files, out, run_folder, signals, specs};
use clap::Args;
use conefield_core::error::ensure;
use conefield_core::method::Plan;
use conefield_core::spec::load::Loaded;
use conefield_core::{Error, Result};
use conefield_io::{Contents, Lease, Progressed};
use conefield_report::MiddleSlices;
use conefield_tradeoff::json::{LONGEST, read_json};
use conefield_tradeoff::trial::{Figures, ScanRecord, TrialInput};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use tracing::info;

/// Reconstruct a scan in several ways under one protocol: a table and a picture.
///
/// FOLDER receives table.md, table.json, compare.png and a folder for every spec, named after it, with what
/// "conefield reconstruct" leaves. Each run is a process of its own: its memory is its own, and where one fails the
/// others still run. Every --set holds for every spec. Ctrl-C ends the run under way after its step; the same command
/// with --resume goes on and leaves alone what is done.
#[derive(Args)]
pub struct CompareArgs {
    /// The scan.
    scan: PathBuf,
    #[arg(long, required = true, value_name = "SPEC,SPEC", value_delimiter = ',', help = help())]
    specs: Vec<String>,
    /// The folder for the results; new or empty.
    #[arg(short, long = "output", value_name = "FOLDER")]
    output: PathBuf,
    /// Replace an earlier comparison in FOLDER with all its runs.
    #[arg(long)]
    force: bool,
    /// Go on with the comparison in FOLDER; all else must be as it was, but for specs that are added.
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    #[command(flatten)]
    protocol: RunProtocol,
    /// Print one JSON object: what table.json holds.
    #[arg(long)]
    json: bool,
}

fn help() -> String {
    format!("What to compare, in the table's order. Each: {}", specs::help())
}

/// What lies beside the runs.
const FILES: [&str; 3] = ["table.md", "table.json", "compare.png"];

/// A spec and how its run starts.
struct Method {
    /// Its own name, which is also its folder's.
    name: String,
    /// As it was asked for.
    spec: String,
    loaded: Loaded,
    plan: Box<dyn Plan>,
    start: Start,
}

/// What stands in a method's folder decides how its run starts.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Start {
    /// Nothing does.
    Anew,
    /// What a run left that came to no checkpoint.
    Replacing,
    /// A checkpoint.
    Resuming,
    /// A finished run.
    Done,
}

/// All that `table.json` says.
#[derive(Serialize)]
struct Report<'a> {
    protocol: Shared<'a>,
    methods: Vec<Entry>,
}

/// What is the same for all.
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
    simd: String,
    threads: usize,
    memory_limit: Option<u64>,
}

/// A line of the table.
#[derive(Serialize)]
struct Entry {
    name: String,
    spec: String,
    run: PathBuf,
    status: &'static str,
    error: Option<String>,
    #[serde(flatten)]
    figures: Option<Figures>,
}

impl CompareArgs {
    pub fn run(self, general: &General) -> Result<()> {
        // Whatever is wrong with the input is told before anything is made.
        let mut methods = self.methods()?;
        let input = trial::input(&self.scan, &self.protocol)?;
        methods.iter().try_for_each(|m| specs::check_held_out(&m.loaded, m.plan.as_ref(), &input.held))?;
        let mut lease = Lease::take(&self.output, CONTENTS)?;
        self.look_into_folder()?;
        self.spare_inputs(&methods)?;
        for method in &mut methods {
            method.start = self.start(method, &input)?;
        }
        signals::listen()?;
        if !self.resume || !self.output.exists() {
            lease.replace()?;
        } else {
            lease.go_on();
        }
        let mut entries = vec![];
        for (i, method) in methods.iter().enumerate() {
            let part = format!("{} ({} of {})", method.name, i + 1, methods.len());
            entries.push(self.entry(method, part, general)?);
        }
        // Without any result there is no comparison: an earlier one stays.
        if entries.iter().all(|e| e.figures.is_none()) {
            let why: Vec<String> =
                entries.iter().map(|e| format!("{}: {}", e.name, e.error.as_deref().unwrap_or("no result"))).collect();
            return Err(Error::unsupported("compare: every method failed", why.join("; ")));
        }
        let TrialInput { scan, held, reference, peak } = input;
        let report = Report { protocol: self.shared(scan, held, peak, general), methods: entries };
        let table = table(&report);
        conefield_io::write_text_atomic(self.output.join("table.json"), &out::to_json(&report)?)?;
        conefield_io::write_text_atomic(self.output.join("table.md"), &table.markdown())?;
        let picture = self.draw(&report.methods, reference.as_ref())?;
        lease.complete()?;
        if self.json {
            out::json(&report)?;
        } else {
            out::say(&table.text())?;
            out::say(&format!("\n{}table and runs in {}", picture, self.output.display()))?;
        }
        let failed: Vec<&str> = report.methods.iter().filter(|m| m.error.is_some()).map(|m| &m.name[..]).collect();
        match failed.len() {
            0 => Ok(()),
            n => {
                let why = format!("{n} of {} methods failed: {}", methods.len(), failed.join(", "));
                Err(Error::unsupported("compare", why))
            }
        }
    }

    /// Every spec, read and built. Names must serve as folders and differ.
    fn methods(&self) -> Result<Vec<Method>> {
        let mut methods: Vec<Method> = vec![];
        let backend = self.protocol.backend.open()?;
        for spec in &self.specs {
            let loaded = specs::read(spec, &self.protocol.sets)?;
            let plan = method::plan(&loaded, backend.as_ref())?;
            let name = if loaded.spec.name.is_empty() { files::stem(spec) } else { loaded.spec.name.clone() };
            let begins = name.starts_with(|c: char| c.is_alphanumeric());
            let plain =
                name.chars().all(|c| c.is_alphanumeric() || " ._+()-".contains(c)) && !name.ends_with([' ', '.']);
            let free = !FILES.contains(&&name.to_lowercase()[..]) && name.len() <= 100;
            let expected = "a name for a folder: letters, digits, and between them spaces and ._+()-";
            ensure(begins && plain && free, &loaded.source, "name", format!("{name:?}"), expected)?;
            if let Some(other) = methods.iter().find(|m| m.name.to_lowercase() == name.to_lowercase()) {
                let found = format!("{name:?}, the name of {}", other.loaded.source);
                return Err(Error::invalid(&loaded.source, "name", found, "a name of its own, for table and folder"));
            }
            methods.push(Method { name, spec: spec.clone(), loaded, plan, start: Start::Anew });
        }
        Ok(methods)
    }

    /// Refuses to replace what is read.
    fn spare_inputs(&self, methods: &[Method]) -> Result<()> {
        let inputs = Inputs::of([&self.scan]).and(&self.protocol.reference);
        methods.iter().fold(inputs, |inputs, m| inputs.and_spec(&m.loaded)).spare_folder(&self.output)
    }

    /// Refuses a folder with anything in it that no comparison leaves, and an earlier comparison where nothing says what to
    /// do with it.
    fn look_into_folder(&self) -> Result<()> {
        let place = self.output.display().to_string();
        let entries = match fs::read_dir(&self.output) {
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(()),
            entries => entries.map_err(|e| Error::io(&self.output, e))?,
        };
        for entry in entries {
            let entry = entry.map_err(|e| Error::io(&self.output, e))?;
            let found = format!("a folder with {} in it", entry.file_name().to_string_lossy());
            ensure(known(&entry.path()), &place, "output", found, "a new or empty folder")?;
        }
        let expected = "a new or empty folder, --resume to go on or --force to replace it";
        let free = self.force || self.resume || progressed(&self.output) == Progressed::Nothing;
        ensure(free, &place, "output", "an earlier comparison", expected)
    }

    /// How the run of `method` starts. Refuses to go on with another one's.
    fn start(&self, method: &Method, input: &TrialInput) -> Result<Start> {
        let folder = self.output.join(&method.name);
        if !self.resume || !folder.exists() {
            return Ok(Start::Anew);
        }
        let mut now = identity(&method.loaded, &self.protocol, &input.held, &input.scan)?;
        let [record, checkpoint, volume] =
            ["record.json", "checkpoint.safetensors", "volume.nii.gz"].map(|f| folder.join(f));
        if record.exists() && volume.exists() {
            now.insert("reference".into(), Value::from(self.reference()).to_string());
            now.insert("peak".into(), input.peak.to_string());
            files::same_run(&record.display().to_string(), &recorded(&folder)?, &now)?;
            return Ok(Start::Done);
        }
        if checkpoint.exists() {
            files::read_checkpoint(&checkpoint, &now)?;
            return Ok(Start::Resuming);
        }
        Ok(Start::Replacing)
    }

    /// Runs `method` unless that is done; its line of the table.
    fn entry(&self, method: &Method, part: String, general: &General) -> Result<Entry> {
        let run = self.output.join(&method.name);
        let error = if method.start == Start::Done {
            info!("{part} is done already");
            None
        } else {
            info!("{part}");
            self.reconstruct(method, part, general)?
        };
        let figures = match &error {
            Some(_) => None,
            None => Some(Figures::of_run(&run)?),
        };
        let status = if error.is_some() { "failed" } else { "done" };
        Ok(Entry { name: method.name.clone(), spec: method.spec.clone(), run, status, error, figures })
    }

    /// Runs `method` in a process of its own; what went wrong with it, if anything did.
    fn reconstruct(&self, method: &Method, part: String, general: &General) -> Result<Option<String>> {
        let trial = Trial {
            scan: &self.scan,
            spec: &method.spec,
            output: &self.output.join(&method.name),
            protocol: &self.protocol,
            more: match method.start {
                Start::Resuming => &["--resume"],
                Start::Replacing => &["--force"],
                Start::Anew | Start::Done => &[],
            },
        };
        trial.run(part, general)
    }

    fn reference(&self) -> Option<String> {
        self.protocol.reference.as_ref().map(|r| r.display().to_string())
    }

    fn shared(&self, scan: ScanRecord, held_out_views: Vec<usize>, peak: f64, general: &General) -> Shared<'_> {
        Shared {
            version: env!("CARGO_PKG_VERSION"),
            scan,
            held_out_views,
            reference: self.reference(),
            peak,
            seed: self.protocol.seed,
            limits: &self.protocol.ends,
            budget_s: self.protocol.budget,
            sets: &self.protocol.sets,
            backend: self.protocol.backend,
            simd: simd_level(),
            threads: rayon::current_num_threads(),
            memory_limit: general.memory,
        }
    }

    /// Draws the results side by side; the picture in words.
    fn draw(&self, entries: &[Entry], reference: Option<&MiddleSlices>) -> Result<String> {
        let path = self.output.join("compare.png");
        let mut panels = vec![];
        for entry in entries {
            let Some(figures) = &entry.figures else { continue };
            let volume = entry.run.join("volume.nii.gz");
            Memory::of_volumes(&[conefield_io::volume_voxels(&volume)?]).check(|_| vec![])?;
            let caption = match figures.psnr() {
                Some(psnr) => format!("{} {psnr:.2} dB", entry.name),
                None => entry.name.clone(),
            };
            panels.push((caption, MiddleSlices::of(&conefield_io::read_volume(&volume)?)));
        }
        let panels: Vec<(&str, &MiddleSlices)> = panels.iter().map(|(c, s)| (&c[..], s)).collect();
        match (reference, panels.first()) {
            (_, None) => {
                // One of an earlier comparison would not belong to this table.
                let _ = fs::remove_file(&path);
                return Ok(String::new());
            }
            (Some(r), _) => conefield_report::compare_png(&path, ("reference", r), &panels, r.window())?,
            (None, Some((_, first))) => conefield_report::slices_png(&path, &panels, first.window(), None)?,
        }
        Ok(format!("picture: {}\n", path.display()))
    }
}

/// What the folder of a comparison holds.
const CONTENTS: Contents = Contents { known, progressed };

/// Whether a comparison may have left this: a file of its own, or the folder of a run.
fn known(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default();
    let own = FILES.iter().any(|f| name == *f) || conefield_io::is_unfinished(name) || conefield_io::is_aside(name);
    let run = || fs::read_dir(path).is_ok_and(|all| all.flatten().all(|e| run_folder::known(&e.path())));
    if path.is_dir() { conefield_io::is_aside(name) || conefield_io::is_unfinished(name) || run() } else { own }
}

/// How far the comparison in `folder` came.
fn progressed(folder: &Path) -> Progressed {
    if folder.join("table.json").exists() {
        return Progressed::Complete;
    }
    let runs = fs::read_dir(folder).into_iter().flatten().flatten();
    let any = runs.map(|e| run_folder::progressed(&e.path())).any(|p| p != Progressed::Nothing);
    if any { Progressed::Begun } else { Progressed::Nothing }
}

/// Which run a finished one was, as [`identity`] has it, and what it was compared with.
fn recorded(folder: &Path) -> Result<BTreeMap<String, String>> {
    #[derive(Deserialize)]
    struct Known {
        version: String,
        seed: u64,
        scan: KnownScan,
        held_out_views: Vec<usize>,
        limits: EndOptions,
        #[serde(default)]
        budget_s: Option<f64>,
        reference: Value,
        peak: f64,
        #[serde(default)]
        plugins: Vec<Used>,
    }
    #[derive(Deserialize)]
    struct KnownScan {
        projections_fnv1a64: String,
        geometry_fnv1a64: String,
    }
    let known: Known = read_json(&folder.join("record.json"))?;
    let mut all = BTreeMap::from([
        ("conefield".into(), known.version),
        ("seed".into(), known.seed.to_string()),
        ("spec".into(), conefield_core::files::read_text(&folder.join("spec.toml"), LONGEST)?),
        ("projections".into(), known.scan.projections_fnv1a64),
        ("geometry".into(), known.scan.geometry_fnv1a64),
        ("budget".into(), budget(known.budget_s)),
        ("held_out_views".into(), format!("{:?}", known.held_out_views)),
        ("limits".into(), out::to_json(&known.limits)?),
        ("reference".into(), known.reference.to_string()),
        ("peak".into(), known.peak.to_string()),
    ]);
    all.extend(plugins::identity(&known.plugins));
    Ok(all)
}

/// The table's columns: how the result fits, by what is known, and what it took.
fn cells(figures: &Figures, with: &Columns) -> Vec<String> {
    let mut cells = vec![];
    if with.scores {
        let ssims = ["ssim_2d", "ssim_3d", "ssim_skimage"].map(|name| figures.score(name));
        cells.extend(score_cells(figures.psnr().unwrap_or(f64::NAN), ssims));
    }
    let figure = |x: Option<f64>| x.map_or("-".into(), |x| format!("{x:.4e}"));
    cells.extend(with.held_out.then(|| figure(figures.held_out)));
    cells.extend(with.loss.then(|| figure(figures.loss)));
    cells.push(out::number(figures.steps));
    cells.extend([figures.train_s, figures.total_s].map(|s| format!("{s:.2}")));
    cells.push(figures.peak_bytes.map_or("-".into(), out::bytes));
    cells
}

/// Which figures tell how a result fits: scores where there is a reference, otherwise held-out views, otherwise the
/// loss, which says least.
struct Columns {
    scores: bool,
    held_out: bool,
    loss: bool,
}

fn table(report: &Report) -> Table {
    let protocol = &report.protocol;
    let (scores, held_out) = (protocol.reference.is_some(), !protocol.held_out_views.is_empty());
    let with = Columns { scores, held_out, loss: !scores && !held_out };
    let mut heads = vec!["method"];
    heads.extend(SCORES.iter().filter(|_| with.scores));
    heads.extend(with.held_out.then_some("held-out error"));
    heads.extend(with.loss.then_some("loss"));
    heads.extend(["steps or passes", "solving s", "all s", "peak memory"]);
    let mut rows = vec![heads.iter().map(|h| h.to_string()).collect::<Vec<_>>()];
    let mut notes = vec![protocol.line()];
    for entry in &report.methods {
        let cells = match (&entry.figures, &entry.error) {
            (Some(figures), _) => cells(figures, &with),
            (None, error) => {
                notes.extend(error.as_ref().map(|e| format!("{} failed: {e}", entry.name)));
                (1..heads.len()).map(|c| if c == 1 { "failed" } else { "-" }.to_owned()).collect()
            }
        };
        rows.push([vec![entry.name.clone()], cells].concat());
    }
    Table { rows, notes }
}

impl Shared<'_> {
    /// The protocol in a sentence.
    fn line(&self) -> String {
        let mut parts = vec![self.scan.line()];
        match self.held_out_views.len() {
            0 => {}
            n => parts.push(format!("{n} views held out")),
        }
        parts.extend(self.reference.as_ref().map(|r| format!("reference {r}, peak {}", self.peak)));
        parts.extend(self.limits.steps.map(|n| format!("{} steps", out::number(n))));
        parts.extend(self.limits.seconds.map(|t| format!("{} of training", out::duration(t))));
        parts.extend(self.budget_s.map(|t| format!("budget {}", out::duration(t))));
        parts.extend(self.limits.at_most.map(|t| format!("at most {}", out::duration(t))));
        parts.extend(self.sets.iter().map(|s| format!("`{s}`")));
        parts.push(format!("seed {}, {} threads, conefield {}", self.seed, self.threads, self.version));
        parts.join("; ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_equal_result_has_no_number_for_its_psnr() {
        let scores = serde_json::json!({ "psnr": null, "ssim_2d": 1.0, "ssim_3d": null, "ssim_skimage": 1.0 });
        let figures = Figures {
            steps: 1,
            train_s: 1.0,
            export_s: 0.5,
            total_s: 2.0,
            peak_bytes: None,
            threads: 2,
            parameters: 0,
            samples: 0,
            samples_per_s: None,
            loss: None,
            held_out: None,
            scores: Some(scores),
        };
        let shown = cells(&figures, &Columns { scores: true, held_out: true, loss: false });
        assert_eq!(shown, ["inf", "1.0000", "-", "1.0000", "-", "1", "1.00", "2.00", "-"]);
        let shown = cells(&figures, &Columns { scores: false, held_out: false, loss: true });
        assert_eq!(shown, ["-", "1", "1.00", "2.00", "-"]);
    }
}
