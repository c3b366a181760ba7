//! `conefield calibrate`

use crate::boundary::{self, Inputs};
use crate::progress::Progress;
use crate::{out, signals};
use clap::Args;
use conefield::backend::{self, BackendChoice};
use conefield::memory::Memory;
use conefield_core::backend::Backend;
use conefield_core::scan::Scan;
use conefield_core::{Error, Result};
use conefield_evaluation::report::{CurveOptions, Panel, panels_png};
use conefield_io::{DataSet, Parts};
use conefield_scans::calibration::{
    Calibration, Found, Jitter, Parameter, Settings, Verdict, Watch, calibrate, directions, jitter, suspect,
};
use serde::Serialize;
use serde_json::json;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

/// Estimate the position of the detector from the views.
///
/// A quick reconstruction of some views predicts the others; the geometry with the smallest error is the estimate. For
/// offset-v, tilt, distance and step, pairs of views are compared without a reconstruction. No phantom is needed. SCAN
/// is not changed; OUT is the same scan with the corrected geometry. Parameters that the views do not determine, or
/// that are right within three standard deviations, stay unchanged. A warning reports if the views fit the opposite
/// direction of rotation clearly better.
#[derive(Args)]
pub struct CalibrateArgs {
    /// The scan.
    scan: PathBuf,
    /// The folder for the scan with the corrected geometry [default: no scan is written].
    #[arg(short, long = "output", value_name = "OUT")]
    output: Option<PathBuf>,
    /// Parameters to estimate: offset-u, offset-v, rotation, tilt, slant, distance and step.
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "offset-u,rotation")]
    parameters: Vec<Parameter>,
    /// Also estimate a shift of the detector in each view, after the other parameters.
    #[arg(long)]
    jitter: bool,
    /// Pixels along the longer side of the detector at the finest level; more pixels are more accurate and slower.
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u16).range(16..=1024))]
    pixels: u16,
    /// Also draw the error along each parameter.
    #[arg(long, value_name = "FILE")]
    png: Option<PathBuf>,
    #[arg(long, value_name = "BACKEND", default_value_t, help = backend::HELP)]
    backend: BackendChoice,
    /// Replace OUT.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl CalibrateArgs {
    pub fn run(self) -> Result<()> {
        let begin = Instant::now();
        std::fs::metadata(&self.scan).map_err(|e| Error::io(&self.scan, e))?;
        let inputs = Inputs::of([&self.scan]);
        boundary::picture(self.png.as_deref(), &inputs)?;
        if let Some(output) = &self.output {
            inputs.spare(output, self.force)?;
        }
        let backend = self.backend.open()?;
        let size = conefield_io::scan_size(&self.scan)?;
        let settings =
            Settings { parameters: self.parameters.clone(), width: self.pixels.into(), curves: self.png.is_some() };
        Memory::of_calibration(&size, &settings, self.jitter, backend.as_ref())?.check()?;
        let DataSet { train: scan, test, volume } = conefield_scans::read_data_set(&self.scan, Parts::ALL)?;
        scan.validate(&self.scan.display().to_string())?;
        signals::listen();
        let watch = Shown::new();
        let found = calibrate(&scan, &settings, backend.as_ref(), &watch)?;
        drop(watch);
        let watch = Shown::new();
        let directions = directions(&scan, backend.as_ref(), &watch)?;
        drop(watch);
        let mut corrected = scan;
        found.correct(&mut corrected, &self.scan.display().to_string());
        let jitter =
            self.jitter.then(|| jitter(&corrected, self.pixels.into(), backend.as_ref(), &Shown::new())).transpose()?;
        if let Some(jitter) = &jitter {
            jitter.correct(&mut corrected);
        }
        if let Some(png) = &self.png {
            draw(png, &found)?;
        }
        if let Some(output) = &self.output {
            if let Some(test) = test {
                let views = out::counted(test.geometry.views.len(), "test view");
                tracing::warn!("{}: left out: {views}, which this format cannot hold", output.display());
            }
            conefield_io::write_scan(output, &corrected, volume.as_ref())?;
        }
        let seconds = begin.elapsed().as_secs_f64();
        if self.json {
            let mut result = found.json(directions, jitter.as_ref());
            result["scan"] = json!(self.scan);
            result["output"] = json!(self.output);
            result["picture"] = json!(self.png);
            result["seconds"] = json!(seconds);
            return out::json(&result);
        }
        let advice = directions.and_then(|d| d.advice());
        let warning = advice.map_or(String::new(), |advice| format!("\n\nwarning: {advice}"));
        out::say(&(self.text(&found, jitter.as_ref(), seconds) + &warning))
    }

    /// The result as text.
    fn text(&self, found: &Calibration, jitter: Option<&Jitter>, seconds: f64) -> String {
        let heads = ["", "change", "uncertainty", "unit", "in pixels", ""].map(str::to_owned).to_vec();
        let rows: Vec<Vec<String>> = std::iter::once(heads).chain(found.found.iter().map(row)).collect();
        let [before, after] = found.held_out;
        let mut text = out::table(&rows, &[1, 2]);
        for (parameter, reason) in found.found.iter().filter_map(|f| Some((f.parameter, f.reason?))) {
            text += &format!("\n{parameter}: {reason}");
        }
        text += &format!(
            "\n\nheld-out error {before:.4}, {after:.4} with the corrections: root mean square over the largest line integral, {} \
             views predicted by pixels of {} x {}; {}",
            found.views,
            found.bin,
            found.bin,
            out::duration(seconds)
        );
        if let Some(jitter) = jitter {
            let ([v, u], [dv, du], [before, after]) = (jitter.pixels, jitter.uncertainty, jitter.held_out);
            text += &format!(
                "\nshifts of single views: root mean square {u:.2} ± {du:.2} pixels along u, {v:.2} ± {dv:.2} along v, {}; held-out \
                 error {before:.4}, {after:.4} with them",
                match jitter.verdict {
                    Verdict::Corrected => "corrected",
                    _ => "not clear: unchanged",
                }
            );
        }
        let mut verdicts = found.found.iter().map(|f| f.verdict).chain(jitter.map(|j| j.verdict));
        let any = verdicts.any(|v| v == Verdict::Corrected);
        if let Some(output) = &self.output {
            text += &match any {
                true => format!("\ncorrected scan: {}", output.display()),
                false => format!("\nnothing to correct; the unchanged scan: {}", output.display()),
            };
        }
        text
    }
}

