//! Draws quality against the number of views and writes a table, from comparisons of `views.sh`:
//! `views OUT_FOLDER TITLE VIEWS=COMPARISON_FOLDER...`. Writes psnr.png, ssim.png and views.md.

use conefield_evaluation::report::{CurveOptions, curves_png};
use conefield_io::write_text_atomic;
use serde_json::Value;
use std::collections::BTreeMap;
use std::error::Error;
use std::fmt::Write;
use std::path::Path;

/// Scores as `table.json` names them, with the picture and the label of the axis.
const SCORES: [(&str, &str, &str); 2] = [("psnr", "psnr.png", "PSNR, dB"), ("ssim_2d", "ssim.png", "ssim_2d")];

/// PSNR and SSIM of each method, in the order in which methods came, by number of views.
#[derive(Default)]
struct Found {
    views: Vec<u32>,
    methods: Vec<String>,
    scores: BTreeMap<(usize, u32), [Option<f64>; 2]>,
}

impl Found {
    /// Adds a comparison.
    fn read(&mut self, comparison: &str) -> Result<(), Box<dyn Error>> {
        let (views, folder) = comparison.split_once('=').ok_or("a comparison is VIEWS=FOLDER")?;
        let views: u32 = views.parse()?;
        let table: Value = serde_json::from_str(&std::fs::read_to_string(Path::new(folder).join("table.json"))?)?;
        if !self.views.contains(&views) {
            self.views.push(views);
        }
        for method in table["methods"].as_array().ok_or("no methods in table.json")? {
            let name = method["name"].as_str().ok_or("a method without a name")?;
            let known = self.methods.iter().position(|m| m == name);
            let at = known.unwrap_or_else(|| {
                self.methods.push(name.into());
                self.methods.len() - 1
            });
            self.scores.insert((at, views), SCORES.map(|(key, ..)| method["scores"][key].as_f64()));
        }
        Ok(())
    }

    /// Curves of one score.
    fn curves(&self, score: usize) -> Vec<(String, Vec<(f64, f64)>)> {
        let points = |m: usize| {
            let at = |v: &u32| Some((f64::from(*v), self.scores.get(&(m, *v))?[score]?));
            self.views.iter().filter_map(at).collect()
        };
        self.methods.iter().enumerate().map(|(m, name)| (name.clone(), points(m))).collect()
    }

    /// A row a method, a column a number of views; `-` where a method failed.
    fn table(&self) -> Result<String, std::fmt::Error> {
        let mut out = String::from("PSNR in dB / ssim_2d\n\n| method |");
        self.views.iter().try_for_each(|v| write!(out, " {v} views |"))?;
        out += "\n| --- |";
        self.views.iter().for_each(|_| out += " ---: |");
        for (m, name) in self.methods.iter().enumerate() {
            write!(out, "\n| {name} |")?;
            for v in &self.views {
                match self.scores.get(&(m, *v)) {
                    Some([Some(psnr), Some(ssim)]) => write!(out, " {psnr:.2} / {ssim:.4} |")?,
                    _ => out += " - |",
                }
            }
        }
        Ok(out + "\n")
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [out, title, comparisons @ ..] = &arguments[..] else {
        return Err("usage: views OUT_FOLDER TITLE VIEWS=COMPARISON_FOLDER...".into());
    };
    let mut found = Found::default();
    comparisons.iter().try_for_each(|c| found.read(c))?;
    found.views.sort_unstable();
    for (i, (_, picture, label)) in SCORES.into_iter().enumerate() {
        let options = CurveOptions::default();
        curves_png(Path::new(out).join(picture), title, ["views", label], &found.curves(i), &options)?;
    }
    write_text_atomic(Path::new(out).join("views.md"), &found.table()?)?;
    Ok(())
}
