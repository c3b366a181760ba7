//! conefield's own scan format: a folder with `scan.toml` (or `scan.json`), `projections.npy` and optionally
//! `truth.nii.gz`.
//!
//! ```toml
//! format = "conefield-scan"
//! version = 1
//! projections = "projections.npy"   # f32 or any real type, [view, row, column], line integrals
//! truth = "truth.nii.gz"            # optional: the volume it was simulated from, in 1/unit
//! unit = { name = "mm", mm = 1.0 }  # the data set's own unit; every length below is in mm all the same
//! detector = { rows = 512, columns = 512 }
//! volume = { shape = [256, 256, 256], spacing = [1.0, 1.0, 1.0], center = [0.0, 0.0, 0.0] }
//!
//! [orbit]                           # a circle about z, or [[views]] with source, detector, u, v
//! dso = 1000.0
//! dsd = 1500.0
//! pixel = [1.0, 1.0]                # along v, u
//! offset = [0.0, 0.0]               # along v, u
//! start = 0.0                       # radians; or angles = [...]
//! range = 6.283185307179586         # view i stands at start + range·i/count
//! count = 50
//!
//! [provenance]                      # anything
//! ```

use crate::folder::{self, folder_of};
use crate::scanner::MOST_VIEWS;
use crate::size::product;
use crate::text::described;
use crate::{ScanSize, npy, read_volume, write_atomic, write_folder_atomic, write_text_atomic, write_volume};
use conefield_core::error::ensure;
use conefield_core::geometry::{Geometry, View, VoxelGrid};
use conefield_core::orbit::CircularOrbit;
use conefield_core::scan::{Scan, Unit, Volume};
use conefield_core::{Error, Result};
use ndarray::Ix3;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

pub(crate) const FORMAT: &str = "conefield-scan";
const VERSION: u32 = 1;
const PROJECTIONS: &str = "projections.npy";
const TRUTH: &str = "truth.nii.gz";

