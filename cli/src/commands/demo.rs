//! `conefield demo`

use super::convert::refuse_existing;
use super::evaluate::score;
use crate::progress::Progress;
use crate::{out, parse, specs};
use clap::Args;
use conefield_backend_cpu::Cpu;
use conefield_core::arena::Weights;
use conefield_core::scan::{Scan, Volume};
use conefield_core::solver::{Job, Limits};
use conefield_core::{Error, Result};
use conefield_metrics::Scores;
use conefield_projectors::simulate::{PhantomKind, Protocol, phantom, simulate};
use serde::Serialize;
use std::path::PathBuf;
use tracing::info;

/// Simulate a small scan, reconstruct it in two ways and compare.
///
/// A head-like phantom is scanned with the published noise. The spec "fast", started from pre-trained weights (MCI),
/// then competes with the same field without LayerNorm and MCI, each given the same time.
#[derive(Args)]
pub struct Demo {
    /// The folder for scan, volumes and picture.
    #[arg(short, long = "output", value_name = "FOLDER", default_value = "conefield-demo")]
    output: PathBuf,
    /// Training time of each of the two.
    #[arg(long, value_name = "TIME", default_value = "60s", value_parser = parse::seconds)]
    budget: f64,
    /// Voxels along a side of the volume.
    #[arg(long, value_name = "N", default_value_t = 96, value_parser = clap::value_parser!(u16).range(16..=256))]
    size: u16,
    /// Number of views.
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = clap::value_parser!(u16).range(2..=1000))]
    views: u16,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Replace FOLDER.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// One of the two competitors and what became of it.
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

impl Demo {
    pub fn run(self) -> Result<()> {
        refuse_existing(&self.output, self.force)?;
        let size = usize::from(self.size);
        let truth = phantom(PhantomKind::Head, size)?;
        let noise = parse::noise("tigre:1e4,10").map_err(|e| Error::unsupported("noise", e))?;
        let protocol = Protocol::r2(&truth.grid)
            .with_detector([size; 2])
            .with_views(self.views.into())
            .with_noise(noise, self.seed);
        let scan = simulate(&truth, &protocol)?;
        info!("simulated {} views of {size} x {size} pixels", self.views);
        let weights = specs::fast_weights().map(conefield_io::weights_from_bytes).transpose()?;
        let mut with = vec![];
        let name = if weights.is_some() {
            with.push("initializer={ type = \"mci\", weights = \"fast\" }".to_owned());
            "fast (LN, MCI)"
        } else {
            info!("no pre-trained weights in this build: MCI is left out");
            "fast (LN)"
        };
        let without = vec!["normalizers=[]".to_owned(), "initializer={ type = \"random\" }".to_owned()];
        let entries = [
            self.compete(name, &with, &scan, &truth, weights.as_ref())?,
            self.compete("same field without", &without, &scan, &truth, None)?,
        ];
        conefield_io::write_folder_atomic(&self.output, |folder| {
            conefield_io::write_scan(folder.join("scan"), &scan, Some(&truth))?;
            conefield_io::write_volume(folder.join("fast.nii.gz"), &entries[0].volume)?;
            conefield_io::write_volume(folder.join("without.nii.gz"), &entries[1].volume)?;
            conefield_io::compare_png(folder.join("fast.png"), &truth, &entries[0].volume)?;
            conefield_io::compare_png(folder.join("without.png"), &truth, &entries[1].volume)
        })?;
        if self.json {
            return out::json(&serde_json::json!({ "folder": self.output, "results": entries }));
        }
        let ssim = |s: Option<f64>| s.map_or("-".into(), |x| format!("{x:.4}"));
        let mut rows = vec![["", "PSNR dB", "ssim_2d", "ssim_3d", "steps", "training"].map(str::to_owned).to_vec()];
        for e in &entries {
            rows.push(vec![
                e.name.into(),
                format!("{:.2}", e.scores.psnr),
                ssim(e.scores.ssim_2d),
                ssim(e.scores.ssim_3d),
                out::number(e.steps),
                out::duration(e.train_s),
            ]);
        }
        out::say(&out::table(&rows, &[1, 2, 3, 4, 5]))?;
        out::say(&format!("scan, volumes and pictures in {}", self.output.display()))
    }

    fn compete(
        &self,
        name: &'static str,
        sets: &[String],
        scan: &Scan,
        truth: &Volume,
        weights: Option<&Weights>,
    ) -> Result<Entry> {
        let loaded = specs::read("fast", sets)?;
        let solver = loaded.spec.solver.build()?;
        let job = Job {
            scan,
            held_out: None,
            reference: Some(truth),
            spec: &loaded.spec,
            backend: &Cpu::new(),
            seed: self.seed,
            limits: Limits { steps: None, seconds: Some(self.budget) },
            weights: &|path| match weights {
                Some(w) if path == "fast" => Ok(w.clone()),
                _ => conefield_io::read_weights(path),
            },
        };
        let solution = solver.solve(&job, &mut Progress::new(name, None))?;
        let scores = score(name, &solution.volume, truth, 1.0)?;
        let (steps, train_s, export_s) = (solution.steps, solution.train_s, solution.export_s);
        Ok(Entry { name, steps, train_s, export_s, scores, volume: solution.volume })
    }
}
