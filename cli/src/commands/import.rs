//! `conefield import`

use super::{
    corrections::{CorrectionOptions, corrected_size, tell},
    info,
    selection::SelectionOptions,
};
use crate::boundary::{Inputs, refuse_existing};
use crate::memory::Memory;
use crate::{out, parse};
use clap::Args;
use conefield_core::Result;
use conefield_diagnosis::survey;
use conefield_io::{I0, ImportOptions, Imported};
use serde_json::{Value, json};
use std::path::PathBuf;

/// Convert the files of a scanner to a scan.
///
/// SCANNER.toml names the files with the projections (TIFF, HDF5, .npy, .npz, .mha) and describes geometry (in mm) and array layout;
/// docs/guide/formats.md has all keys. A .xtekct file of Nikon replaces it. Raw counts become line integrals; dead and hot pixels are
/// interpolated. Then --correct corrects faults and a part may be taken; --bin averages counts.
#[derive(Args)]
pub struct ImportArgs {
    /// The description of the scanner.
    #[arg(value_name = "SCANNER.toml")]
    scanner: PathBuf,
    /// The folder for the scan.
    #[arg(short, long = "output", value_name = "SCAN")]
    output: PathBuf,
    /// Counts of the open beam: a number, or air to take them from the border of each view [default: the flat field or i0 of
    /// SCANNER.toml].
    #[arg(long, value_name = "N|air", value_parser = parse::i0)]
    i0: Option<I0>,
    /// Lowest counts above dark; lower ones are raised to it [default: SCANNER.toml's, else 1 or a ten-thousandth of the open
    /// beam].
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
    pub fn run(self) -> Result<()> {
        refuse_existing(&self.output, self.force)?;
        Inputs::default().and_description(&self.scanner).spare_folder(&self.output)?;
        let corrections = self.corrections.corrections()?;
        let size = corrected_size(conefield_io::scanner_size(&self.scanner)?, &corrections);
        Memory::of_views(&size).check(|_| vec![])?;
        let selection = self.selection.selection();
        let options = ImportOptions { i0: self.i0, floor: self.floor, corrections, selection };
        let imported = conefield_io::read_scanner(&self.scanner, &options)?;
        tell(&self.scanner, &imported.corrections);
        conefield_io::write_scan(&self.output, &imported.scan, None)?;
        let found = self.understood(&imported);
        if self.json { out::json(&found) } else { out::say(&(info::lines(&found) + &info::warnings(&found))) }
    }

    /// The geometry in mm and a summary of the values.
    fn understood(&self, imported: &Imported) -> Value {
        let views = &imported.scan.geometry.views;
        let survey = survey(&imported.scan);
        let mut found = info::facts(&imported.scan, &survey);
        found["scan"] = json!(self.output);
        found["first_view"] = json!(views[0]);
        found["last_view"] = json!(views[views.len() - 1]);
        found["counts"] = json!(imported.counts);
        found["corrections"] = json!(imported.corrections);
        found["line_integrals"] = json!(survey.check);
        found
    }
}
