//! Pictures of results: middle slices side by side, and PSNR curves.

use crate::memory::Memory;
use crate::study::spread::Spread;
use crate::tradeoff::json::read_json;
use conefield_core::Result;
use conefield_evaluation::report::{CurveOptions, MiddleSlices, Panel, compare_png, panels_png, slices_png};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// A method's run in a picture.
pub struct Shown {
    /// The method's name.
    pub name: String,
    /// PSNR against the reference, if there is one.
    pub psnr: Option<f64>,
    /// The run's folder.
    pub run: PathBuf,
}

/// Draws the middle slices of results side by side, with their differences from the reference if there is one, in grey
/// over `window` or by default the range of the reference. Returns false if there is nothing to draw; an earlier
/// picture is then removed.
pub fn slices(
    path: &Path,
    reference: Option<&MiddleSlices>,
    shown: &[Shown],
    window: Option<[f32; 2]>,
) -> Result<bool> {
    let mut panels = vec![];
    for method in shown {
        let volume = method.run.join("volume.nii.gz");
        Memory::of_volumes(&[conefield_io::volume_voxels(&volume)?]).check()?;
        let caption = match method.psnr {
            Some(psnr) => format!("{} {psnr:.2} dB", method.name),
            None => method.name.clone(),
        };
        panels.push((caption, MiddleSlices::of(&conefield_io::read_volume(&volume)?)));
    }
    let panels: Vec<(&str, &MiddleSlices)> = panels.iter().map(|(c, s)| (&c[..], s)).collect();
    match (reference, panels.first()) {
        (_, None) => {
            // A picture of earlier results would not match.
            let _ = std::fs::remove_file(path);
            return Ok(false);
        }
        (Some(r), _) => compare_png(path, ("reference", r), &panels, window.unwrap_or_else(|| r.window()))?,
        (None, Some((_, first))) => slices_png(path, &panels, window.unwrap_or_else(|| first.window()))?,
    }
    Ok(true)
}

/// Points of a curve, by ascending x.
type Curve = Vec<(f64, f64)>;

/// Draws the PSNR of methods over steps and over training time: the mean over each method's runs, with the standard
/// deviation as a band if there are several. Returns false if no run has recorded PSNR.
pub fn curves(path: &Path, title: &str, methods: &[(String, Vec<PathBuf>)]) -> Result<bool> {
    let records: Vec<(&str, Vec<Vec<Value>>)> =
        methods.iter().map(|(name, runs)| (&name[..], runs.iter().map(|r| records(r)).collect())).collect();
    let panel = |key: &str| {
        let mut series = vec![];
        let mut options = CurveOptions { log_x: true, x_margin: 0.02, size: [1000, 750], ..CurveOptions::default() };
        for (name, runs) in &records {
            let curves: Vec<Curve> = runs.iter().map(|r| curve(r, key)).filter(|c| !c.is_empty()).collect();
            let means = means(&curves);
            series.push((name.to_string(), means.iter().map(|(x, y)| (*x, y.mean)).collect::<Curve>()));
            let band = means.iter().filter_map(|(x, y)| y.sd.map(|sd| (*x, [y.mean - sd, y.mean + sd])));
            options.bands.push((name.to_string(), band.collect()));
        }
        series.retain(|(_, points)| !points.is_empty());
        (series, options)
    };
    let [steps, seconds] = ["step", "seconds"].map(panel);
    if steps.0.is_empty() || seconds.0.is_empty() {
        let _ = std::fs::remove_file(path);
        return Ok(false);
    }
    let both = [("steps or passes", &steps), ("solve time, s", &seconds)];
    panels_png(path, &both.map(|(x, (series, options))| Panel { title, labels: [x, "PSNR, dB"], series, options }))?;
    Ok(true)
}

/// The lines of a run's metrics. Skips a line that a killed run left unfinished.
fn records(run: &Path) -> Vec<Value> {
    let text = std::fs::read(run.join("metrics.jsonl")).unwrap_or_default();
    let mut records: Vec<Value> =
        String::from_utf8_lossy(&text).lines().filter_map(|l| serde_json::from_str(l).ok()).collect();
    if let Ok(record) = read_json::<Value>(&run.join("record.json")) {
        score_last(&mut records, &record);
    }
    records
}

