//! `conefield import`

use super::convert::refuse_existing;
use crate::{files, out, parse};
use clap::Args;
use conefield_core::Result;
use conefield_core::geometry::norm;
use conefield_io::{I0, ImportOptions, Imported};
use serde_json::{Value, json};
use std::path::PathBuf;

/// Make a scan of what a scanner gave: projections in files, and words on where source and detector stood.
///
/// SCANNER.toml names the files (TIFF, .npy, .npz), the geometry in mm and how arrays lie; docs/geometry.md has all
/// keys. Raw counts become line integrals; dead and hot pixels are interpolated.
#[derive(Args)]
pub struct Import {
    /// The description of the scanner.
    #[arg(value_name = "SCANNER.toml")]
    scanner: PathBuf,
    /// The folder for the scan.
    #[arg(short, long = "output", value_name = "SCAN")]
    output: PathBuf,
    /// Counts of the open beam: a number, or air for what the border of each view shows [default: the flat field or
    /// i0 of SCANNER.toml].
    #[arg(long, value_name = "N|air", value_parser = parse::i0)]
    i0: Option<I0>,
    /// Counts above dark below which they are taken for this [default: SCANNER.toml's, else 1 or a ten thousandth of
    /// the open beam].
    #[arg(long, value_name = "N", value_parser = parse::above_zero)]
    floor: Option<f64>,
    /// Replace SCAN.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl Import {
    pub fn run(self) -> Result<()> {
        refuse_existing(&self.output, self.force)?;
        let options = ImportOptions { i0: self.i0, floor: self.floor };
        let imported = conefield_io::read_scanner(&self.scanner, &options)?;
        files::warn_of(&self.scanner, &imported.check);
        conefield_io::write_scan(&self.output, &imported.scan, None)?;
        let found = self.understood(&imported);
        if self.json { out::json(&found) } else { out::say(&super::info::lines(&found)) }
    }

    /// The geometry in mm and what the values are like.
    fn understood(&self, imported: &Imported) -> Value {
        let g = &imported.scan.geometry;
        let (first, last) = (&g.views[0], &g.views[g.views.len() - 1]);
        json!({
            "kind": "scan",
            "scan": self.output,
            "views": g.views.len(),
            "detector": g.detector,
            "pixel_mm": [norm(first.v), norm(first.u)],
            "source_to_axis_mm": first.source[0].hypot(first.source[1]),
            "source_to_detector_mm": first.normal().1,
            "first_view": first,
            "last_view": last,
            "volume": { "shape": g.volume.shape, "spacing_mm": g.volume.spacing, "center_mm": g.volume.center },
            "counts": imported.counts,
            "line_integrals": imported.check,
        })
    }
}
