//! `conefield demo`

use super::reconstruct;
use crate::boundary::refuse_existing;
use crate::progress::Progress;
use crate::run_folder::RunFolder;
use crate::{out, signals};
use clap::Args;
use conefield::input::Input;
use conefield::record::{RunRecord, ScanRecord};
use conefield::score::{SCORES, cells_of};
use conefield::session::{Request, Session};
use conefield::{memory, parse, specs};
use conefield_backend_cpu::Cpu;
use conefield_core::method::{Limits, Solution};
use conefield_core::scan::{Scan, Volume};
use conefield_core::spec::load::to_toml;
use conefield_core::{Error, Result};
use conefield_evaluation::metrics::Scores;
use conefield_evaluation::report::{MiddleSlices, Table};
use conefield_io::ScanSize;
use conefield_projectors::simulate::{DetectorNoise, Protocol, phantom, simulate};
use serde::Serialize;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use tracing::info;

/// Simulate a small scan, reconstruct it with three methods and compare them.
///
/// The scan is of a head phantom with the published noise. The methods are total variation on a smooth volume (spec
/// "smooth-tv"), a neural field that starts from pre-trained weights (spec "fast" with MCI), and the same field without
/// LayerNorm and MCI for the same number of steps. "conefield report" shows FOLDER.
#[derive(Args)]
pub struct DemoArgs {
    /// The folder for scan, volumes and picture.
    #[arg(short, long = "output", value_name = "FOLDER", default_value = "conefield-demo")]
    output: PathBuf,
    /// Training time of the first field; the second one makes the same number of steps.
    #[arg(long, value_name = "TIME", default_value = "20s", value_parser = parse::seconds)]
    seconds: f64,
    /// Voxels along a side of the volume.
    #[arg(long, value_name = "N", default_value_t = 96, value_parser = clap::value_parser!(u16).range(16..=256))]
    size: u16,
    /// Number of views.
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = clap::value_parser!(u16).range(2..=1000))]
    views: u16,
    /// Seed of all random numbers.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Replace FOLDER.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// The folder of the scan.
const SCAN: &str = "scan";
/// The specs.
const VOXELS: &str = "smooth-tv";
const FIELD: &str = "fast";

/// A method and its result.
#[derive(Serialize)]
struct Entry {
    name: &'static str,
    #[serde(skip)]
    run: &'static str,
    steps: u64,
    train_s: f64,
    export_s: f64,
    scores: Scores,
    #[serde(skip)]
    slices: MiddleSlices,
}

impl DemoArgs {
    pub fn run(self) -> Result<()> {
        let folder = &self.output;
        refuse_existing(folder, self.force)?;
        // Every method is built, and refused if it does not fit into memory, before anything is created.
        let weights = tempfile::Builder::new().suffix(".safetensors").tempfile();
        let weights = weights.map_err(|e| Error::io(std::env::temp_dir(), e))?;
        std::fs::write(weights.path(), specs::FAST_WEIGHTS).map_err(|e| Error::io(weights.path(), e))?;
        let backend = Cpu::new();
        let without = || vec!["normalizers=[]".to_owned(), "initializer.type=random".to_owned()];
        // Passes over the views end by themselves, within seconds.
        let voxels = self.session(&backend, VOXELS, vec![], None, Limits::default())?;
        let timed = Limits { seconds: Some(self.seconds), ..Limits::default() };
        let field = self.session(&backend, FIELD, vec![], Some(weights.path()), timed)?;
        drop(self.session(&backend, FIELD, without(), None, timed)?);
        std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        let size = usize::from(self.size);
        let truth = phantom(size);
        let noise = DetectorNoise::Tigre { i0: 1e4, sigma: 10.0 };
        let protocol = Protocol::r2(&truth.grid)
            // As published: twice as many pixels as voxels along a side.
            .with_detector([2 * size; 2])
            .with_views(self.views.into())
            .with_noise(noise, self.seed);
        let scan = simulate(&truth, &protocol)?;
        conefield_io::write_scan(folder.join(SCAN), &scan, Some(&truth))?;
        // As it is on disk, so that a report recognizes it.
        let scan = conefield_scans::read_scan(folder.join(SCAN))?;
        info!("simulated {views} views of {0} x {0} pixels", 2 * size, views = self.views);

        signals::listen()?;
        let path = folder.join("fast.safetensors");
        conefield_io::write_atomic(&path, |w| w.write_all(specs::FAST_WEIGHTS).map_err(|e| Error::io(&path, e)))?;
        let shared = Shared { folder, seed: self.seed, scan: Arc::new(scan), truth: &truth };
        let voxels = shared.compete("smooth-tv", "smooth-tv", voxels)?;
        let field = shared.compete("fast (LN, MCI)", "fast", field)?;
        // At equal steps: how many fit into a time depends on what else the machine does.
        let limits = Limits { steps: Some(field.steps), ..Limits::default() };
        let other = self.session(&backend, FIELD, without(), None, limits)?;
        let other = shared.compete("without LN, MCI", "without", other)?;
        let entries = [voxels, field, other];
        let methods: Vec<Value> = entries.iter().map(|e| json!({ "name": e.run })).collect();
        conefield_io::write_text_atomic(folder.join("table.json"), &out::to_json(&json!({ "methods": methods }))?)?;
        let captions: Vec<String> = entries.iter().map(|e| format!("{} {:.2} dB", e.name, e.scores.psnr)).collect();
        let results: Vec<_> = captions.iter().map(|c| &c[..]).zip(entries.iter().map(|e| &e.slices)).collect();
        let picture = folder.join("compare.png");
        let truth = MiddleSlices::of(&truth);
        conefield_evaluation::report::compare_png(&picture, ("phantom", &truth), &results, truth.window())?;
        if self.json {
            return out::json(&json!({ "folder": folder, "picture": picture, "results": entries }));
        }
        let heads = [&[""][..], &SCORES, &["steps", "training"]].concat();
        let mut rows = vec![heads.into_iter().map(str::to_owned).collect()];
        for e in &entries {
            let rest = [out::number(e.steps), out::duration(e.train_s)];
            rows.push([&[e.name.to_owned()][..], &cells_of(&e.scores), &rest].concat());
        }
        out::say(&out::fitted(&Table { rows, notes: vec![] }))?;
        out::say(&format!(
            "\nThe two fields have made the same number of steps.\npicture: {}\nscan and runs are in the same folder: \
             conefield report {} -o demo.html shows them",
            picture.display(),
            folder.display(),
        ))
    }

