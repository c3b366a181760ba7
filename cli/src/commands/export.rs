//! `conefield export`

use super::convert::refuse_existing;
use crate::backend::BackendChoice;
use crate::memory::{self, Memory};
use crate::{files, out, outgoing, signals};
use clap::Args;
use conefield_core::trained::FieldVoxels;
use conefield_core::{Error, Result};
use conefield_io::{PACKED_BYTES, SLAB_BYTES};
use serde_json::json;
use std::path::PathBuf;
use std::time::Instant;

/// Evaluate the field of a finished run at other voxels.
///
/// The voxels fill the box that the run reconstructed. They are written as they are evaluated, slab by slab: a volume
/// may be larger than memory.
#[derive(Args)]
pub struct Export {
    /// The folder of the run, or its weights.safetensors.
    run: PathBuf,
    /// The volume to write: .nii, .nii.gz, .mha or .npy.
    #[arg(short, long = "output", visible_alias = "out", value_name = "VOLUME")]
    output: PathBuf,
    /// Voxels along the longest side [default: as the scan asked for].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    voxels: Option<u16>,
    /// Which backend: auto, cpu, wgpu, or wgpu:N with the number of an adapter.
    #[arg(long, value_name = "BACKEND", default_value_t)]
    backend: BackendChoice,
    /// Replace VOLUME.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl Export {
    pub fn run(self) -> Result<()> {
        refuse_existing(&self.output, self.force)?;
        let file = if self.run.is_dir() { self.run.join("weights.safetensors") } else { self.run };
        let bytes = file.metadata().map_err(|e| Error::io(&file, e))?.len();
        // The file and the numbers in it, then these and the model.
        let buffers = FieldVoxels::BYTES + SLAB_BYTES + PACKED_BYTES;
        let memory = Memory::most(&[Memory { model: 2 * bytes, buffers, ..Memory::default() }]);
        memory.check(|_| vec![])?;
        let field = files::read_field(&file)?;
        let trained = field.scene.grid;
        let grid = self.voxels.map_or(trained, |n| trained.with_longest(n.into()));
        let backend = self.backend.open()?;
        signals::listen()?;
        let start = Instant::now();
        let mut voxels = field.voxels(backend.as_ref(), grid)?;
        outgoing::write(&self.output, &mut voxels, None, false)?;
        let export_s = start.elapsed().as_secs_f64();
        if self.json {
            return out::json(&json!({
                "volume": self.output, "shape": grid.shape, "spacing_mm": grid.spacing, "export_s": export_s,
                "memory": memory, "peak_bytes": memory::peak(),
            }));
        }
        let [x, y, z] = grid.shape;
        let (file, took) = (self.output.display(), out::duration(export_s));
        out::say(&format!("{file}: {x} x {y} x {z} voxels in {took}"))
    }
}
