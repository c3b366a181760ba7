//! `conefield reconstruct`

use super::{BackendChoice, Ends, backends::simd_level, evaluate};
use crate::memory::{self, Memory};
use crate::outgoing::{self, Written};
use crate::parse::{self, HoldOut};
use crate::progress::{Keeper, Progress};
use crate::run::RunFolder;
use crate::{files, out, signals, specs};
use clap::Args;
use conefield_core::arena::Arena;
use conefield_core::backend::Explain;
use conefield_core::checkpoint::Resume;
use conefield_core::pipeline::Pipeline;
use conefield_core::scan::{Scan, Volume};
use conefield_core::solver::{Job, Solution, Solver};
use conefield_core::spec::load::{Loaded, to_toml};
use conefield_core::{Error, Result};
use conefield_io::MiddleSlices;
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
    /// A shipped spec (naf, ni-naf, ni-naf-published, nerf, dense, accurate, fast) or a file.
    #[arg(long)]
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
    /// Time between two checkpoints, which --resume starts from.
    #[arg(long, value_name = "TIME", default_value = "60s", value_parser = parse::seconds)]
    checkpoint_every: f64,
    /// Change a setting, such as encoder.levels=8.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    #[command(flatten)]
    ends: Ends,
    /// Which backend.
    #[arg(long, default_value = "auto")]
    backend: BackendChoice,
    /// The volume sought, to compare with: a file, or "truth" for the one that the scan comes with.
    #[arg(long, value_name = "VOLUME")]
    reference: Option<PathBuf>,
    /// The data range for PSNR and SSIM.
    #[arg(long, default_value = "1", value_parser = parse::above_zero)]
    peak: f64,
    /// Views to keep aside and predict, such as 3,17 or every:10.
    #[arg(long, value_name = "VIEWS", value_parser = parse::hold_out)]
    hold_out: Option<HoldOut>,
    /// Weights that "conefield pretrain" made, to start from.
    #[arg(long, value_name = "WEIGHTS")]
    init: Option<PathBuf>,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Print one JSON object: what record.json holds.
    #[arg(long)]
    json: bool,
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
    backend: Explain,
    simd: String,
    threads: usize,
    memory: Memory,
    peak_bytes: Option<u64>,
    parameters: usize,
    steps: u64,
    train_s: f64,
    export_s: f64,
    samples: u64,
    samples_per_s: f64,
    loss: Option<f64>,
    held_out: Option<f64>,
    peak: f64,
    scores: Option<Scores>,
}

/// Which scan it was.
#[derive(Debug, Serialize)]
struct ScanRecord {
    path: String,
    views: usize,
    detector: [usize; 2],
    volume: [usize; 3],
    projections_fnv1a64: String,
}

impl Reconstruct {
    pub fn run(self) -> Result<()> {
        let loaded = specs::read(&self.spec, &self.all_sets())?;
        let solver = loaded.spec.solver.build().map_err(|e| loaded.locate(e))?;
        let backend = self.backend.open();
        let pipeline = specs::pipeline(&loaded, solver.as_ref())?;
        let compiled = pipeline.as_ref().map(|p| backend.compile(p)).transpose()?.map(|c| c.1).unwrap_or_default();
        let memory = self.memory(&loaded, solver.as_ref(), pipeline.as_ref(), &compiled)?;
        info!("memory: {}", memory.line());
        // Weights that cannot be read or do not fit are told before anything is made.
        if let Some(i) = &loaded.spec.initializer
            && i.volume().map_err(|e| loaded.locate(e))?.is_none()
        {
            let initializer = i.build(&|path| files::read_weights(path)).map_err(|e| loaded.locate(e))?;
            if let Some(layout) = pipeline.as_ref().map(|p| p.layout()) {
                initializer.apply(layout, &mut Arena::new(layout.len()))?;
            }
        }
        let whole = files::scan(&self.scan)?;
        let reference = self.reference.as_ref().map(|path| read_reference(path, &self.scan, &whole)).transpose()?;
        let held = self.hold_out.as_ref().map(|h| h.views(whole.geometry.views.len())).unwrap_or_default();
        let fingerprint = checksum(&whole);
        let (scan, held_scan) = if held.is_empty() { (whole, None) } else { split(whole, &held)? };
        let identity = self.identity(&loaded, &held, &fingerprint)?;
        let (folder, metrics, resume) = self.open(&loaded, &identity)?;
        signals::listen()?;
        let mut progress = Progress::new("reconstruct", Some(metrics)).keeping(Some(Keeper {
            path: folder.file("checkpoint.safetensors"),
            every: Duration::from_secs_f64(self.checkpoint_every),
            run: identity,
            last: Instant::now(),
        }));
        let job = Job {
            scan: &scan,
            held_out: held_scan.as_ref(),
            reference: reference.as_ref(),
            peak: self.peak,
            spec: &loaded.spec,
            backend: backend.as_ref(),
            seed: self.seed,
            limits: self.ends.limits(),
            weights: &|path| files::read_weights(path),
            volumes: &files::volume,
            resume: resume.as_ref(),
        };
        let solution = solver.solve(&job, &mut progress).map_err(|e| loaded.locate(e))?;
        let last = progress.records().last().cloned();
        drop(progress);

        let place = folder.file("volume.nii.gz");
        let field = solution.result.field();
        if let Some(field) = field {
            files::write_field(folder.file("weights.safetensors"), field, notes(&loaded, self.seed)?)?;
        }
        let start = Instant::now();
        let mut voxels = solution.result.voxels(backend.as_ref())?;
        let affine = reference.as_ref().and_then(|r| r.affine);
        let Written { slices, whole } = outgoing::write(&place, voxels.as_mut(), affine, reference.is_some())?;
        let export_s = start.elapsed().as_secs_f64();
        let middle = reference.as_ref().map(MiddleSlices::of);
        files::picture(folder.file("slices.png"), middle.as_ref(), &slices)?;
        let score = |(volume, r)| evaluate::score(&place.display().to_string(), volume, r, self.peak);
        let scores = whole.as_ref().zip(reference.as_ref()).map(score).transpose()?;
        let record = Record {
            version: env!("CARGO_PKG_VERSION"),
            spec: loaded.spec.name.clone(),
            seed: self.seed,
            scan: ScanRecord {
                path: self.scan.display().to_string(),
                views: scan.geometry.views.len() + held.len(),
                detector: scan.geometry.detector,
                volume: scan.geometry.volume.shape,
                projections_fnv1a64: fingerprint,
            },
            held_out_views: held,
            limits: self.ends.clone(),
            init: self.init.as_ref().map(|p| p.display().to_string()),
            reference: self.reference.as_ref().map(|p| p.display().to_string()),
            backend: compiled,
            simd: simd_level(),
            threads: rayon::current_num_threads(),
            memory,
            peak_bytes: memory::peak(),
            parameters: field.map_or(0, |f| f.model.pipeline.layout().len()),
            steps: solution.steps,
            train_s: solution.train_s,
            export_s,
            samples: solution.samples,
            samples_per_s: if solution.train_s > 0.0 { solution.samples as f64 / solution.train_s } else { 0.0 },
            loss: last.as_ref().map(|r| r.loss),
            held_out: last.as_ref().and_then(|r| r.held_out),
            peak: self.peak,
            scores,
        };
        conefield_io::write_text_atomic(folder.file("record.json"), &out::to_json(&record)?)?;
        folder.finish()?;
        if self.json { out::json(&record) } else { out::say(&summary(&record, &solution, &self.output)) }
    }

