//! `conefield info`

use super::calibrate;
use crate::boundary::{self, Inputs};
use crate::out;
use crate::run_folder::{self, RunOnDisk};
use clap::Args;
use conefield::files;
use conefield::memory::Memory;
use conefield_backend_cpu::Cpu;
use conefield_core::error::ensure;
use conefield_core::finite::range;
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::scan::{Scan, Volume};
use conefield_core::{Error, Result};
use conefield_evaluation::report::MiddleSlices;
use conefield_evaluation::report::survey_png;
use conefield_scans::counts::CountsReport;
use conefield_scans::diagnosis::{Survey, setup, survey};
use ndarray::ArrayView3;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Describe a scan, volume, run or weights file.
///
/// For a scan: lengths in mm, magnification, supported voxel size, field of view, coverage of the volume, missing
/// information, and warnings about problems for a reconstruction. SCANNER.toml and RTK's XML geometry work too. For the
/// folder of a run: method, progress and scores.
#[derive(Args)]
pub struct InfoArgs {
    /// A scan, a volume, the folder of a run or a weights file.
    file: PathBuf,
    /// Also draw source path, detector, volume and the share of views that see each point; for a volume, its middle
    /// slices.
    #[arg(long, value_name = "FILE")]
    png: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl InfoArgs {
    pub fn run(self) -> Result<()> {
        let path = &self.file;
        std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
        let png = self.png.as_deref();
        boundary::picture(png, &Inputs::of([path]))?;
        let ends = |end: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(end));
        let mut head = String::new();
        let other: Option<fn(&Path) -> Result<Value>> = if ends("safetensors") {
            Some(weights)
        } else if ends("xml") && conefield_io::scan_size(path).is_err() {
            Some(geometry)
        } else {
            RunOnDisk::is(path).then_some(run)
        };
        let found = if let Some(describe) = other {
            let expected = "a scan or a volume";
            ensure(png.is_none(), &path.display().to_string(), "--png", "a file of another kind", expected)?;
            describe(path)?
        } else if conefield_io::is_volume(path) {
            volume(path, png)?
        } else {
            let (found, lines) = scan(path, png)?;
            head = lines + "\n\n";
            found
        };
        if self.json {
            return out::json(&found);
        }
        out::say(&(head + &lines(&found) + &warnings(&found)))
    }
}

/// Method, progress and content of a run's folder.
fn run(path: &Path) -> Result<Value> {
    let files: Vec<&str> = run_folder::FILES.into_iter().filter(|f| path.join(f).exists()).collect();
    let run = RunOnDisk::read(path)?;
    let mut found = json!({ "kind": "run", "status": run.status(), "files": files });
    if let Some(record) = &run.record {
        let mut record = record.clone();
        // Programs read the record from its own file.
        if let Some(map) = record.as_object_mut() {
            ["memory", "backend", "plan"].iter().for_each(|key| drop(map.remove(*key)));
        }
        found["record"] = record;
    } else if let Some(last) = run.curves.last() {
        found["last_record"] = last.clone();
    }
    found["spec"] = json!(run.spec);
    Ok(found)
}

/// The warnings as text, one paragraph each.
pub fn warnings(value: &Value) -> String {
    let one = |w: &Value| {
        let advice = w["advice"].as_str().filter(|a| !a.is_empty()).map_or(String::new(), |a| format!("\n  {a}"));
        Some(format!("\n\nwarning: {}{advice}", w["found"].as_str()?))
    };
    value["warnings"].as_array().into_iter().flatten().filter_map(one).collect()
}

fn statistics(values: ArrayView3<'_, f32>) -> Value {
    let (mut low, mut high, mut sum) = (f32::INFINITY, f32::NEG_INFINITY, 0.0);
    for &x in &values {
        (low, high) = (low.min(x), high.max(x));
        sum += f64::from(x);
    }
    json!({ "min": low, "max": high, "mean": sum / values.len() as f64 })
}

fn volume(path: &Path, png: Option<&Path>) -> Result<Value> {
    Memory::of_volumes(&[conefield_io::volume_voxels(path)?]).check()?;
    let v = conefield_io::read_volume(path)?;
    if let Some(png) = png {
        files::picture(png, None, &MiddleSlices::of(&v))?;
    }
    let mut missing = Vec::new();
    if v.affine.is_none() {
        missing.push("voxel size and position: 1 mm and the centre are assumed");
    }
    Ok(json!({
        "kind": "volume",
        "shape": v.grid.shape,
        "spacing_mm": v.grid.spacing,
        "size_mm": v.grid.size(),
        "values": statistics(v.data.view()),
        "affine": v.affine,
        "missing": missing,
        "warnings": volume_warnings(path, &v),
    }))
}

