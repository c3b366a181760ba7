//! `conefield export`

use super::trained::Trained;
use super::units::{HounsfieldOption, unit_of};
use crate::boundary::{Inputs, refuse_existing};
use crate::{out, outgoing, signals};
use clap::Args;
use conefield::memory;
use conefield_core::Result;
use conefield_core::scan::Unit;
use conefield_core::trained::FieldVoxels;
use conefield_io::{DicomTemplate, PACKED_BYTES, SLAB_BYTES};
use serde_json::json;
use std::path::PathBuf;
use std::time::Instant;

/// Evaluate the field of a finished run on another grid.
///
/// The voxels fill the box that the run reconstructed. They are evaluated and written slab by slab, so a volume may be
/// larger than memory.
#[derive(Args)]
pub struct ExportArgs {
    #[command(flatten)]
    trained: Trained,
    /// The volume to write: .nii, .nii.gz, .mha, .mhd (with a .raw), .nrrd, .npy, .tif, .zarr (a folder, OME-Zarr)
    /// or, in 16 bits, .dicom (a folder, a DICOM series) or .dcm (one file, an enhanced CT).
    #[arg(short, long = "output", visible_alias = "out", value_name = "VOLUME")]
    output: PathBuf,
    #[command(flatten)]
    units: HounsfieldOption,
    /// A DICOM file whose patient and study VOLUME gets, if it is .dicom or .dcm.
    #[arg(long, value_name = "FILE")]
    dicom_template: Option<PathBuf>,
    /// Replace VOLUME.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl ExportArgs {
    pub fn run(self) -> Result<()> {
        refuse_existing(&self.output, self.force)?;
        let buffers = FieldVoxels::BYTES + SLAB_BYTES + PACKED_BYTES;
        let opened = self.trained.open(buffers)?;
        let (memory, grid) = (opened.memory(buffers)?, opened.grid);
        let inputs = Inputs::of([&opened.file]).and(self.units.path()).and(&self.dicom_template);
        inputs.spare_file(&self.output)?;
        inputs.spare_folder(&self.output)?;
        let template = self.dicom_template.as_ref().map(DicomTemplate::read).transpose()?;
        conefield_io::check_shape(&self.output, grid.shape)?;
        let unknown = || Unit { name: "unknown, no record.json names it".into(), mm: opened.field.unit_mm };
        let unit = if self.units.hu.is_some() { unit_of(&opened.file)? } else { None }.unwrap_or_else(unknown);
        let hu = self.units.of_attenuation()?.open(&opened.file, Some(&unit), &grid, None)?;
        let backend = self.trained.backend.open()?;
        signals::listen();
        let start = Instant::now();
        let mut voxels = opened.field.voxels(backend.as_ref(), grid)?;
        let hounsfield = outgoing::write_only(&self.output, &mut voxels, None, hu.as_ref(), template.as_ref())?;
        let export_s = start.elapsed().as_secs_f64();
        if self.json {
            return out::json(&json!({
                "volume": self.output, "shape": grid.shape, "spacing_mm": grid.spacing, "export_s": export_s,
                "hounsfield": hounsfield, "memory": memory, "peak_bytes": memory::peak(),
            }));
        }
        let [x, y, z] = grid.shape;
        let (file, took) = (self.output.display(), out::duration(export_s));
        out::say(&format!("{file}: {x} x {y} x {z} voxels in {took}"))
    }
}