    /// What the run takes; one that does not fit is refused.
    fn memory(
        &self,
        loaded: &Loaded,
        solver: &dyn Solver,
        pipeline: Option<&Pipeline>,
        compiled: &Explain,
    ) -> Result<Memory> {
        let scan = conefield_io::scan_size(&self.scan)?;
        let run = memory::Run {
            scan,
            split: self.hold_out.is_some(),
            reference: self.reference.is_some(),
            field: pipeline.is_some(),
            parameters: pipeline.map_or(0, |p| p.layout().len() as u64),
            backend: compiled.scratch_bytes as u64,
            solver: memory::working(solver, &scan),
            resume: self.resume,
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

    /// What must be the same for a run to be resumed.
    fn identity(&self, loaded: &Loaded, held: &[usize], projections: &str) -> Result<BTreeMap<String, String>> {
        let mut all = notes(loaded, self.seed)?;
        all.insert("projections".into(), projections.into());
        all.insert("held_out_views".into(), format!("{held:?}"));
        all.insert("limits".into(), out::to_json(&self.ends)?);
        Ok(all)
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
        let mut sets = self.sets.clone();
        if let Some(path) = &self.init {
            sets.push(mci(path));
        }
        sets
    }
}

fn read_reference(path: &Path, scan_path: &Path, scan: &Scan) -> Result<Volume> {
    let volume = if path == Path::new("truth") && !path.exists() {
        let place = scan_path.display().to_string();
        conefield_io::read_truth(scan_path)?
            .ok_or_else(|| Error::invalid(place, "--reference truth", "a scan without a truth", "a volume file"))?
    } else {
        conefield_io::read_volume(path)?
    };
    let want = scan.geometry.volume.shape;
    if volume.data.shape() != want {
        let found = format!("{:?}", volume.data.shape());
        let expected = format!("{want:?}, the voxels that this scan asks for");
        return Err(Error::invalid(path.display().to_string(), "shape", found, expected));
    }
    Ok(volume)
}

fn split(scan: Scan, held: &[usize]) -> Result<(Scan, Option<Scan>)> {
    let (train, held) = scan.split(held)?;
    Ok((train, Some(held)))
}

/// The setting that starts from the weights in `path`.
pub fn mci(path: &Path) -> String {
    let path = toml::Value::String(path.display().to_string());
    format!("initializer={{ type = \"mci\", weights = {path} }}")
}

/// What weights say of where they come from.
pub fn notes(loaded: &Loaded, seed: u64) -> Result<BTreeMap<String, String>> {
    Ok(BTreeMap::from([
        ("conefield".into(), env!("CARGO_PKG_VERSION").into()),
        ("seed".into(), seed.to_string()),
        ("spec".into(), to_toml(&loaded.spec)?),
    ]))
}

/// FNV-1a of the projections' bytes, to recognise a scan by.
fn checksum(scan: &Scan) -> String {
    let bytes = scan.projections.iter().flat_map(|x| x.to_le_bytes());
    let hash = bytes.fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3));
    format!("{hash:016x}")
}

fn summary(r: &Record, solution: &Solution, output: &Path) -> String {
    let [x, y, z] = r.scan.volume;
    let mut lines = vec![format!(
        "{x} x {y} x {z} voxels from {} views: {} steps in {} ({:.2} M samples/s), export {}",
        r.scan.views - r.held_out_views.len(),
        solution.steps,
        out::duration(r.train_s),
        r.samples_per_s / 1e6,
        out::duration(r.export_s),
    )];
    if let Some(h) = r.held_out {
        lines.push(format!("held-out error  {h:.5} of the largest line integral ({} views)", r.held_out_views.len()));
    }
    if let Some(s) = &r.scores {
        lines.push(evaluate::lines(s));
    }
    lines.push(format!("results in {}", output.display()));
    lines.join("\n")
}