/// Hints that the values are not attenuation, and that images may be views instead of slices.
fn volume_warnings(path: &Path, v: &Volume) -> Vec<Value> {
    let [low, high] = range(&v.data);
    let advice = "simulate, pretrain and convert take --values hu:MU_WATER or clip:LO,HI for them";
    let hounsfield = low <= -500.0 && high > 0.0;
    let found = format!("values from {low} to {high} look like Hounsfield units, not attenuation");
    let values = hounsfield.then(|| json!({ "kind": "values", "found": found, "advice": advice }));
    let found = "a folder of images without voxel sizes is read as the slices of a volume";
    let advice = "if they are the views of a scan, describe them in a scanner.toml (docs/guide/scan-in.md) and use `conefield import`";
    let views =
        (path.is_dir() && v.affine.is_none()).then(|| json!({ "kind": "views", "found": found, "advice": advice }));
    values.into_iter().chain(views).collect()
}

/// Geometry in mm, values and warnings of a scan.
pub fn facts(s: &Scan, survey: &Survey) -> Value {
    let g = &s.geometry;
    let (mut found, rest) = (json!(survey.setup), json!(survey));
    for key in ["coverage", "truncation", "outside", "attenuation_per_mm", "warnings"] {
        found[key] = rest[key].clone();
    }
    found["kind"] = json!("scan");
    found["views"] = json!(g.views.len());
    found["detector"] = json!(g.detector);
    found["supported_voxel_is"] = json!("pixel / magnification at the isocentre (u for x and y, v for z)");
    found["volume"] = json!({
        "shape": g.volume.shape, "spacing_mm": g.volume.spacing, "size_mm": g.volume.size(),
        "center_mm": g.volume.center,
    });
    found["unit"] = json!(s.unit);
    found
}

/// Views, distances, arc and values of a scan, a line each, as names and texts. `counts` are those it was made from.
pub fn in_short(scan: &Scan, survey: &Survey, counts: Option<&CountsReport>) -> Vec<Vec<String>> {
    let g = &scan.geometry;
    let (setup, arc, check) = (&survey.setup, &survey.setup.angles, &survey.check);
    let [rows, columns] = g.detector;
    // A parallel beam has the pixels that its files name where the axis is.
    let [across, _, along] = setup.supported_voxel_mm;
    let [height, width] = if g.is_parallel(0) { [along, across] } else { setup.pixel_mm }.map(short);
    let orbit = if setup.circle { "" } else { " (medians: the views are not on one circle)" };
    let values = format!("line integrals from {} to {}", short(check.range[0].into()), short(check.range[1].into()));
    let counts = match counts {
        None => String::new(),
        Some(c) => format!(
            "; open beam {}, {} % of the counts raised to {}, {} of {} pixels interpolated",
            short(c.open_beam[1]),
            short(100.0 * c.clamped),
            short(c.floor),
            c.bad_by_fields + c.bad_by_outliers,
            rows * columns,
        ),
    };
    let lines = [
        (
            "views",
            format!("{} of {rows} x {columns} pixels (rows x columns), {height} x {width} mm each", g.views.len()),
        ),
        (
            "source",
            if g.is_parallel(0) {
                format!("none: a parallel beam{orbit}")
            } else {
                format!(
                    "{} mm to the axis, {} mm to the detector, magnification {}{orbit}",
                    short(setup.source_to_axis_mm),
                    short(setup.source_to_detector_mm),
                    short(setup.magnification),
                )
            },
        ),
        (
            "arc",
            format!(
                "{} degrees from {} in steps of {}",
                short(arc.covered_deg),
                short(arc.first_deg),
                short(arc.step_deg)
            ),
        ),
        ("values", values + &counts),
    ];
    lines.map(|(name, line)| vec![name.to_owned(), line]).into()
}

/// Facts of a scan, and the most important ones in short.
fn scan(path: &Path, png: Option<&Path>) -> Result<(Value, String)> {
    Memory::of_data_set(&conefield_io::scan_size(path)?).check()?;
    let data = conefield_scans::read_data_set(path, conefield_io::Parts::ALL)?;
    let s = &data.train;
    s.validate(&path.display().to_string())?;
    let survey = survey(s);
    if let Some(png) = png {
        survey_png(png, &title(path, s, &survey), &s.geometry)?;
    }
    let mut short = in_short(s, &survey, None);
    let volume = s.geometry.volume;
    let [[nx, ny, nz], [x, y, z]] = [volume.shape.map(|n| n.to_string()), volume.spacing.map(self::short)];
    short.push(vec!["volume".into(), format!("{nx} x {ny} x {nz} voxels of {x} x {y} x {z} mm")]);
    let mut found = facts(s, &survey);
    if let (Some(warning), Some(all)) = (calibrate::suspicion(s, &Cpu::new())?, found["warnings"].as_array_mut()) {
        all.push(json!(warning));
    }
    let mut missing = Vec::new();
    if s.unit.mm == 1.0 && s.provenance["unit_from"].as_str().is_some_and(|f| f.starts_with("nothing")) {
        missing.push("a unit of length: mm is assumed");
    }
    if data.volume.is_none() {
        missing.push("a volume to compare with (truth)");
    }
    if data.test.is_none() {
        missing.push("test views (reconstruct --hold-out sets some aside)");
    }
    found["line_integrals"] = statistics(s.projections.view());
    found["test_views"] = json!(data.test.as_ref().map_or(0, |t| t.geometry.views.len()));
    found["truth"] = json!(data.volume.is_some());
    found["missing"] = json!(missing);
    found["provenance"] = s.provenance.clone();
    Ok((found, out::table(&short, &[])))
}

