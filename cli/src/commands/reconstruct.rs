//! `conefield reconstruct`

use super::{Ends, backends::simd_level, evaluate, protocol::Protocol};
use crate::memory::{self, Memory};
use crate::outgoing::{self, Written};
use crate::plugins::{self, Used};
use crate::progress::{Keeper, Progress};
use crate::run::RunFolder;
use crate::{files, out, signals, specs};
use clap::Args;
use conefield_core::Result;
use conefield_core::arena::Arena;
use conefield_core::backend::{Backend, Explain};
use conefield_core::checkpoint::Resume;
use conefield_core::pipeline::Pipeline;
use conefield_core::scan::Scan;
use conefield_core::solver::{Job, Solver};
use conefield_core::spec::load::{Loaded, to_toml};
use conefield_io::{MiddleSlices, ScanSize};
use conefield_metrics::Scores;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tracing::info;

/// Reconstruct a volume from a scan.
///
/// RUN receives volume.nii.gz, metrics.jsonl, spec.toml (every setting), weights.safetensors, slices.png and, when all
/// is done, record.json. Ctrl-C ends the run after its step; the same command with --resume goes on.
#[derive(Args)]
pub struct Reconstruct {
    /// The scan.
    scan: PathBuf,
    #[arg(long, help = specs::help())]
    spec: String,
    /// The folder for the results; new or empty.
    #[arg(short, long = "output", value_name = "RUN")]
    output: PathBuf,
    /// Replace the files of an earlier run in RUN.
    #[arg(long)]
    force: bool,
    /// Go on with the run in RUN that was interrupted; all else must be as it was.
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    #[command(flatten)]
    protocol: Protocol,
    /// Weights that "conefield pretrain" made, to start from.
    #[arg(long, value_name = "WEIGHTS")]
    init: Option<PathBuf>,
    /// Print one JSON object: what record.json holds.
    #[arg(long)]
    json: bool,
    /// The run is part of another command's work: its error also goes to standard output, and the end of standard
    /// input ends it as a signal does.
    #[arg(long, hide = true)]
    as_part: bool,
}

/// What an error that goes to standard output begins with.
pub const FAILED: &str = "failed: ";

/// What a spec builds.
pub struct Parts {
    pub solver: Box<dyn Solver>,
    /// Of specs that train a field.
    pub pipeline: Option<Pipeline>,
    /// What the backend made of it; empty without a pipeline.
    pub compiled: Explain,
}

impl Parts {
    /// Builds a spec for `backend`.
    pub fn of(loaded: &Loaded, backend: &dyn Backend) -> Result<Self> {
        let solver = loaded.spec.solver.build().map_err(|e| loaded.locate(e))?;
        let pipeline = specs::pipeline(loaded, solver.as_ref())?;
        let compiled = pipeline.as_ref().map(|p| backend.compile(p)).transpose()?.map(|c| c.1).unwrap_or_default();
        Ok(Self { solver, pipeline, compiled })
    }

    /// A run of it on a scan of this size, without reference, held-out views and checkpoint.
    pub fn run(&self, scan: ScanSize) -> memory::Run {
        memory::Run {
            scan,
            split: false,
            reference: false,
            field: self.pipeline.is_some(),
            parameters: self.pipeline.as_ref().map_or(0, |p| p.layout().len() as u64),
            backend: self.compiled.scratch_bytes as u64,
            kept: self.solver.memory_per_parameter(),
            solver: memory::working(self.solver.as_ref(), &scan),
            resume: false,
        }
    }

    /// Refuses weights to start from that cannot be read or do not fit.
    pub fn check_weights(&self, loaded: &Loaded) -> Result<()> {
        if let Some(i) = &loaded.spec.initializer
            && i.volume().map_err(|e| loaded.locate(e))?.is_none()
        {
            let initializer = i.build(&|path| files::read_weights(path)).map_err(|e| loaded.locate(e))?;
            if let Some(layout) = self.pipeline.as_ref().map(|p| p.layout()) {
                initializer.apply(layout, &mut Arena::new(layout.len()))?;
            }
        }
        Ok(())
    }
}

/// What is needed to repeat a run, and what came out.
#[derive(Debug, Serialize)]
struct Record {
    version: &'static str,
    spec: String,
    seed: u64,
    scan: ScanRecord,
    held_out_views: Vec<usize>,
    limits: Ends,
    init: Option<String>,
    reference: Option<String>,
    /// Whose stages the spec names.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    plugins: Vec<Used>,
    backend: Explain,
    simd: String,
    threads: usize,
    memory: Memory,
    peak_bytes: Option<u64>,
    parameters: usize,
    steps: u64,
    /// Times that training ran away and went back.
    rollbacks: u64,
    train_s: f64,
    export_s: f64,
    /// From the start of the command to this record. Of what came before a --resume, the training alone.
    total_s: f64,
    samples: u64,
    /// Of solvers that take samples.
    samples_per_s: Option<f64>,
    loss: Option<f64>,
    held_out: Option<f64>,
    peak: f64,
    scores: Option<Scores>,
}

