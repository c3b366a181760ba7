//! `conefield convert`

use super::corrections::{CorrectionOptions, corrected_size, log_applied};
use super::selection::SelectionOptions;
use super::units::{HounsfieldOption, unit_of};
use crate::boundary::Inputs;
use crate::{out, run_folder};
use clap::{Args, ValueEnum};
use conefield::files;
use conefield::hounsfield::How;
use conefield::memory::Memory;
use conefield::parse::{self, Values};
use conefield_core::error::ensure;
use conefield_core::scan::Unit;
use conefield_core::{Error, Result};
use conefield_io::{DataSet, DicomTemplate, Parts, write_voxels_of};
use conefield_projectors::simulate::HuMapping;
use conefield_scans::diagnosis::survey;
use std::path::PathBuf;

/// Rewrite a volume or a scan in another format.
///
/// Volumes: the extension of OUT selects NIfTI (.nii, .nii.gz), MetaImage (.mha, .mhd with a .raw), NRRD, NumPy (.npy),
/// a TIFF stack (.tif), an OME-Zarr folder (.zarr) or, in 16 bits, a folder with a DICOM series (.dicom) or one DICOM
/// file (.dcm). IN may also be a .nhdr file, or a folder with a DICOM series or TIFF slices. Scans: --to sets the format;
/// r2 and naf keep test views. --correct corrects faults of a scan; other options select part of it; --bin averages line
/// integrals.
#[derive(Args)]
pub struct ConvertArgs {
    /// A volume or a scan.
    #[arg(value_name = "IN")]
    input: PathBuf,
    /// The file or folder to write.
    #[arg(value_name = "OUT")]
    output: PathBuf,
    /// The format of a scan.
    #[arg(long, default_value = "conefield")]
    to: ScanFormat,
    /// Meaning of the voxel values: as-is, hu:MU_WATER or clip:LO,HI.
    #[arg(long, default_value = "as-is", value_parser = parse::values)]
    values: Values,
    #[command(flatten)]
    units: HounsfieldOption,
    /// A DICOM file whose patient and study OUT gets, if it is .dicom or .dcm.
    #[arg(long, value_name = "FILE")]
    dicom_template: Option<PathBuf>,
    #[command(flatten)]
    corrections: CorrectionOptions,
    #[command(flatten)]
    selection: SelectionOptions,
    /// Replace OUT.
    #[arg(long)]
    force: bool,
}

/// The formats of scans that can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ScanFormat {
    /// conefield's own folder.
    Conefield,
    /// R2-Gaussian's folder.
    R2,
    /// The pickle of NAF and SAX-NeRF.
    Naf,
    /// A folder for RTK: projections.mha and geometry.xml, and scanner.toml for conefield.
    Rtk,
}

