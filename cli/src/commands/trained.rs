//! Shared parts of commands on the field of a finished run.

use crate::run_folder::Recorded;
use clap::Args;
use conefield::backend::{self, BackendChoice};
use conefield::files;
use conefield::memory::Memory;
use conefield::plugins::Used;
use conefield_core::geometry::VoxelGrid;
use conefield_core::trained::TrainedField;
use conefield_core::{Error, Result};
use std::path::{Path, PathBuf};

/// A finished run, the grid to evaluate and the backend.
#[derive(Args)]
pub struct Trained {
    /// The folder of the run, or its weights.safetensors.
    run: PathBuf,
    /// Voxels along the longest side [default: as in the scan].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    voxels: Option<u16>,
    #[arg(long, value_name = "BACKEND", default_value_t, help = backend::HELP)]
    pub backend: BackendChoice,
}

/// The field of a run.
pub struct OpenedField {
    pub file: PathBuf,
    pub field: TrainedField,
    /// The requested grid.
    pub grid: VoxelGrid,
    bytes: u64,
}

impl Trained {
    /// Reads the field if it fits into memory together with `buffers` bytes.
    pub fn open(&self, buffers: u64) -> Result<OpenedField> {
        let file = if self.run.is_dir() { self.run.join("weights.safetensors") } else { self.run.clone() };
        let volume = self.run.join("volume.nii.gz");
        if self.run.is_dir() && !file.exists() && volume.exists() {
            let expected =
                format!("a run that trained a field; \"conefield convert {}\" writes other formats", volume.display());
            return Err(Error::invalid(self.run.display().to_string(), "field", "voxels without a field", expected));
        }
        let bytes = file.metadata().map_err(|e| Error::io(&file, e))?.len();
        memory(bytes, buffers)?;
        let field = files::read_field(&file).map_err(|e| self.with_plugins(e))?;
        let trained = field.scene.grid;
        let grid = self.voxels.map_or(trained, |n| trained.with_longest(n.into()));
        Ok(OpenedField { file, field, grid, bytes })
    }

    /// The error of reading the field; if the run used plugins that are not loaded, it says how to load them.
    fn with_plugins(&self, error: Error) -> Error {
        let folder = if self.run.is_dir() { &self.run } else { self.run.parent().unwrap_or(Path::new("")) };
        let Ok(Recorded { plugins, .. }) = Recorded::read(folder) else { return error };
        let missing: Vec<&Used> = plugins.iter().filter(|plugin| !plugin.is_loaded()).collect();
        if missing.is_empty() {
            return error;
        }
        let paths = missing.iter().map(|plugin| plugin.path()).collect::<Vec<_>>().join(", ");
        let options = missing.iter().map(|plugin| format!("--plugin {}", plugin.path())).collect::<Vec<_>>().join(" ");
        let found = format!("{paths}, which the run used and this command has not loaded ({error})");
        Error::invalid(folder.join("record.json").display().to_string(), "plugins", found, options)
    }
}

impl OpenedField {
    /// The memory of the field plus `buffers` bytes. Refuses a field that does not fit.
    pub fn memory(&self, buffers: u64) -> Result<Memory> {
        memory(self.bytes, buffers)
    }
}

/// Memory of the file with its numbers, then of the numbers with the model.
fn memory(bytes: u64, buffers: u64) -> Result<Memory> {
    let memory = Memory::most(&[Memory { model: 2 * bytes, buffers, ..Memory::default() }]);
    memory.check().map(|()| memory)
}