/// A line of the table.
fn row(f: &Found) -> Vec<String> {
    let digits =
        |x: f64| if f.uncertainty > 0.0 && f.uncertainty < 0.01 { format!("{x:.4}") } else { format!("{x:.3}") };
    let [pixels, deviation] = f.pixels;
    let (change, uncertainty, pixels) = match f.verdict {
        Verdict::NotDetermined => ("-".into(), "-".into(), String::new()),
        _ => (digits(f.change), digits(f.uncertainty), format!("{pixels:.2} ± {deviation:.2}")),
    };
    let said = match f.verdict {
        Verdict::Corrected => "corrected",
        Verdict::Kept => "right: unchanged",
        Verdict::NotDetermined => "not determined by the views: unchanged",
    };
    vec![f.parameter.to_string(), change, uncertainty, f.unit.into(), pixels, said.into()]
}

/// The error along each parameter, side by side.
fn draw(path: &Path, found: &Calibration) -> Result<()> {
    let options = CurveOptions { size: [640, 480], ..CurveOptions::default() };
    let drawn: Vec<_> = found
        .found
        .iter()
        .map(|f| {
            let name = if f.parameter.by_pairs() { "difference of pairs of views" } else { "held-out error" };
            let lowest = f.curve.iter().map(|p| p.1).fold(f64::INFINITY, f64::min);
            let highest = f.curve.iter().map(|p| p.1).fold(0.0, f64::max);
            let mark = |x: f64| vec![(x, lowest), (x, highest)];
            let series = vec![
                (name.to_owned(), f.curve.clone()),
                ("found".to_owned(), mark(f.change)),
                ("as given".to_owned(), mark(0.0)),
            ];
            let title = match f.verdict {
                Verdict::NotDetermined => format!("{}: not determined", f.parameter),
                _ => format!("{}: {:.3} ± {:.3} {}", f.parameter, f.change, f.uncertainty, f.unit),
            };
            (title, [format!("change of {} ({})", f.parameter, f.unit), name.to_owned()], series)
        })
        .collect();
    let panels: Vec<Panel<'_>> = drawn
        .iter()
        .map(|(title, [x, y], series)| Panel { title, labels: [x, y], series, options: &options })
        .collect();
    panels_png(path, &panels)
}

/// Shows the progress of a calibration and handles interruptions.
pub struct Shown(Mutex<Progress>);

impl Shown {
    /// Starts the clock.
    pub fn new() -> Self {
        Self(Mutex::new(Progress::new("calibrate", None)))
    }
}

impl Watch for Shown {
    fn cancelled(&self) -> bool {
        signals::caught().is_some()
    }

    fn progress(&self, share: f64) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).reach(share);
    }
}

/// A warning: with this geometry the views contradict each other.
#[derive(Debug, Clone, Serialize)]
pub struct Suspicion {
    /// The kind, as for other warnings about a scan.
    kind: &'static str,
    /// The finding, with figures.
    found: String,
    /// The advice.
    advice: &'static str,
}

impl fmt::Display for Suspicion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.found, self.advice)
    }
}

/// Warns if a quick search finds an error in the geometry of `scan`. A scan that is too small for it gives no warning.
pub fn suspicion(scan: &Scan, backend: &dyn Backend) -> Result<Option<Suspicion>> {
    let found = match suspect(scan, backend, &Shown::new()) {
        Err(e @ Error::Aborted { .. }) => return Err(e),
        Err(_) => None,
        Ok(found) => found,
    };
    Ok(found.map(|found| {
        let off = found.found.iter().filter(|f| f.verdict == Verdict::Corrected);
        let words = off.map(|f| format!("{} by {:.3} {} ({:.1} pixels)", f.parameter, f.change, f.unit, f.pixels[0]));
        let [before, after] = found.held_out;
        Suspicion {
            kind: "geometry",
            found: format!(
                "the geometry is off: correcting the detector ({}) reduces the error of predicted held-out views from \
                 {before:.4} to {after:.4}",
                words.collect::<Vec<_>>().join(", ")
            ),
            advice: "conefield calibrate SCAN -o CORRECTED estimates the geometry and writes the corrected scan",
        }
    }))
}