/// Which scan it was.
#[derive(Debug, Serialize)]
pub struct ScanRecord {
    path: String,
    views: usize,
    detector: [usize; 2],
    volume: [usize; 3],
    pub projections_fnv1a64: String,
}

impl ScanRecord {
    /// The whole scan at `path`.
    pub fn of(path: &Path, scan: &Scan) -> Self {
        Self {
            path: path.display().to_string(),
            views: scan.geometry.views.len(),
            detector: scan.geometry.detector,
            volume: scan.geometry.volume.shape,
            projections_fnv1a64: checksum(scan),
        }
    }

    /// In words.
    pub fn line(&self) -> String {
        let (views, [rows, columns], [x, y, z]) = (self.views, self.detector, self.volume);
        format!("{}: {views} views of {rows} x {columns} pixels, {x} x {y} x {z} voxels", self.path)
    }
}

impl Reconstruct {
    pub fn run(self) -> Result<()> {
        if !self.as_part {
            return self.reconstruct();
        }
        signals::follow_input();
        let done = self.reconstruct();
        if let Err(e) = &done {
            out::say(&format!("{FAILED}{e}"))?;
        }
        done
    }

    fn reconstruct(&self) -> Result<()> {
        let begin = Instant::now();
        let protocol = &self.protocol;
        let loaded = specs::read(&self.spec, &self.all_sets())?;
        let backend = protocol.backend.open()?;
        let parts = Parts::of(&loaded, backend.as_ref())?;
        let memory = self.memory(&loaded, &parts)?;
        info!("memory: {}", memory.line());
        // Weights that cannot be read or do not fit are told before anything is made.
        parts.check_weights(&loaded)?;
        let Parts { solver, compiled, .. } = parts;
        let whole = files::scan(&self.scan)?;
        let reference = protocol.reference(&self.scan, &whole)?;
        let held = protocol.held_out(whole.geometry.views.len());
        let scan_record = ScanRecord::of(&self.scan, &whole);
        let (scan, held_scan) = if held.is_empty() { (whole, None) } else { split(whole, &held)? };
        let identity = identity(&loaded, protocol, &held, &scan_record.projections_fnv1a64)?;
        let (folder, metrics, resume) = self.open(&loaded, &identity)?;
        signals::listen()?;
        let mut progress = Progress::new("reconstruct", Some(metrics)).keeping(Some(Keeper {
            path: folder.file("checkpoint.safetensors"),
            every: Duration::from_secs_f64(protocol.checkpoint_every),
            run: identity,
            last: Instant::now(),
        }));
        let job = Job {
            held_out: held_scan.as_ref(),
            reference: reference.as_ref(),
            peak: protocol.peak,
            seed: protocol.seed,
            limits: protocol.ends.limits(),
            weights: &|path| files::read_weights(path),
            volumes: &files::volume,
            resume: resume.as_ref(),
            ..Job::new(&scan, &loaded.spec, backend.as_ref())
        };
        let solution = solver.solve(&job, &mut progress).map_err(|e| loaded.locate(e))?;
        let last = progress.records().last().cloned();
        drop(progress);

        let place = folder.file("volume.nii.gz");
        let field = solution.result.field();
        if let Some(field) = field {
            files::write_field(folder.file("weights.safetensors"), field, notes(&loaded, protocol.seed)?)?;
        }
        let start = Instant::now();
        let mut voxels = solution.result.voxels(backend.as_ref())?;
        let affine = reference.as_ref().and_then(|r| r.affine);
        let Written { slices, whole } = outgoing::write(&place, voxels.as_mut(), affine, reference.is_some())?;
        let export_s = start.elapsed().as_secs_f64();
        let middle = reference.as_ref().map(MiddleSlices::of);
        files::picture(folder.file("slices.png"), middle.as_ref(), &slices)?;
        let score = |(volume, r)| evaluate::score(&place.display().to_string(), volume, r, protocol.peak);
        let scores = whole.as_ref().zip(reference.as_ref()).map(score).transpose()?;
        let record = Record {
            version: env!("CARGO_PKG_VERSION"),
            spec: loaded.spec.name.clone(),
            seed: protocol.seed,
            scan: scan_record,
            held_out_views: held,
            limits: protocol.ends.clone(),
            init: self.init.as_ref().map(|p| p.display().to_string()),
            reference: protocol.reference.as_ref().map(|p| p.display().to_string()),
            plugins: plugins::used(&loaded.tree),
            backend: compiled,
            simd: simd_level(),
            threads: rayon::current_num_threads(),
            memory,
            peak_bytes: memory::peak(),
            parameters: field.map_or(0, |f| f.model.pipeline.layout().len()),
            steps: solution.steps,
            rollbacks: solution.rollbacks,
            train_s: solution.train_s,
            export_s,
            total_s: begin.elapsed().as_secs_f64() + resume.as_ref().map_or(0.0, |r| r.standing.seconds),
            samples: solution.samples,
            samples_per_s: (solution.samples > 0 && solution.train_s > 0.0)
                .then(|| solution.samples as f64 / solution.train_s),
            loss: last.as_ref().and_then(|r| r.loss),
            held_out: last.as_ref().and_then(|r| r.held_out),
            peak: protocol.peak,
            scores,
        };
        conefield_io::write_text_atomic(folder.file("record.json"), &out::to_json(&record)?)?;
        folder.finish()?;
        if self.json { out::json(&record) } else { out::say(&summary(&record, &self.output)) }
    }

