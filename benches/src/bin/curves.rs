//! Draws PSNR of finished runs against training time or steps, or their drift against epochs:
//! `curves [--steps | --drift] OUT.png TITLE NAME=RUN_FOLDER...`. Runs of one name have one colour.

use conefield_benches::{metrics, quality};
use conefield_evaluation::report::{CurveOptions, curves_png};
use serde_json::Value;
use std::error::Error;

type Curve = (String, Vec<(f64, f64)>);
/// The points that a record of the metrics gives.
type Points = fn(&Value) -> Vec<(f64, f64)>;

const USAGE: &str = "usage: curves [--steps | --drift] OUT.png TITLE NAME=RUN_FOLDER...";

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    let option = arguments.first().filter(|a| a.starts_with("--")).cloned();
    arguments.drain(..usize::from(option.is_some()));
    let [out, title, runs @ ..] = &arguments[..] else { return Err(USAGE.into()) };
    let (points, x, y): (Points, _, _) = match option.as_deref() {
        None => (|r| quality(r).into_iter().collect(), "seconds of training", "PSNR, dB"),
        Some("--steps") => (|r| r["step"].as_f64().zip(r["psnr"].as_f64()).into_iter().collect(), "steps", "PSNR, dB"),
        Some("--drift") => (drifts, "epochs", "drift (mean L1)"),
        Some(_) => return Err(USAGE.into()),
    };
    let curves: Vec<Curve> = runs.iter().map(|r| read(r, points)).collect::<Result<_, _>>()?;
    let options = CurveOptions { log_y: option.as_deref() == Some("--drift"), ..CurveOptions::default() };
    curves_png(out, title, [x, y], &curves, &options)?;
    Ok(())
}

fn read(run: &str, points: Points) -> Result<Curve, Box<dyn Error>> {
    let (name, _, records) = metrics(run)?;
    Ok((name.to_string(), records.iter().flat_map(points).collect()))
}

/// Drift against epochs, as often as a record has it.
fn drifts(record: &Value) -> Vec<(f64, f64)> {
    let all = record["drift"].as_array().into_iter().flatten();
    all.filter_map(|d| d["epoch"].as_f64().zip(d["mean_l1"].as_f64())).collect()
}
