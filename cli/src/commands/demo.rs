//! `conefield demo`

use super::Command;
use super::protocol::word;
use crate::boundary::{self, refuse_existing};
use crate::{Cli, out};
use clap::{Args, Parser};
use conefield::score::{SCORES, cells_of};
use conefield::{memory, method, parse, specs};
use conefield_backend_cpu::Cpu;
use conefield_core::{Error, Result};
use conefield_evaluation::metrics::Scores;
use conefield_evaluation::report::{MiddleSlices, Table, compare_png};
use conefield_io::ScanSize;
use conefield_projectors::simulate::{DetectorNoise, Protocol, phantom, simulate};
use serde::Serialize;
use serde_json::{Value, json};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
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
}

impl DemoArgs {
    pub fn run(self) -> Result<()> {
        let folder = &self.output;
        // A spec stores the path of the weights as text.
        boundary::text(folder)?;
        refuse_existing(folder, self.force)?;
        // A method that does not fit into memory is refused before anything is created.
        [VOXELS, FIELD].into_iter().try_for_each(|spec| self.check_memory(spec))?;
        std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        let size = usize::from(self.size);
        let truth = phantom(size);
        let noise = DetectorNoise::Tigre { i0: 1e4, sigma: 10.0 };
        let protocol = Protocol::r2(&truth.grid)
            // As published: twice as many pixels as voxels along a side.
            .with_detector([2 * size; 2])
            .with_views(self.views.into())
            .with_noise(noise, self.seed);
        conefield_io::write_scan(folder.join(SCAN), &simulate(&truth, &protocol)?, Some(&truth))?;
        let views = out::counted(self.views, "view");
        info!("simulated {views} of {0} x {0} pixels", 2 * size);
        let path = folder.join("fast.safetensors");
        conefield_io::write_atomic(&path, &mut |w| w.write_all(specs::FAST_WEIGHTS).map_err(|e| Error::io(&path, e)))?;

        // Passes over the views end by themselves, within seconds.
        let voxels = self.compete("smooth-tv", "smooth-tv", VOXELS, &[])?;
        let timed = [word("--init", &path), word("--seconds", self.seconds.to_string())];
        let field = self.compete("fast (LN, MCI)", "fast", FIELD, &timed)?;
        // At equal steps: how many fit into a time depends on what else the machine does.
        let without = ["--set=normalizers=[]".into(), "--set=initializer.type=random".into()];
        let other = [&without[..], &[word("--steps", field.steps.max(1).to_string())]].concat();
        let other = self.compete("without LN, MCI", "without", FIELD, &other)?;
        let entries = [voxels, field, other];
        let methods: Vec<Value> = entries.iter().map(|e| json!({ "name": e.run })).collect();
        conefield_io::write_text_atomic(folder.join("table.json"), &out::to_json(&json!({ "methods": methods }))?)?;
        let picture = folder.join("compare.png");
        self.draw(&picture, &MiddleSlices::of(&truth), &entries)?;
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

    /// Refuses a run of `spec` that does not fit into memory, together with the volume that is scanned.
    fn check_memory(&self, spec: &str) -> Result<()> {
        let (side, views) = (u64::from(self.size), usize::from(self.views));
        let (pixels, voxels) = (4 * side * side * u64::from(self.views), side.pow(3));
        let size = ScanSize { pixels, voxels, test_pixels: 0, reading: 4 * voxels, views };
        let run = memory::Run { reference: true, ..memory::Run::on(size) };
        method::planned(&|sets| specs::read(spec, sets), &[], None, &Cpu::new(), &run, true).map(drop)
    }

    /// Runs a method called `name` by "conefield reconstruct" with `more` options, into the folder `run`.
    fn compete(&self, name: &'static str, run: &'static str, spec: &str, more: &[OsString]) -> Result<Entry> {
        info!("{name}");
        let output = word("--output", self.output.join(run));
        let fixed = ["conefield", "reconstruct", "--backend=cpu", "--force", "--reference=truth", "--peak=1"];
        let words = fixed.map(OsString::from).into_iter().chain(more.iter().cloned());
        let words = words.chain([output, word("--spec", spec), word("--seed", self.seed.to_string())]);
        let line = Cli::try_parse_from(words.chain(["--".into(), self.output.join(SCAN).into()]));
        let failed = |why: String| Error::unsupported("demo", why);
        let Command::Reconstruct(mut command) = line.map_err(|e| failed(e.to_string()))?.command else {
            return Err(failed("no reconstruction".into()));
        };
        command.shown_as = Some(name);
        let record = command.reconstruct()?.ok_or_else(|| failed("no record".into()))?;
        let scores = record.written.scores.ok_or_else(|| failed("the phantom is not scored".into()))?;
        let (steps, train_s, export_s) = (record.steps, record.train_s, record.written.export_s);
        Ok(Entry { name, run, steps, train_s, export_s, scores })
    }

    /// Draws the middle slices of the phantom and of all results.
    fn draw(&self, picture: &Path, truth: &MiddleSlices, entries: &[Entry]) -> Result<()> {
        let mut results = vec![];
        for e in entries {
            let volume = conefield_io::read_volume(self.output.join(e.run).join("volume.nii.gz"))?;
            results.push((format!("{} {:.2} dB", e.name, e.scores.psnr), MiddleSlices::of(&volume)));
        }
        let results: Vec<_> = results.iter().map(|(caption, slices)| (&caption[..], slices)).collect();
        compare_png(picture, ("phantom", truth), &results, truth.window())
    }
}