    /// What the run takes; one that does not fit is refused.
    fn memory(&self, loaded: &Loaded, parts: &Parts) -> Result<Memory> {
        let run = memory::Run {
            split: self.protocol.hold_out.is_some(),
            reference: self.protocol.reference.is_some(),
            resume: self.resume,
            ..parts.run(conefield_io::scan_size(&self.scan)?)
        };
        let sets = self.all_sets();
        let tables = loaded.tree["encoder"]["log2_table_size"].as_u64().unwrap_or(0);
        let smaller = (10..tables as u32).rev().filter_map(|bits| {
            let set = format!("encoder.log2_table_size={bits}");
            let loaded = specs::read(&self.spec, &[&sets[..], &[set]].concat()).ok()?;
            Some((bits, specs::build(&loaded).ok()?.layout().len() as u64))
        });
        let memory = run.memory();
        memory.check(|available| run.smaller(available, smaller))?;
        Ok(memory)
    }

    /// The folder, its file for metrics, and where to go on from.
    fn open(
        &self,
        loaded: &Loaded,
        identity: &BTreeMap<String, String>,
    ) -> Result<(RunFolder, (PathBuf, File), Option<Resume>)> {
        if self.resume {
            let folder = RunFolder::reopen(&self.output)?;
            let resume = files::read_checkpoint(&folder.file("checkpoint.safetensors"), identity)?;
            let metrics = folder.metrics_before(resume.standing.step)?;
            return Ok((folder, metrics, Some(resume)));
        }
        let folder = RunFolder::create(&self.output, self.force)?;
        conefield_io::write_text_atomic(folder.file("spec.toml"), &to_toml(&loaded.spec)?)?;
        let metrics = folder.metrics()?;
        Ok((folder, metrics, None))
    }

    /// `--set`s, with `--init` as the one that it stands for.
    fn all_sets(&self) -> Vec<String> {
        let mut sets = self.protocol.sets.clone();
        if let Some(path) = &self.init {
            sets.push(mci(path));
        }
        sets
    }
}

pub fn split(scan: Scan, held: &[usize]) -> Result<(Scan, Option<Scan>)> {
    let (train, held) = scan.split(held)?;
    Ok((train, Some(held)))
}

/// What must be the same for a run to be resumed, or to be taken for done.
pub fn identity(
    loaded: &Loaded,
    protocol: &Protocol,
    held: &[usize],
    projections: &str,
) -> Result<BTreeMap<String, String>> {
    let mut all = notes(loaded, protocol.seed)?;
    all.insert("projections".into(), projections.into());
    all.insert("held_out_views".into(), format!("{held:?}"));
    all.insert("limits".into(), out::to_json(&protocol.ends)?);
    Ok(all)
}

/// The setting that starts from the weights in `path`.
pub fn mci(path: &Path) -> String {
    let path = toml::Value::String(path.display().to_string());
    format!("initializer={{ type = \"mci\", weights = {path} }}")
}

/// What weights say of where they come from.
pub fn notes(loaded: &Loaded, seed: u64) -> Result<BTreeMap<String, String>> {
    let mut notes = BTreeMap::from([
        ("conefield".into(), env!("CARGO_PKG_VERSION").into()),
        ("seed".into(), seed.to_string()),
        ("spec".into(), to_toml(&loaded.spec)?),
    ]);
    notes.extend(plugins::identity(&plugins::used(&loaded.tree)));
    Ok(notes)
}

/// FNV-1a of the projections' bytes, to recognise a scan by.
fn checksum(scan: &Scan) -> String {
    let bytes = scan.projections.iter().flat_map(|x| x.to_le_bytes());
    let hash = bytes.fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3));
    format!("{hash:016x}")
}

fn summary(r: &Record, output: &Path) -> String {
    let [x, y, z] = r.scan.volume;
    let speed = r.samples_per_s.map(|s| format!(" ({:.2} M samples/s)", s / 1e6)).unwrap_or_default();
    let mut lines = vec![format!(
        "{x} x {y} x {z} voxels from {} views: {} in {}{speed}, export {}",
        r.scan.views - r.held_out_views.len(),
        if r.steps == 1 { "1 step".into() } else { format!("{} steps", r.steps) },
        out::duration(r.train_s),
        out::duration(r.export_s),
    )];
    if r.rollbacks > 0 {
        let times = if r.rollbacks == 1 { "once".into() } else { format!("{} times", r.rollbacks) };
        lines.push(format!(
            "training ran away and went back {times}, with half the learning rate; metrics.jsonl says when"
        ));
    }
    if let Some(h) = r.held_out {
        lines.push(format!("held-out error  {h:.5} of the largest line integral ({} views)", r.held_out_views.len()));
    }
    if let Some(s) = &r.scores {
        lines.push(evaluate::lines(s));
    }
    lines.push(format!("results in {}", output.display()));
    lines.join("\n")
}