impl ConvertArgs {
    pub fn run(self) -> Result<()> {
        std::fs::metadata(&self.input).map_err(|e| Error::io(&self.input, e))?;
        let inputs = Inputs::of([&self.input]).and(self.units.path()).and(&self.dicom_template);
        inputs.spare(&self.output, self.force)?;
        let (selection, corrections) = (self.selection.selection(), self.corrections.corrections()?);
        if conefield_io::is_volume(&self.input) {
            let named = self.selection.named().or((!corrections.is_none()).then_some("--correct"));
            let named = named.or((self.to != ScanFormat::Conefield).then_some("--to"));
            if let Some(option) = named {
                let place = self.input.display().to_string();
                let expected = "a scan: only scans have views and pixels";
                return Err(Error::invalid(place, option, "a volume", expected));
            }
            // Mapped values are no Hounsfield units, nor are those of a run.
            if self.values != Values::AsIs || run_folder::is_result(&self.input) {
                self.units.of_attenuation()?;
            }
            let template = self.dicom_template.as_ref().map(DicomTemplate::read).transpose()?;
            let voxels = conefield_io::volume_voxels(&self.input)?;
            Memory::of_volumes(&[voxels]).check()?;
            let volume = conefield_io::read_volume(&self.input)?;
            conefield_io::check_shape(&self.output, volume.grid.shape)?;
            let mut volume = &self.values.apply(volume)?;
            // Hounsfield units, converted once more, would be nonsense that looks like a volume.
            if self.units.hu.as_ref().is_some_and(|how| *how != How::Already) {
                parse::must_be_attenuation(&self.input.display().to_string(), volume)?;
            }
            let unit = match self.values {
                _ if self.units.hu.is_none() => None,
                Values::AsIs => unit_of(&self.input)?,
                Values::Hu(HuMapping::Mu { .. }) => None,
                Values::Hu(HuMapping::Clip { .. }) => Some(Unit { name: "clipped range".into(), mm: 1.0 }),
            };
            let hu = self.units.open(&self.input, unit.as_ref(), &volume.grid, volume.affine.as_ref())?;
            match hu.map(|hu| hu.measure(&mut volume)).transpose()? {
                Some(levels) => write_voxels_of(&self.output, &mut levels.of(&mut volume), template.as_ref())?,
                None => write_voxels_of(&self.output, &mut volume, template.as_ref())?,
            }
        } else {
            let named = [
                ("--hu", self.units.hu.is_some()),
                ("--dicom-template", self.dicom_template.is_some()),
                ("--values", self.values != Values::AsIs),
            ];
            if let Some((option, _)) = named.into_iter().find(|(_, given)| *given) {
                let expected = "a volume: a scan has line integrals";
                return Err(Error::invalid(self.input.display().to_string(), option, "a scan", expected));
            }
            let size = conefield_io::scan_size(&self.input)?;
            let place = self.output.display().to_string();
            let expected = "the name of a folder, or of a file with --to naf: a scan does not become a volume";
            ensure(!conefield_io::is_volume_name(&self.output), &place, "OUT", "the end of a volume's name", expected)?;
            let size = corrected_size(size, &corrections);
            Memory::of_data_set(&size).check()?;
            let DataSet { train, test, volume } = conefield_scans::read_data_set(&self.input, Parts::ALL)?;
            let place = self.input.display().to_string();
            let (train, applied) = corrections.apply(train, &place)?;
            log_applied(&self.input, &applied);
            let test = test.map(|test| corrections.apply(test, &place)).transpose()?.map(|(test, _)| test);
            if let (ScanFormat::R2 | ScanFormat::Naf, Some(_), Some(test)) = (self.to, corrections.truncation, &test) {
                let [wide, own] = [&train, test].map(|scan| scan.geometry.detector);
                let found = format!("training views of {wide:?} pixels and test views of {own:?}");
                let expected = "an object that reaches the sides in both: this format has one detector for all views";
                ensure(wide == own, &place, "--correct truncation", found, expected)?;
            }
            let test = test.map(|test| selection.of_detector(test)).transpose()?;
            let data = DataSet { train: selection.of(train)?, test, volume };
            files::warn_of(&self.input, &survey(&data.train), false);
            self.warn_of_lost(&data);
            let (scan, test, truth) = (&data.train, data.test.as_ref(), data.volume.as_ref());
            match self.to {
                ScanFormat::Conefield => conefield_io::write_scan(&self.output, scan, truth)?,
                ScanFormat::R2 => conefield_io::write_r2(&self.output, scan, test, truth)?,
                ScanFormat::Naf => conefield_io::write_naf(&self.output, scan, test, truth)?,
                ScanFormat::Rtk => conefield_io::write_rtk(&self.output, scan)?,
            }
        }
        out::say(&self.output.display().to_string())
    }

    /// Warns about data that the format cannot hold.
    fn warn_of_lost(&self, data: &DataSet) {
        let lost = |what: String| tracing::warn!("{}: {what}", self.output.display());
        if let Some(test) = data.test.as_ref().filter(|_| matches!(self.to, ScanFormat::Conefield | ScanFormat::Rtk)) {
            let views = out::counted(test.geometry.views.len(), "test view");
            lost(format!("left out: {views}, which r2 and naf can hold"));
        }
        if data.volume.is_some() && self.to == ScanFormat::Rtk {
            lost("the true volume is left out: RTK's format cannot hold it".into());
        }
    }
}