/// TOML leaves out what is `None`.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    format: String,
    version: u32,
    projections: String,
    truth: Option<String>,
    #[serde(default)]
    unit: Unit,
    detector: Detector,
    volume: VoxelGrid,
    orbit: Option<OrbitTable>,
    views: Option<Vec<View>>,
    provenance: Option<serde_json::Map<String, serde_json::Value>>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Detector {
    rows: usize,
    columns: usize,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OrbitTable {
    dso: f64,
    dsd: f64,
    pixel: [f64; 2],
    #[serde(default)]
    offset: [f64; 2],
    angles: Option<Vec<f64>>,
    start: Option<f64>,
    range: Option<f64>,
    count: Option<usize>,
}

fn describe(file: &Path) -> Result<Description> {
    described(file, FORMAT, VERSION)
}

/// The unit of the scan described by `file`.
pub(crate) fn unit(file: &Path) -> Result<Unit> {
    describe(file).map(|d| d.unit)
}

fn views(place: &str, d: &mut Description) -> Result<Vec<View>> {
    let table = match (d.orbit.take(), d.views.take()) {
        (Some(o), None) => o,
        (None, Some(v)) => return Ok(v),
        (Some(_), Some(_)) => {
            return Err(Error::invalid(place, "orbit", "both [orbit] and [[views]]", "one of them"));
        }
        (None, None) => return Err(Error::invalid(place, "orbit", "nothing", "[orbit] or [[views]]")),
    };
    for (field, x) in [
        ("orbit.dso", table.dso),
        ("orbit.dsd", table.dsd),
        ("orbit.pixel[0]", table.pixel[0]),
        ("orbit.pixel[1]", table.pixel[1]),
    ] {
        ensure(x.is_finite() && x > 0.0, place, field, x, "a positive finite length in mm")?;
    }
    let angles = match (table.angles, table.start, table.range, table.count) {
        (Some(a), None, None, None) => a,
        (None, start, Some(range), Some(count)) => {
            ensure((1..=MOST_VIEWS).contains(&count), place, "orbit.count", count, format!("1 to {MOST_VIEWS}"))?;
            let start = start.unwrap_or(0.0);
            (0..count).map(|i| start + range * i as f64 / count as f64).collect()
        }
        (Some(_), ..) => {
            let found = "angles beside start, range or count";
            return Err(Error::invalid(place, "orbit.angles", found, "one way to say the angles"));
        }
        _ => {
            let expected = "angles = [...], or range and count (and start), in radians";
            return Err(Error::invalid(place, "orbit.angles", "no angles", expected));
        }
    };
    if let Some((i, a)) = angles.iter().enumerate().find(|(_, a)| !a.is_finite()) {
        return Err(Error::invalid(place, format!("orbit.angles[{i}]"), a, "a finite angle in radians"));
    }
    let orbit = CircularOrbit { dso: table.dso, dsd: table.dsd, pixel: table.pixel, offset: table.offset, angles };
    Ok(orbit.views())
}

/// Reads the scan that `file` (a `scan.toml` or `scan.json`) describes.
pub(crate) fn read(file: &Path) -> Result<Scan> {
    let place = file.display().to_string();
    let mut d = describe(file)?;
    let geometry =
        Geometry { detector: [d.detector.rows, d.detector.columns], views: views(&place, &mut d)?, volume: d.volume };
    geometry.validate(&place)?;
    let path = folder::plain(folder_of(file), &place, "projections", &d.projections)?;
    let projections = npy::read(&path, &["view", "row", "column"])?;
    let want = [geometry.views.len(), geometry.detector[0], geometry.detector[1]];
    let found = format!("{:?}", projections.shape());
    let expected = format!("{want:?} (views, rows, columns), as {place} says");
    ensure(projections.shape() == want, &path.display().to_string(), "shape", found, expected)?;
    let projections = projections
        .into_dimensionality::<Ix3>()
        .map_err(|e| Error::invalid(path.display().to_string(), "shape", e, "three axes"))?;
    let provenance = d.provenance.map_or(serde_json::Value::Null, |m| plain_dates(serde_json::Value::Object(m)));
    let scan = Scan { geometry, projections, unit: d.unit, provenance };
    scan.validate(&place)?;
    Ok(scan)
}

/// The size of the scan that `file` describes.
pub(crate) fn size(file: &Path) -> Result<ScanSize> {
    let place = file.display().to_string();
    let mut d = describe(file)?;
    d.volume.validate(&place)?;
    let views = views(&place, &mut d)?.len();
    let pixels = product([views, d.detector.rows, d.detector.columns]);
    Ok(ScanSize { pixels, voxels: d.volume.len().unwrap_or(0) as u64, test_pixels: 0, reading: 0, views })
}

/// The file with the true volume, if the description in `file` names one.
pub(crate) fn truth_file(file: &Path) -> Result<Option<PathBuf>> {
    let (place, d) = (file.display().to_string(), describe(file)?);
    d.truth.map(|name| folder::plain(folder_of(file), &place, "truth", &name)).transpose()
}

/// Reads the volume from which the scan of `file` was simulated.
pub(crate) fn read_truth(file: &Path) -> Result<Option<Volume>> {
    let place = file.display().to_string();
    let d = describe(file)?;
    let Some(name) = &d.truth else { return Ok(None) };
    d.volume.validate(&place)?;
    let mut volume = read_volume(folder::plain(folder_of(file), &place, "truth", name)?)?;
    // On the scan's own grid the description is exact; NIfTI rounds spacings to 32 bits.
    if volume.grid.shape == d.volume.shape {
        volume.grid = d.volume;
    } else {
        volume.grid.center = d.volume.center;
    }
    Ok(Some(volume))
}

/// Writes `scan` as the folder `folder`, with the volume from which it was simulated if there is one.
///
/// The folder appears under its name when it is complete. An earlier one is replaced only if it is empty or a conefield
/// scan with nothing else in it.
pub fn write_scan(folder: impl AsRef<Path>, scan: &Scan, truth: Option<&Volume>) -> Result<()> {
    let folder = folder.as_ref();
    let place = folder.display().to_string();
    scan.validate(&place)?;
    let known = |n: &str| ["scan.toml", "scan.json", PROJECTIONS, TRUTH].contains(&n);
    folder::may_replace(folder, "conefield scan", &known, &["scan.toml", "scan.json"])?;
    let g = &scan.geometry;
    let orbit = CircularOrbit::fit(&g.views).map(|o| OrbitTable {
        dso: o.dso,
        dsd: o.dsd,
        pixel: o.pixel,
        offset: o.offset,
        angles: Some(o.angles),
        start: None,
        range: None,
        count: None,
    });
    let provenance = match &scan.provenance {
        serde_json::Value::Null => None,
        serde_json::Value::Object(m) => Some(m.clone()),
        other => Some(serde_json::Map::from_iter([("value".to_string(), other.clone())])),
    };
    let description = Description {
        format: FORMAT.into(),
        version: VERSION,
        projections: PROJECTIONS.into(),
        truth: truth.map(|_| TRUTH.into()),
        unit: scan.unit.clone(),
        detector: Detector { rows: g.detector[0], columns: g.detector[1] },
        volume: g.volume,
        views: orbit.is_none().then(|| g.views.clone()),
        orbit,
        provenance: provenance.map(|m| m.into_iter().filter_map(|(k, v)| Some((k, without_null(v)?))).collect()),
    };
    let text = toml::to_string(&description)
        .map_err(|e| Error::invalid(&place, "scan.toml", e, "a description that TOML can hold"))?;
    write_folder_atomic(folder, &mut |new| {
        write_text_atomic(new.join("scan.toml"), &text)?;
        let path = new.join(PROJECTIONS);
        write_atomic(&path, &mut |w| npy::write(w, &path, &scan.projections))?;
        truth.map_or(Ok(()), |t| write_volume(new.join(TRUTH), t))
    })
}

/// Adapts JSON to TOML, which has no null and no integers beyond 63 bits: drops nulls and turns larger numbers into
/// text.
fn without_null(value: serde_json::Value) -> Option<serde_json::Value> {
    use serde_json::Value;
    Some(match value {
        Value::Null => return None,
        Value::Number(n) if n.is_u64() && !n.is_i64() => Value::String(n.to_string()),
        Value::Array(a) => Value::Array(a.into_iter().filter_map(without_null).collect()),
        Value::Object(m) => Value::Object(m.into_iter().filter_map(|(k, v)| Some((k, without_null(v)?))).collect()),
        other => other,
    })
}

/// Turns TOML dates into text; other types receive them as a table with one reserved key.
fn plain_dates(value: serde_json::Value) -> serde_json::Value {
    use serde_json::Value;
    match value {
        Value::Object(m) => match m.get("$__toml_private_datetime") {
            Some(date) if m.len() == 1 => date.clone(),
            _ => Value::Object(m.into_iter().map(|(k, v)| (k, plain_dates(v))).collect()),
        },
        Value::Array(a) => Value::Array(a.into_iter().map(plain_dates).collect()),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read_truth;
    use crate::testing::{is_geometry, read_scan, says, scan};
    use ndarray::Array3;
    use std::fs;
    use std::path::PathBuf;

    fn close(a: &Scan, b: &Scan) {
        assert_eq!(a.projections, b.projections);
        assert_eq!((&a.unit, &a.provenance), (&b.unit, &b.provenance));
        assert_eq!(a.geometry.volume, b.geometry.volume);
        is_geometry(&a.geometry, &b.geometry);
    }

    /// A written scan with an editable description.
    fn written() -> (tempfile::TempDir, PathBuf, String) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scan");
        write_scan(&path, &scan(), None).unwrap();
        let text = fs::read_to_string(path.join("scan.toml")).unwrap();
        (dir, path, text)
    }

    #[test]
    fn a_circular_scan_comes_back_as_an_orbit() {
        let (_dir, path, text) = written();
        assert!(text.contains("[orbit]") && !text.contains("[[views]]"), "{text}");
        close(&read_scan(&path).unwrap(), &scan());
        close(&read_scan(path.join("scan.toml")).unwrap(), &scan());
        assert!(read_truth(&path).unwrap().is_none());
    }

    #[test]
    fn an_irregular_scan_comes_back_bit_for_bit() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scan");
        let mut s = scan();
        s.geometry.views[2].source[2] += 0.1;
        write_scan(&path, &s, None).unwrap();
        assert!(fs::read_to_string(path.join("scan.toml")).unwrap().contains("[[views]]"));
        assert_eq!(read_scan(&path).unwrap().geometry, s.geometry);
    }

    #[test]
    fn the_truth_stands_on_the_grid_of_the_scan() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scan");
        let s = scan();
        let truth = Volume { data: Array3::from_elem((5, 6, 7), 0.25), grid: s.geometry.volume, affine: None };
        write_scan(&path, &s, Some(&truth)).unwrap();
        let back = read_truth(&path).unwrap().unwrap();
        assert_eq!((back.grid, back.data), (truth.grid, truth.data));
    }

    #[test]
    fn json_is_read_as_well() {
        let (_dir, path, text) = written();
        let value: toml::Value = toml::from_str(&text).unwrap();
        fs::remove_file(path.join("scan.toml")).unwrap();
        let json = serde_json::to_string_pretty(&value).unwrap();
        fs::write(path.join("scan.json"), json).unwrap();
        close(&read_scan(&path).unwrap(), &scan());
    }

    #[test]
    fn start_range_and_count_leave_the_end_out() {
        let (_dir, path, text) = written();
        let from = text.find("angles = ").unwrap();
        let to = from + text[from..].find('\n').unwrap();
        let even = format!("{}start = 0.3\nrange = 6.283185307179586\ncount = 7{}", &text[..from], &text[to..]);
        fs::write(path.join("scan.toml"), even).unwrap();
        close(&read_scan(&path).unwrap(), &scan());
    }

    #[test]
    fn lying_descriptions_are_refused_in_words() {
        let (_dir, path, text) = written();
        for (from, to, words) in [
            ("dso = 5", "dso = -5", ["orbit.dso", "-5"]),
            ("offset = [", "count = 9\noffset = [", ["orbit.angles", "one way"]),
            ("angles = [", "angles = [] # [", ["views", "at least one"]),
        ] {
            fs::write(path.join("scan.toml"), text.replace(from, to)).unwrap();
            says(read_scan(&path), &words);
        }
    }

    #[test]
    fn only_a_scan_is_replaced() {
        let (_dir, path, _) = written();
        write_scan(&path, &scan(), None).unwrap();
        // A scan with an unrelated file in its folder.
        fs::write(path.join("notes.txt"), "mine").unwrap();
        says(write_scan(&path, &scan(), None), &["notes.txt", "conefield scan"]);
        assert_eq!(fs::read_to_string(path.join("notes.txt")).unwrap(), "mine");
        // Files with a scan's names, but without a description.
        fs::remove_file(path.join("notes.txt")).unwrap();
        fs::remove_file(path.join("scan.toml")).unwrap();
        assert!(write_scan(&path, &scan(), None).is_err());
        // A file of that name.
        assert!(write_scan(path.join(PROJECTIONS), &scan(), None).is_err());
    }

    #[test]
    fn a_failed_write_leaves_the_earlier_scan_whole() {
        let (_dir, path, _) = written();
        let mut truth = Volume::centered(Array3::ones((2, 2, 2)), [1.0; 3]);
        truth.data[[0, 0, 0]] = f32::NAN;
        assert!(write_scan(&path, &scan(), Some(&truth)).is_err());
        close(&read_scan(&path).unwrap(), &scan());
        assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn provenance_survives_what_toml_lacks() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scan");
        let mut s = scan();
        s.provenance = serde_json::json!({"a": null, "b": [1, null], "seed": u64::MAX, "c": {"d": "e"}});
        write_scan(&path, &s, None).unwrap();
        let want = serde_json::json!({"b": [1], "seed": u64::MAX.to_string(), "c": {"d": "e"}});
        assert_eq!(read_scan(&path).unwrap().provenance, want);
        let text = fs::read_to_string(path.join("scan.toml")).unwrap() + "when = 2026-01-02\n";
        fs::write(path.join("scan.toml"), text.replace("[provenance.c]", "[provenance.c]\nday = 2026-01-01")).unwrap();
        assert_eq!(read_scan(&path).unwrap().provenance["c"]["day"], "2026-01-01");
    }
}
