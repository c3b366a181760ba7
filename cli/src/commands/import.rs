//! `conefield import`

use super::{
    General,
    corrections::{CorrectionOptions, corrected_size, log_applied},
    info,
    selection::SelectionOptions,
};
use crate::boundary::{Inputs, refuse_existing};
use crate::out;
use clap::Args;
use conefield::memory::Memory;
use conefield::parse;
use conefield_core::Result;
use conefield_io::I0;
use conefield_scans::diagnosis::{Survey, survey};
use conefield_scans::{ImportOptions, Imported};
use serde_json::{Value, json};
use std::path::PathBuf;

/// Convert the files of a scanner to a scan.
///
/// SCANNER.toml names the files with the projections (TIFF, HDF5, .npy, .npz, .mat, .mha) and describes the geometry
/// (in mm) and the array layout; docs/guide/formats.md has all keys. The file of a vendor can take its place. Raw
/// counts become line integrals; dead and hot pixels are interpolated. --correct then corrects faults; other options
/// select part of the scan; --bin averages counts. The command prints a summary of the scan; with -v it also prints
/// what conefield info prints, and the first and the last view.
#[derive(Args)]
pub struct ImportArgs {
    /// The description of the scanner, or a vendor's: Nikon's .xtekct, SkyScan's .log, Varian's Scan.xml or
    /// ProjectionInfo.xml, Elekta's _Frames.xml, Zeiss' .txrm. Or a folder with scanner.toml.
    #[arg(value_name = "SCANNER.toml")]
    scanner: PathBuf,
    /// The folder for the scan.
    #[arg(short, long = "output", value_name = "SCAN")]
    output: PathBuf,
    /// Counts of the open beam: a number, or air to take them from the border of each view [default: the flat field or
    /// i0 of SCANNER.toml].
    #[arg(long, value_name = "N|air", value_parser = parse::i0)]
    i0: Option<I0>,
    /// Lowest count above dark; lower counts are raised to it [default: SCANNER.toml's, else 1 or a ten-thousandth of
    /// the open beam].
    #[arg(long, value_name = "N", value_parser = parse::above_zero)]
    floor: Option<f64>,
    #[command(flatten)]
    corrections: CorrectionOptions,
    #[command(flatten)]
    selection: SelectionOptions,
    /// Replace SCAN.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl ImportArgs {
    pub fn run(self, general: &General) -> Result<()> {
        refuse_existing(&self.output, self.force)?;
        let scanner = &conefield_io::scanner_file(&self.scanner);
        Inputs::default().and_description(scanner).spare_folder(&self.output)?;
        let corrections = self.corrections.corrections()?;
        let size = corrected_size(conefield_io::scanner_size(scanner)?, &corrections);
        Memory::of_views(&size).check()?;
        let selection = self.selection.selection();
        let options = ImportOptions { i0: self.i0, floor: self.floor, corrections, selection };
        let imported = conefield_scans::import(scanner, &options)?;
        log_applied(scanner, &imported.corrections);
        conefield_io::write_scan(&self.output, &imported.scan, None)?;
        let survey = survey(&imported.scan);
        let found = self.understood(&imported, &survey);
        if self.json {
            return out::json(&found);
        }
        let mut text = self.summary(&imported, &survey);
        if general.verbose > 0 {
            text += &format!("\n\n{}", info::lines(&found));
        }
        out::say(&(text + &info::warnings(&found)))
    }

    /// Views, distances, arc, values and the folder, a line each.
    fn summary(&self, imported: &Imported, survey: &Survey) -> String {
        let mut lines = info::in_short(&imported.scan, survey, imported.counts.as_ref());
        lines.push(vec!["written".into(), format!("{} (conefield info prints more)", self.output.display())]);
        out::table(&lines, &[])
    }

    /// The geometry in mm and a summary of the values.
    fn understood(&self, imported: &Imported, survey: &Survey) -> Value {
        let views = &imported.scan.geometry.views;
        let mut found = info::facts(&imported.scan, survey);
        found["scan"] = json!(self.output);
        found["first_view"] = json!(views[0]);
        found["last_view"] = json!(views[views.len() - 1]);
        found["counts"] = json!(imported.counts);
        found["corrections"] = json!(imported.corrections);
        found["line_integrals"] = json!(survey.check);
        found
    }
}
