//! The option for Hounsfield units of a written volume.

use crate::run_folder::Recorded;
use clap::Args;
use conefield::hounsfield::{Calibration, How};
use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::{Affine, Unit};
use conefield_core::{Error, Result};
use conefield_io::folder_of;
use std::path::Path;

/// Units of a written volume.
#[derive(Debug, Clone, Args)]
pub struct HounsfieldOption {
    /// Write Hounsfield units: water=MU,air=MU in 1/mm, such as water=0.0206,air=0; sphere:X,Y,Z,R or
    /// box:X,Y,Z,X,Y,Z in place of a MU takes the median of these voxels (mm, in the coordinates of the file, RAS). Or
    /// 60keV: water at this energy, air 0. Or a calibration file (.toml) with water and air. Or as-is: the values are
    /// Hounsfield units already. "reconstruct" writes volume-hu.nii.gz in addition.
    #[arg(long, value_name = "HOW")]
    pub hu: Option<How>,
}

impl HounsfieldOption {
    /// The calibration for voxels at `grid` and `affine` in 1/`unit`, if requested; `place` names the volume in errors.
    pub fn open(
        &self,
        place: &Path,
        unit: Option<&Unit>,
        grid: &VoxelGrid,
        affine: Option<&Affine>,
    ) -> Result<Option<Calibration>> {
        self.hu.as_ref().map(|how| how.open(&place.display().to_string(), unit, grid, affine)).transpose()
    }

    /// Itself, for values that are attenuation: refuses `as-is`.
    pub fn of_attenuation(&self) -> Result<&Self> {
        if self.hu == Some(How::Already) {
            let expected = "another form: these values are attenuation (convert takes as-is)";
            return Err(Error::invalid("command line", "--hu", "as-is", expected));
        }
        Ok(self)
    }

    /// The file that it names.
    pub fn path(&self) -> Option<&Path> {
        self.hu.as_ref().and_then(How::path)
    }
}

/// The unit of the volume `path`, which the run or the scan in whose folder it lies states.
pub fn unit_of(path: &Path) -> Result<Option<Unit>> {
    let folder = folder_of(path);
    if folder.join("record.json").is_file() {
        return Ok(Recorded::read(folder)?.scan.unit);
    }
    conefield_io::scan_unit(folder)
}
