//! Draws PSNR against training time of finished runs: `curves OUT.png TITLE NAME=RUN_FOLDER...`.

use conefield_io::curves_png;
use std::error::Error;
use std::path::Path;

type Curve = (String, Vec<(f64, f64)>);

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [out, title, runs @ ..] = &arguments[..] else {
        return Err("usage: curves OUT.png TITLE NAME=RUN_FOLDER...".into());
    };
    let curves: Vec<Curve> = runs.iter().map(|r| read(r)).collect::<Result<_, _>>()?;
    curves_png(out, title, "seconds of training", "PSNR, dB", &curves)?;
    Ok(())
}

fn read(run: &str) -> Result<Curve, Box<dyn Error>> {
    let (name, folder) = run.split_once('=').ok_or("a run is NAME=FOLDER")?;
    let text = std::fs::read_to_string(Path::new(folder).join("metrics.jsonl"))?;
    let mut points = vec![];
    for line in text.lines() {
        let record: serde_json::Value = serde_json::from_str(line)?;
        if let (Some(t), Some(psnr)) = (record["seconds"].as_f64(), record["psnr"].as_f64()) {
            points.push((t, psnr));
        }
    }
    Ok((name.to_string(), points))
}