/// Gives the line of the result in a run's metrics the PSNR of the run's `record`. Lines during the run count one voxel
/// in 64, the record all of them.
pub fn score_last(records: &mut [Value], record: &Value) {
    let step = record["best_step"].as_u64().or(record["steps"].as_u64());
    let result = records.iter_mut().rev().find(|r| r["step"].as_u64() == step);
    if let (Some(result), Some(psnr)) = (result, record["scores"]["psnr"].as_f64()) {
        result["psnr"] = psnr.into();
    }
}

/// PSNR over `key`, where both are above the start of a logarithmic axis.
fn curve(records: &[Value], key: &str) -> Curve {
    let point = |r: &Value| Some((r[key].as_f64().filter(|x| *x > 0.0)?, r["psnr"].as_f64()?));
    records.iter().filter_map(point).collect()
}

/// The mean of the curves at every x of any curve within their common range; if there is none, the mean of their last
/// points.
fn means(curves: &[Curve]) -> Vec<(f64, Spread)> {
    let ends = |c: &Curve| Some((c.first()?.0, c.last()?.0));
    let ends: Vec<(f64, f64)> = curves.iter().filter_map(ends).collect();
    let (low, high) = ends.iter().fold((0.0, f64::INFINITY), |(l, h), e| (e.0.max(l), e.1.min(h)));
    let mut xs: Vec<f64> = curves.iter().flatten().map(|p| p.0).filter(|x| (low..=high).contains(x)).collect();
    xs.sort_unstable_by(f64::total_cmp);
    xs.dedup();
    let at = |x: f64| Spread::of(&curves.iter().map(|c| height(c, x)).collect::<Vec<_>>()).map(|y| (x, y));
    if !xs.is_empty() {
        return xs.into_iter().filter_map(at).collect();
    }
    let last: Vec<(f64, f64)> = curves.iter().filter_map(|c| c.last()).copied().collect();
    let of = |part: fn(&(f64, f64)) -> f64| Spread::of(&last.iter().map(part).collect::<Vec<_>>());
    of(|p| p.0).zip(of(|p| p.1)).map(|(x, y)| (x.mean, y)).into_iter().collect()
}

/// The value of a curve at `x`, by linear interpolation.
fn height(curve: &Curve, x: f64) -> f64 {
    let after = curve.partition_point(|p| p.0 < x).clamp(1, curve.len().max(2) - 1);
    let (a, b) = (curve[after - 1], curve.get(after).copied().unwrap_or(curve[after - 1]));
    if b.0 > a.0 { a.1 + (b.1 - a.1) * ((x - a.0) / (b.0 - a.0)).clamp(0.0, 1.0) } else { b.1 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_last_point_is_the_score_of_the_whole_volume() {
        let line = |step: u64, psnr: f64| json!({ "step": step, "psnr": psnr });
        let scored = |record: Value| {
            let mut lines = vec![line(10, 20.0), line(20, 25.0)];
            score_last(&mut lines, &record);
            lines.iter().map(|l| l["psnr"].as_f64().unwrap()).collect::<Vec<_>>()
        };
        assert_eq!(scored(json!({ "steps": 20, "scores": { "psnr": 26.0 } })), [20.0, 26.0]);
        assert_eq!(scored(json!({ "steps": 20, "best_step": 10, "scores": { "psnr": 26.0 } })), [26.0, 25.0]);
        assert_eq!(scored(json!({ "steps": 20, "scores": null })), [20.0, 25.0]);
    }

    #[test]
    fn curves_are_averaged_where_all_of_them_are() {
        let [a, b] = [vec![(1.0, 10.0), (3.0, 30.0)], vec![(2.0, 24.0), (4.0, 28.0)]];
        let all = means(&[a.clone(), b]);
        let shown: Vec<(f64, f64)> = all.iter().map(|(x, y)| (*x, y.mean)).collect();
        assert_eq!(shown, [(2.0, 22.0), (3.0, 28.0)]);
        assert!((all[0].1.sd.unwrap() - 8f64.sqrt()).abs() < 1e-12);
        assert_eq!(means(std::slice::from_ref(&a)).iter().map(|(x, y)| (*x, y.mean)).collect::<Vec<_>>(), a);
        // One point each, at different times.
        let points = means(&[vec![(1.0, 10.0)], vec![(3.0, 20.0)]]);
        assert_eq!((points.len(), points[0].0, points[0].1.mean), (1, 2.0, 15.0));
        assert!(means(&[]).is_empty());
        assert_eq!(height(&vec![(1.0, 10.0)], 1.0), 10.0);
    }
}
