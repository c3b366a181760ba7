//! `conefield demo`

use crate::boundary::refuse_existing;
use crate::progress::Progress;
use crate::{out, signals};
use clap::Args;
use conefield::input::Input;
use conefield::score::{SCORES, cells_of};
use conefield::session::{InMemory, Request, Session};
use conefield::{memory, parse, specs};
use conefield_backend_cpu::Cpu;
use conefield_core::method::{Limits, Reconstruction, Solution};
use conefield_core::scan::{Scan, Volume};
use conefield_core::{Error, Result};
use conefield_evaluation::metrics::Scores;
use conefield_evaluation::report::{MiddleSlices, Table};
use conefield_io::ScanSize;
use conefield_projectors::simulate::{DetectorNoise, Protocol, phantom, simulate};
use serde::Serialize;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use tracing::info;

/// Simulate a small scan, reconstruct it with three methods and compare them.
///
/// The scan is of a head phantom with the published noise. The methods are total variation on a smooth volume (spec
/// "smooth-tv"), a neural field that starts from pre-trained weights (spec "fast" with MCI), and the same field without
/// LayerNorm and MCI for the same time.
#[derive(Args)]
pub struct DemoArgs {
    /// The folder for scan, volumes and picture.
    #[arg(short, long = "output", value_name = "FOLDER", default_value = "conefield-demo")]
    output: PathBuf,
    /// Training time of each field.
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

/// The specs.
const VOXELS: &str = "smooth-tv";
const FIELD: &str = "fast";

/// A method and its result.
#[derive(Serialize)]
struct Entry {
    name: &'static str,
    steps: u64,
    train_s: f64,
    export_s: f64,
    scores: Scores,
    #[serde(skip)]
    volume: Volume,
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
        let without = vec!["normalizers=[]".to_owned(), "initializer.type=random".to_owned()];
        let methods = [
            ("smooth-tv", self.session(&backend, VOXELS, vec![], None)?),
            ("fast (LN, MCI)", self.session(&backend, FIELD, vec![], Some(weights.path()))?),
            ("without LN, MCI", self.session(&backend, FIELD, without, None)?),
        ];
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
        conefield_io::write_scan(folder.join("scan"), &scan, Some(&truth))?;
        info!("simulated {} views of {size} x {size} pixels", self.views);

        signals::listen()?;
        let path = folder.join("fast.safetensors");
        conefield_io::write_atomic(&path, |w| w.write_all(specs::FAST_WEIGHTS).map_err(|e| Error::io(&path, e)))?;
        let scan = Arc::new(scan);
        let mut entries = vec![];
        for (name, session) in methods {
            entries.push(compete(name, session, scan.clone(), truth.clone())?);
        }
        for (entry, file) in entries.iter().zip(["smooth-tv.nii.gz", "fast.nii.gz", "without.nii.gz"]) {
            conefield_io::write_volume(folder.join(file), &entry.volume)?;
        }
        let captions: Vec<String> = entries.iter().map(|e| format!("{} {:.2} dB", e.name, e.scores.psnr)).collect();
        let slices: Vec<MiddleSlices> = entries.iter().map(|e| MiddleSlices::of(&e.volume)).collect();
        let results: Vec<_> = captions.iter().map(|c| &c[..]).zip(&slices).collect();
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
        out::say(&Table { rows, notes: vec![] }.text())?;
        out::say(&format!("\npicture: {}\nscan and volumes are in the same folder", picture.display()))
    }

    /// A run of `spec`. The simulated volume and the first two results are held beside it.
    fn session<'a>(&self, backend: &'a Cpu, spec: &str, sets: Vec<String>, init: Option<&Path>) -> Result<Session<'a>> {
        let (side, views) = (u64::from(self.size), usize::from(self.views));
        let (pixels, voxels) = (4 * side * side * u64::from(self.views), side.pow(3));
        let size = ScanSize { pixels, voxels, test_pixels: 0, reading: 12 * voxels, views };
        let run = memory::Run { reference: true, ..memory::Run::on(size) };
        let read = |sets: &[String]| specs::read(spec, sets);
        let request = Request {
            spec: Some(&read),
            sets,
            init: init.map(Path::to_path_buf),
            // Passes over the views end by themselves, within seconds.
            limits: Limits { seconds: (spec == FIELD).then_some(self.seconds), ..Limits::default() },
            seed: self.seed,
            ..Request::default()
        };
        Session::open(request, backend, run, Instant::now())
    }
}

fn compete(name: &'static str, session: Session<'_>, scan: Arc<Scan>, truth: Volume) -> Result<Entry> {
    let mut run = session.plan(Input::new(scan, vec![], Some(truth), Some(1.0))?, 0.0, &|| false)?;
    let solved = run.solve(None, None, &mut Progress::new(name, None))?;
    let InMemory { volume, written } = run.in_memory(&solved, Reconstruction::volume)?;
    let Solution { steps, train_s, .. } = solved.solution;
    let scores = written.scores.ok_or_else(|| Error::unsupported("demo", "the phantom is not scored"))?;
    Ok(Entry { name, steps, train_s, export_s: written.export_s, scores, volume })
}
