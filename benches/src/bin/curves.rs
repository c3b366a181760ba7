//! Draws PSNR against training time of finished runs, or their drift against epochs:
//! `curves [--drift] OUT.png TITLE NAME=RUN_FOLDER...`.

use conefield_benches::{metrics, quality};
use conefield_report::{CurveOptions, curves_png_with};
use serde_json::Value;
use std::error::Error;

type Curve = (String, Vec<(f64, f64)>);

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    let drift = arguments.first().is_some_and(|a| a == "--drift");
    arguments.drain(..usize::from(drift));
    let [out, title, runs @ ..] = &arguments[..] else {
        return Err("usage: curves [--drift] OUT.png TITLE NAME=RUN_FOLDER...".into());
    };
    let points = if drift { drifts } else { qualities };
    let curves: Vec<Curve> = runs.iter().map(|r| read(r, points)).collect::<Result<_, _>>()?;
    let (x, y) = if drift { ("epochs", "drift (mean L1)") } else { ("seconds of training", "PSNR, dB") };
    let options = CurveOptions { log_y: drift, ..CurveOptions::default() };
    curves_png_with(out, title, x, y, &curves, &options)?;
    Ok(())
}

fn read(run: &str, points: fn(&Value) -> Vec<(f64, f64)>) -> Result<Curve, Box<dyn Error>> {
    let (name, _, records) = metrics(run)?;
    Ok((name.to_string(), records.iter().flat_map(points).collect()))
}

/// PSNR against seconds, of a record that has one.
fn qualities(record: &Value) -> Vec<(f64, f64)> {
    quality(record).into_iter().collect()
}

/// Drift against epochs, as often as a record has it.
fn drifts(record: &Value) -> Vec<(f64, f64)> {
    let all = record["drift"].as_array().into_iter().flatten();
    all.filter_map(|d| d["epoch"].as_f64().zip(d["mean_l1"].as_f64())).collect()
}
