//! A table of finished runs, and of each after how many seconds it was where the first one ended:
//! `reach NAME=RUN_FOLDER...`.

use conefield_benches::{metrics, quality};
use serde_json::Value;
use std::error::Error;

struct Run {
    name: String,
    record: Value,
    /// Seconds of training and PSNR.
    curve: Vec<(f64, f64)>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let runs: Vec<Run> = std::env::args().skip(1).map(|r| read(&r)).collect::<Result<_, _>>()?;
    let first = runs.first().and_then(|r| r.curve.last()).ok_or("usage: reach NAME=RUN_FOLDER...")?;
    let mark = first.1;
    println!("| run | PSNR dB | ssim_2d | steps | parameters | peak memory | seconds to {mark:.2} dB |");
    println!("| --- | ---: | ---: | ---: | ---: | ---: | ---: |");
    for Run { name, record, curve } in &runs {
        let number = |value: &Value, scale: f64, digits: usize| {
            value.as_f64().map_or("-".into(), |x| format!("{:.digits$}", x * scale))
        };
        println!(
            "| {name} | {} | {} | {} | {} M | {} MiB | {} |",
            number(&record["scores"]["psnr"], 1.0, 2),
            number(&record["scores"]["ssim_2d"], 1.0, 3),
            record["steps"],
            number(&record["parameters"], 1e-6, 1),
            number(&record["peak_bytes"], 1.0 / f64::from(1 << 20), 0),
            reached(curve, mark).map_or("not reached".into(), |s| format!("{s:.0}")),
        );
    }
    Ok(())
}

fn read(run: &str) -> Result<Run, Box<dyn Error>> {
    let (name, folder, records) = metrics(run)?;
    let record = serde_json::from_str(&std::fs::read_to_string(folder.join("record.json"))?)?;
    Ok(Run { name: name.into(), record, curve: records.iter().filter_map(quality).collect() })
}

/// When a curve first comes to `mark`, straight between its points.
fn reached(curve: &[(f64, f64)], mark: f64) -> Option<f64> {
    let mut before = (0.0, f64::NEG_INFINITY);
    for &(t, psnr) in curve {
        if psnr >= mark {
            let rise = psnr - before.1;
            return Some(if rise.is_finite() { before.0 + (t - before.0) * (mark - before.1) / rise } else { t });
        }
        before = (t, psnr);
    }
    None
}