    /// A run of `spec`. The simulated volume and the first two results are held beside it.
    fn session<'a>(
        &self,
        backend: &'a Cpu,
        spec: &str,
        sets: Vec<String>,
        init: Option<&Path>,
        limits: Limits,
    ) -> Result<Session<'a>> {
        let (side, views) = (u64::from(self.size), usize::from(self.views));
        let (pixels, voxels) = (4 * side * side * u64::from(self.views), side.pow(3));
        let size = ScanSize { pixels, voxels, test_pixels: 0, reading: 12 * voxels, views };
        let run = memory::Run { reference: true, ..memory::Run::on(size) };
        let read = |sets: &[String]| specs::read(spec, sets);
        let request = Request {
            spec: Some(&read),
            sets,
            init: init.map(Path::to_path_buf),
            limits,
            seed: self.seed,
            ..Request::default()
        };
        Session::open(request, backend, run, Instant::now())
    }
}

/// What the methods share.
struct Shared<'a> {
    folder: &'a Path,
    seed: u64,
    scan: Arc<Scan>,
    truth: &'a Volume,
}

impl Shared<'_> {
    /// Runs a method called `name`, and writes what "conefield reconstruct" writes to the folder `run`.
    fn compete(&self, name: &'static str, run: &'static str, session: Session<'_>) -> Result<Entry> {
        let mut folder = RunFolder::take(&self.folder.join(run))?;
        folder.may_begin(true)?;
        let input = Input::new(self.scan.clone(), vec![], Some(self.truth.clone()), Some(1.0))?;
        let mut method = session.plan(input, 0.0, &|| false)?;
        let metrics = folder.begin(&to_toml(&method.method.loaded.spec)?)?;
        let mut progress = Progress::new(name, Some(metrics));
        let solved = method.solve(None, None, &mut progress)?;
        let (written, slices) = reconstruct::write(&folder, &method, &solved, self.seed, &Cpu::new())?;
        let Solution { steps, train_s, .. } = solved.solution;
        let (scores, export_s) = (written.scores.clone(), written.export_s);
        let record = RunRecord {
            scan: Some(ScanRecord::of(&self.folder.join(SCAN), &self.scan)?),
            reference: Some("truth".into()),
            ..method.record(&solved, progress.records().last(), written)
        };
        conefield_io::write_text_atomic(folder.file("record.json"), &out::to_json(&record)?)?;
        folder.finish()?;
        let scores = scores.ok_or_else(|| Error::unsupported("demo", "the phantom is not scored"))?;
        Ok(Entry { name, run, steps, train_s, export_s, scores, slices })
    }
}
