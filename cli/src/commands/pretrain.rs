//! `conefield pretrain`

use super::EndOptions;
use crate::boundary::{self, Inputs, refuse_existing};
use crate::progress::Progress;
use crate::{out, signals};
use clap::Args;
use conefield::backend::{self, BackendChoice};
use conefield::parse::{self, Values};
use conefield::pretraining;
use conefield::{files, method, specs};
use conefield_core::Result;
use conefield_core::method::PretrainJob;
use conefield_core::scan::Volume;
use serde_json::json;
use std::path::PathBuf;

/// Train a field on known volumes, to start other scans from its weights (MCI).
///
/// The weights file holds normalizers and field. The encoder is not kept: it belongs to the volume that it was trained
/// on.
#[derive(Args)]
pub struct PretrainArgs {
    /// The known volumes: files, or phantoms as in "conefield simulate".
    #[arg(required = true, value_name = "VOLUME")]
    volumes: Vec<String>,
    #[arg(long, help = specs::help())]
    spec: String,
    /// The weights file to write (.safetensors).
    #[arg(short, long = "output", value_name = "WEIGHTS")]
    output: PathBuf,
    /// Change a setting, such as encoder.levels=8.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Meaning of the voxel values: as-is, hu:MU_WATER or clip:LO,HI.
    #[arg(long, default_value = "as-is", value_parser = parse::values)]
    values: Values,
    #[command(flatten)]
    ends: EndOptions,
    #[arg(long, value_name = "BACKEND", default_value_t, help = backend::HELP)]
    backend: BackendChoice,
    /// Seed of all random numbers.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Replace WEIGHTS.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl PretrainArgs {
    pub fn run(self) -> Result<()> {
        boundary::ends(&self.output, "safetensors")?;
        refuse_existing(&self.output, self.force)?;
        let loaded = specs::read(&self.spec, &self.sets)?;
        Inputs::of(&self.volumes).and_spec(&loaded).spare_file(&self.output)?;
        let backend = self.backend.open()?;
        let mut plan = method::plan(&loaded, backend.as_ref())?;
        let voxels: Vec<u64> = self.volumes.iter().map(|v| files::voxels(v)).collect::<Result<_>>()?;
        pretraining::check_memory(&voxels, &plan.outline())?;
        let read = |name: &String| self.values.attenuation(name, files::volume(name)?);
        let volumes: Vec<Volume> = self.volumes.iter().map(read).collect::<Result<_>>()?;
        let job =
            PretrainJob { volumes: &volumes, backend: backend.as_ref(), seed: self.seed, limits: self.ends.limits() };
        signals::listen();
        let mut progress = Progress::new("pretrain", None);
        let weights = pretraining::train(&loaded, plan.as_mut(), &job, &mut progress)?;
        let last = progress.latest.take().unwrap_or_default();
        drop(progress);
        files::write_weights(&self.output, &weights)?;
        let numbers: usize = weights.tensors.values().map(|t| t.1.len()).sum();
        if self.json {
            return out::json(&json!({
                "weights": self.output, "tensors": weights.tensors.keys().collect::<Vec<_>>(), "parameters": numbers,
                "steps": last.step, "train_s": last.seconds, "loss": last.loss,
            }));
        }
        out::say(&format!(
            "{}: {} tensors, {} parameters, after {} in {}{}",
            self.output.display(),
            weights.tensors.len(),
            out::number(numbers as u64),
            out::counted(last.step, "step"),
            out::duration(last.seconds),
            last.loss.map_or(String::new(), |l| format!(", loss {l:.3e}")),
        ))
    }
}
