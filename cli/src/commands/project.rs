//! `conefield project`

use crate::boundary::Inputs;
use crate::progress::Progress;
use crate::{out, signals};
use clap::Args;
use conefield::memory::{self, Memory};
use conefield::parse::HoldOut;
use conefield::projection;
use conefield::{files, parse};
use conefield_core::error::ensure;
use conefield_core::scan::Scan;
use conefield_core::{Error, Result};
use conefield_evaluation::metrics::{self, Residual};
use ndarray::Array3;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::Instant;

/// Compute the views of a volume in the geometry of a scan.
///
/// The result is a scan with the line integrals of the volume. The volume is centred on the volume of the scan; a NumPy
/// array, which has no voxel size, fills the same box. --residual also writes measured minus predicted line integrals;
/// structure there shows what the volume does not explain.
#[derive(Args)]
pub struct ProjectArgs {
    /// The volume, in 1/unit of the scan, as "reconstruct" writes it.
    volume: PathBuf,
    /// The scan whose views are predicted.
    #[arg(long, value_name = "SCAN")]
    like: PathBuf,
    /// The folder for the predicted views.
    #[arg(short, long = "output", value_name = "PREDICTED")]
    output: PathBuf,
    /// Also write measured minus predicted line integrals to this folder.
    #[arg(long, value_name = "FOLDER")]
    residual: Option<PathBuf>,
    /// Only these views, such as 3,17 or every:10.
    #[arg(long, value_name = "VIEWS", value_parser = parse::hold_out)]
    views: Option<HoldOut>,
    /// Voxel projector: joseph, siddon or trilinear.
    #[arg(long, value_name = "TYPE", default_value = projection::PROJECTOR)]
    projector: String,
    /// Replace PREDICTED and FOLDER.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl ProjectArgs {
    pub fn run(self) -> Result<()> {
        let inputs = Inputs::of([&self.volume, &self.like]);
        for folder in std::iter::once(&self.output).chain(&self.residual) {
            inputs.spare(folder, self.force)?;
        }
        let twice = self.residual.as_ref() == Some(&self.output);
        ensure(!twice, "command line", "--residual", "the folder of the predicted views", "another folder")?;
        let projector = projection::projector(Value::String(self.projector.clone()))?;
        std::fs::metadata(&self.volume).map_err(|e| Error::io(&self.volume, e))?;
        let (voxels, size) = (conefield_io::volume_voxels(&self.volume)?, conefield_io::scan_size(&self.like)?);
        let reading = Memory { scan: 4 * size.pixels + size.reading, volume: 8 * voxels, ..Memory::default() };
        let header = size.header();
        // Predicted views in addition to the measured ones.
        let buffers = 4 * size.pixels + projector.scratch(&header, header.views);
        let projecting = Memory { scan: 4 * size.pixels, volume: 4 * voxels, buffers, ..Memory::default() };
        let memory = Memory::most(&[reading, projecting]);
        memory.check()?;

        let volume = conefield_io::read_volume(&self.volume)?;
        parse::must_be_attenuation(&self.volume.display().to_string(), &volume)?;
        let (scan, chosen) = self.chosen(files::scan(&self.like)?)?;
        let mut geometry = scan.geometry.clone();
        // Of the readable formats only NumPy arrays have no affine.
        geometry.volume = projection::placed(&volume, &scan.geometry.volume, volume.affine.is_some());
        if let Some(odd) = projection::oddity(&geometry.volume, &scan.geometry.volume) {
            tracing::warn!("{}: {odd}", self.volume.display());
        }
        signals::listen();
        let start = Instant::now();
        let mut progress = Progress::new("project", None);
        let mut go_on = |share| {
            progress.reach(share);
            signals::caught().map_or(Ok(()), |_| Err(Error::Aborted { part: "the projection".into() }))
        };
        let views = projection::predicted(&volume, &geometry, scan.unit.mm, projector.as_ref(), &mut go_on)?;
        drop(progress);
        let project_s = start.elapsed().as_secs_f64();
        let of = |projections: Array3<f32>, what: &str| Scan {
            geometry: scan.geometry.clone(),
            projections,
            unit: scan.unit.clone(),
            provenance: json!({
                what: { "volume": self.volume, "scan": self.like, "projector": projector.describe() }
            }),
        };
        let mut predicted = of(views, "predicted");
        conefield_io::write_scan(&self.output, &predicted, None)?;
        let residual = metrics::residual(&scan, &mut predicted.projections)?;
        if let Some(folder) = &self.residual {
            conefield_io::write_scan(folder, &of(predicted.projections, "residual"), None)?;
        }
        self.report(&scan, &chosen, &residual, project_s, memory)
    }

    /// The scan with the requested views, and their indices.
    fn chosen(&self, scan: Scan) -> Result<(Scan, Vec<usize>)> {
        let n = scan.geometry.views.len();
        match conefield::input::chosen(self.views.as_ref(), n)? {
            all if all.is_empty() || all.len() == n => Ok((scan, (0..n).collect())),
            some => Ok((scan.select(&some), some)),
        }
    }

    /// Prints the result.
    fn report(&self, scan: &Scan, chosen: &[usize], residual: &Residual, project_s: f64, memory: Memory) -> Result<()> {
        let (n, [rows, columns]) = (scan.geometry.views.len(), scan.geometry.detector);
        if self.json {
            return out::json(&json!({
                "predicted": self.output, "residual": self.residual, "views": n, "detector": [rows, columns],
                "residual_rms": residual.rms, "residual_relative": residual.relative,
                "residual_rms_of_views": residual.views, "indices_of_views": chosen, "project_s": project_s, "memory": memory,
                "peak_bytes": memory::peak(),
            }));
        }
        let worst = chosen.iter().zip(residual.views.iter().copied()).max_by(|a, b| a.1.total_cmp(&b.1));
        let worst = worst.map_or(String::new(), |(v, rms)| format!(", {rms:.5} in view {v}, the worst"));
        out::say(&format!(
            "{}: {} of {rows} x {columns} in {}\nmeasured minus predicted: root mean square {:.5}, {:.5} of the \
             largest line integral{worst}",
            self.output.display(),
            out::counted(n, "view"),
            out::duration(project_s),
            residual.rms,
            residual.relative,
        ))
    }
}
