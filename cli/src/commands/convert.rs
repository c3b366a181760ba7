//! `conefield convert`

use crate::memory::Memory;
use crate::parse::{self, Values};
use crate::{files, out};
use clap::{Args, ValueEnum};
use conefield_core::{Error, Result};
use std::path::PathBuf;

/// Rewrite a volume or a scan in another format.
///
/// Volumes: NIfTI (.nii, .nii.gz), MetaImage (.mha) and NumPy (.npy), by the name of OUT; IN may also be a .mhd or the
/// folder of a DICOM series. Scans: as --to says.
#[derive(Args)]
pub struct Convert {
    /// A volume or a scan.
    #[arg(value_name = "IN")]
    input: PathBuf,
    /// The file or folder to write.
    #[arg(value_name = "OUT")]
    output: PathBuf,
    /// The format of a scan.
    #[arg(long, default_value = "conefield")]
    to: ScanFormat,
    /// What a volume's values mean: as-is, hu:MU_WATER or clip:LO,HI.
    #[arg(long, default_value = "as-is", value_parser = parse::values)]
    values: Values,
    /// Replace OUT.
    #[arg(long)]
    force: bool,
}

/// The formats that scans are written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ScanFormat {
    /// conefield's own folder.
    Conefield,
    /// R2-Gaussian's folder.
    R2,
    /// The one file (a pickle) of NAF and SAX-NeRF.
    Naf,
}

impl Convert {
    pub fn run(self) -> Result<()> {
        std::fs::metadata(&self.input).map_err(|e| Error::io(&self.input, e))?;
        refuse_existing(&self.output, self.force)?;
        if conefield_io::is_volume(&self.input) {
            let voxels = conefield_io::volume_voxels(&self.input)?;
            Memory::of_volumes(&[voxels]).check(|_| vec![])?;
            let volume = self.values.apply(conefield_io::read_volume(&self.input)?)?;
            conefield_io::write_volume(&self.output, &volume)?;
        } else {
            let size = conefield_io::scan_size(&self.input)?;
            let scan = Memory { scan: 4 * size.pixels + size.reading, ..Memory::default() };
            let truth = Memory { scan: 4 * size.pixels, volume: 8 * size.voxels, ..Memory::default() };
            Memory::most(&[scan, truth]).check(|_| vec![])?;
            let scan = files::scan(&self.input)?;
            let truth = conefield_io::read_truth(&self.input)?;
            match self.to {
                ScanFormat::Conefield => conefield_io::write_scan(&self.output, &scan, truth.as_ref())?,
                ScanFormat::R2 => conefield_io::write_r2(&self.output, &scan, None, truth.as_ref())?,
                ScanFormat::Naf => conefield_io::write_naf(&self.output, &scan, None, truth.as_ref())?,
            }
        }
        out::say(&self.output.display().to_string())
    }
}

/// Refuses to write over something unless `force`.
pub fn refuse_existing(path: &std::path::Path, force: bool) -> Result<()> {
    let empty = std::fs::read_dir(path).is_ok_and(|mut d| d.next().is_none());
    if !force && !empty && path.symlink_metadata().is_ok() {
        let found = "something of that name";
        return Err(Error::invalid(path.display().to_string(), "output", found, "a new name, or --force"));
    }
    Ok(())
}