/// The title of the picture.
fn title(path: &Path, s: &Scan, survey: &Survey) -> String {
    let name = path.canonicalize().ok().and_then(|p| p.file_name().map(|n| n.to_string_lossy().into_owned()));
    let setup = &survey.setup;
    let g = &s.geometry;
    format!(
        "{}: {}, detector {} x {}, {}; {:.1} % of the volume covered",
        name.unwrap_or_default(),
        out::counted(g.views.len(), "view"),
        g.detector[0],
        g.detector[1],
        if g.is_parallel(0) {
            "a parallel beam".into()
        } else {
            format!(
                "source to axis {:.1} mm, to detector {:.1} mm",
                setup.source_to_axis_mm, setup.source_to_detector_mm
            )
        },
        100.0 * survey.coverage.complete,
    )
}

/// RTK's geometry file has no pixels, projections or volume.
fn geometry(path: &Path) -> Result<Value> {
    let views = conefield_io::read_rtk_geometry(path, [1.0; 2], [0.0; 2])?;
    let count = views.len();
    let volume = VoxelGrid { shape: [1; 3], spacing: [1.0; 3], center: [0.0; 3] };
    let setup = setup(&Geometry { detector: [1; 2], views, volume });
    Ok(json!({
        "kind": "geometry",
        "views": count,
        "source_to_axis_mm": setup.source_to_axis_mm,
        "source_to_detector_mm": setup.source_to_detector_mm,
        "magnification": setup.magnification,
        "offset_mm": setup.offset_mm,
        "angles": setup.angles,
        "missing": [
            "pixels and projections: RTK keeps them in an image", "a volume",
            "conefield import takes the three together (docs/guide/formats.md, [rtk])",
        ],
    }))
}

fn weights(path: &Path) -> Result<Value> {
    let w = files::read_weights(path)?;
    let tensors: serde_json::Map<String, Value> =
        w.tensors.iter().map(|(name, (shape, _))| (name.clone(), json!(shape))).collect();
    let parameters: usize = w.tensors.values().map(|t| t.1.len()).sum();
    Ok(json!({ "kind": "weights", "parameters": parameters, "tensors": tensors, "notes": w.notes }))
}

/// `x` with at most six significant digits and nine decimals.
fn short(x: f64) -> String {
    let digits = if x == 0.0 { 0 } else { (5 - x.abs().log10().floor() as i32).clamp(0, 9) };
    let text = format!("{x:.*}", digits as usize);
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

/// Numbers with seven significant digits.
fn rounded(value: &Value) -> Value {
    match value {
        Value::Array(all) => all.iter().map(rounded).collect(),
        Value::Number(n) => match n.as_f64().filter(|_| n.is_f64()) {
            Some(x) => format!("{x:.6e}").parse::<f64>().map_or(value.clone(), |x| json!(x)),
            None => value.clone(),
        },
        other => other.clone(),
    }
}

/// A line of readable length: longer text is cut.
fn shown(text: &str) -> String {
    let length = text.chars().count();
    if length <= LONG {
        return text.to_owned();
    }
    let begin: String = text.chars().take(LONG).collect();
    format!("{begin}… ({length} characters, with --json all of them)")
}

/// Maximum number of characters of such a line.
const LONG: usize = 400;

/// One line per key; tables become dotted keys. [`warnings`] prints the warnings.
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
            Value::String(text) => rows.push(vec![prefix.to_owned(), shown(text)]),
            Value::Array(all) if !all.is_empty() && all.iter().all(Value::is_string) => {
                let texts = all.iter().filter_map(Value::as_str).enumerate();
                rows.extend(texts.map(|(i, t)| vec![if i == 0 { prefix } else { "" }.to_owned(), t.to_owned()]));
            }
            Value::Array(all) if all.is_empty() => {}
            _ => rows.push(vec![prefix.to_owned(), rounded(value).to_string().replace(',', ", ")]),
        }
    }
    let mut rows = vec![vec!["kind".to_owned(), value["kind"].as_str().unwrap_or_default().to_owned()]];
    let mut rest = value.clone();
    if let Value::Object(map) = &mut rest {
        map.remove("kind");
        // They are printed as sentences.
        map.remove("warnings");
    }
    walk("", &rest, &mut rows);
    out::table(&rows, &[])
}
