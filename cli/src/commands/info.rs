//! `conefield info`

use crate::{files, out};
use clap::Args;
use conefield_core::geometry::norm;
use conefield_core::{Error, Result};
use ndarray::ArrayView3;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Say what a scan, volume or weights file holds.
#[derive(Args)]
pub struct Info {
    /// A scan, a volume or a weights file.
    file: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl Info {
    pub fn run(self) -> Result<()> {
        let path = &self.file;
        std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
        let found = if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("safetensors")) {
            weights(path)?
        } else if conefield_io::is_volume(path) {
            volume(path)?
        } else {
            scan(path)?
        };
        if self.json { out::json(&found) } else { out::say(&lines(&found)) }
    }
}

fn statistics(values: ArrayView3<'_, f32>) -> Value {
    let (mut low, mut high, mut sum) = (f32::INFINITY, f32::NEG_INFINITY, 0.0);
    for &x in &values {
        (low, high) = (low.min(x), high.max(x));
        sum += f64::from(x);
    }
    json!({ "min": low, "max": high, "mean": sum / values.len() as f64 })
}

fn volume(path: &Path) -> Result<Value> {
    let v = conefield_io::read_volume(path)?;
    Ok(json!({
        "kind": "volume",
        "shape": v.grid.shape,
        "spacing_mm": v.grid.spacing,
        "values": statistics(v.data.view()),
        "affine": v.affine,
    }))
}

fn scan(path: &Path) -> Result<Value> {
    let s = files::scan(path)?;
    let g = &s.geometry;
    let first = &g.views[0];
    let truth = conefield_io::read_truth(path)?;
    Ok(json!({
        "kind": "scan",
        "views": g.views.len(),
        "detector": g.detector,
        "pixel_mm": [norm(first.v), norm(first.u)],
        "source_to_axis_mm": first.source[0].hypot(first.source[1]),
        "source_to_detector_mm": first.normal().1,
        "volume": { "shape": g.volume.shape, "spacing_mm": g.volume.spacing, "center_mm": g.volume.center },
        "unit": s.unit,
        "line_integrals": statistics(s.projections.view()),
        "truth": truth.is_some(),
        "provenance": s.provenance,
    }))
}

fn weights(path: &Path) -> Result<Value> {
    let w = files::read_weights(path)?;
    let tensors: serde_json::Map<String, Value> =
        w.tensors.iter().map(|(name, (shape, _))| (name.clone(), json!(shape))).collect();
    let parameters: usize = w.tensors.values().map(|t| t.1.len()).sum();
    Ok(json!({ "kind": "weights", "parameters": parameters, "tensors": tensors, "notes": w.notes }))
}

/// One line a key; tables become dotted keys.
pub fn lines(value: &Value) -> String {
    fn walk(prefix: &str, value: &Value, rows: &mut Vec<Vec<String>>) {
        match value {
            Value::Object(map) => {
                for (key, v) in map {
                    walk(&if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") }, v, rows);
                }
            }
            Value::Null => {}
            Value::String(text) if text.contains('\n') => {
                rows.push(vec![prefix.to_owned(), text.lines().next().unwrap_or_default().to_owned()]);
                rows.extend(text.lines().skip(1).map(|l| vec![String::new(), l.to_owned()]));
            }
            Value::String(text) => rows.push(vec![prefix.to_owned(), text.clone()]),
            _ => rows.push(vec![prefix.to_owned(), value.to_string().replace(',', ", ")]),
        }
    }
    let mut rows = vec![vec!["kind".to_owned(), value["kind"].as_str().unwrap_or_default().to_owned()]];
    let mut rest = value.clone();
    if let Value::Object(map) = &mut rest {
        map.remove("kind");
    }
    walk("", &rest, &mut rows);
    out::table(&rows, &[])
}
