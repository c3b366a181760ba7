//! R2-Gaussian's folder: `meta_data.json`, one `.npy` per projection, `vol_gt.npy`.
//!
//! Its world is conefield's: source at `DSO·(cos a, sin a, 0)`, columns along `(-sin a, cos a, 0)`, rows towards −z;
//! `nDetector` and `sDetector` are \[v, u\], the volume is \[x, y, z\]. `offDetector` is \[u, v\] and, as in TIGRE, its
//! v points towards +z, against the rows. `offOrigin` is the volume's centre. Projections are integrals over the file's
//! lengths, whatever their unit.

use crate::orbit::{common_orbit, written};
use crate::scan::DataSet;
use crate::size::product;
use crate::text::{self, shortened, unread};
use crate::unit::{self, Reading, Units};
use crate::{ScanSize, folder, memory, npy, rays, write_atomic, write_folder_atomic, write_text_atomic};
use conefield_core::error::ensure;
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::orbit::{Beam, CircularOrbit};
use conefield_core::scan::{Scan, Unit, Volume};
use conefield_core::{Error, Result};
use ndarray::{Array2, Array3, Axis, Ix2, Ix3};
use serde::Deserialize;
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};

/// The file that describes the folder.
pub(crate) const META: &str = "meta_data.json";

#[derive(Deserialize)]
struct Meta {
    scanner: Scanner,
    vol: Option<String>,
    proj_train: Vec<Frame>,
    #[serde(default)]
    proj_test: Vec<Frame>,
    /// An extension that preserves the unit; R2-Gaussian ignores it.
    unit: Option<Unit>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    angle: f64,
}

#[derive(Deserialize)]
#[allow(non_snake_case)]
struct Scanner {
    mode: Beam,
    DSD: f64,
    DSO: f64,
    nDetector: [usize; 2],
    sDetector: Option<[f64; 2]>,
    dDetector: Option<[f64; 2]>,
    nVoxel: [usize; 3],
    sVoxel: Option<[f64; 3]>,
    dVoxel: Option<[f64; 3]>,
    #[serde(default)]
    offOrigin: [f64; 3],
    #[serde(default)]
    offDetector: [f64; 2],
}

/// Reads R2-Gaussian's folder: training views, test views if `with_test` says so, and the volume.
///
/// The format does not name its unit of length. A `unit` entry decides. Otherwise the volume decides: if its integrals
/// over the file's lengths match the projections, as in the published data, the unit is called `r2` and counts as 1 mm;
/// if the projections are a thousand times larger, the lengths are metres and the volume is in 1/mm. Any other ratio
/// counts as the first case, with a warning.
pub(crate) fn read(folder: &Path, with_test: bool) -> Result<DataSet> {
    let file = folder.join(META);
    let meta = text::read(&file)?;
    text::warn(&file.display().to_string(), unread(&others(text::read(&file)?)));
    described(folder, meta, with_test)
}

/// The volume of [`read`], in the unit that the training views give.
pub(crate) fn read_truth(folder: &Path) -> Result<Option<Volume>> {
    described(folder, text::read(&folder.join(META))?, false).map(|r| r.volume)
}

/// The file with the volume, if the folder names one.
pub(crate) fn truth_file(folder: &Path) -> Result<Option<PathBuf>> {
    let file = folder.join(META);
    let meta: Meta = text::read(&file)?;
    let place = file.display().to_string();
    meta.vol.map(|name| folder::inside(folder, &place, "vol", &name)).transpose()
}

/// All keys of the scanner and of views.
#[derive(Deserialize)]
struct Keys {
    scanner: Map<String, Value>,
    #[serde(default)]
    proj_train: Vec<Map<String, Value>>,
    #[serde(default)]
    proj_test: Vec<Map<String, Value>>,
}

/// Keys of the scanner that are read, and those that do not move source, detector or volume, beside those of noise.
const KNOWN: [&str; 15] = [
    "mode", "DSD", "DSO", "nDetector", "sDetector", "dDetector", "nVoxel", "sVoxel", "dVoxel", "offOrigin",
    "offDetector", "filter", "accuracy", "totalAngle", "startAngle",
];

/// Numbers other than 0 in a description that are not read: of the scanner (TIGRE's `rotDetector` and `COR`, say) and of
/// single views.
fn others(keys: Keys) -> Vec<String> {
    fn set(value: &Value) -> bool {
        match value {
            Value::Number(n) => n.as_f64() != Some(0.0),
            Value::Array(all) => all.iter().any(set),
            _ => false,
        }
    }
    let moving = |key: &str| !KNOWN.contains(&key) && !key.to_lowercase().contains("noise");
    let mut all = Vec::new();
    for (key, value) in keys.scanner.iter().filter(|(key, value)| moving(key) && set(value)) {
        all.push(format!("scanner.{key} = {}", shortened(&value.to_string()).trim_matches('"')));
    }
    for (split, frames) in [("proj_train", &keys.proj_train), ("proj_test", &keys.proj_test)] {
        let stranger = frames.iter().enumerate().find_map(|(i, frame)| {
            let (key, _) =
                frame.iter().find(|(key, value)| !["file_path", "angle"].contains(&&key[..]) && set(value))?;
            Some(format!("{split}[{i}].{key}"))
        });
        all.extend(stranger);
    }
    all
}

fn described(folder: &Path, meta: Meta, with_test: bool) -> Result<DataSet> {
    let place = folder.join(META).display().to_string();
    let s = &meta.scanner;
    for (field, x) in [("scanner.DSO", s.DSO), ("scanner.DSD", s.DSD)] {
        ensure(x.is_finite() && x > 0.0, &place, field, x, "a positive finite distance")?;
    }
    let pixel = each(&place, ["Detector", "[v, u]"], s.nDetector, s.sDetector, s.dDetector)?;
    let spacing = each(&place, ["Voxel", "[x, y, z]"], s.nVoxel, s.sVoxel, s.dVoxel)?;
    let grid = VoxelGrid { shape: s.nVoxel, spacing, center: s.offOrigin };
    let orbit = |frames: &[Frame]| {
        let offset = [-s.offDetector[1], s.offDetector[0]];
        let angles = frames.iter().map(|f| f.angle).collect();
        CircularOrbit { dso: s.DSO, dsd: s.DSD, pixel, offset, angles }.with_beam(s.mode, &grid)
    };
    let scan = |field: &str, frames: &[Frame]| -> Result<Scan> {
        let geometry = Geometry { detector: s.nDetector, views: orbit(frames).views(), volume: grid };
        geometry.validate(&format!("{place}: {field}"))?;
        let projections = projections(folder, &place, field, frames, s.nDetector)?;
        let provenance = json!({ "format": "r2", "folder": folder.file_name().map(|n| n.to_string_lossy()) });
        Ok(Scan { geometry, projections, unit: Unit { name: "r2".into(), mm: 1.0 }, provenance })
    };
    let train = scan("proj_train", &meta.proj_train)?;
    let test = (with_test && !meta.proj_test.is_empty()).then(|| scan("proj_test", &meta.proj_test)).transpose()?;
    let data = meta.vol.as_deref().map(|name| volume(folder, &place, name, s.nVoxel)).transpose()?;
    let units = length_unit(&place, meta.unit, &train, data.as_ref())?;
    units.data_set(&place, train, test, data)
}

/// The size of the folder's training views. `reading` covers the spare capacity of a growing list, and the volume,
/// which is read to find the unit.
pub(crate) fn size(folder: &Path) -> Result<ScanSize> {
    let file = folder.join(META);
    let meta: Meta = text::read(&file)?;
    let pixels_of = |frames: &[Frame]| product(meta.scanner.nDetector).saturating_mul(frames.len() as u64);
    let (pixels, test_pixels) = (pixels_of(&meta.proj_train), pixels_of(&meta.proj_test));
    let voxels = product(meta.scanner.nVoxel);
    let volume = if meta.vol.is_some() { voxels } else { 0 };
    let (reading, views) = (pixels.max(volume).saturating_mul(4), meta.proj_train.len());
    Ok(ScanSize { pixels, voxels, test_pixels, reading, views })
}

/// Possible units of a folder that does not name one.
const READINGS: [Reading; 2] = [
    Reading { ratio: 1.0, unit: "r2", unit_mm: 1.0, length_mm: 1.0, found: "volume and projections" },
    Reading {
        ratio: 1000.0,
        unit: "mm",
        unit_mm: 1.0,
        length_mm: 1000.0,
        found: "volume and projections: lengths in m, attenuation in 1/mm",
    },
];

fn length_unit(place: &str, said: Option<Unit>, train: &Scan, volume: Option<&Array3<f32>>) -> Result<Units> {
    if let Some(unit) = said {
        unit::check(place, &unit)?;
        return Ok(Units { length_mm: unit.mm, unit, found: unit::SAID });
    }
    let agreement = volume.and_then(|v| rays::agreement(train, v));
    Ok(unit::from_numbers(place, agreement, &READINGS, "nothing: lengths are taken for mm"))
}

/// Size of one pixel or voxel, from the total (`s...`), from the single one (`d...`), or from both if they agree.
fn each<const N: usize>(
    place: &str,
    [what, axes]: [&str; 2],
    n: [usize; N],
    whole: Option<[f64; N]>,
    one: Option<[f64; N]>,
) -> Result<[f64; N]> {
    let fields = |p: &str| format!("scanner.{p}{what}");
    let expected = format!("at least 1 along each of {axes}");
    ensure(n.iter().all(|&n| n > 0), place, &fields("n"), format!("{n:?}"), expected)?;
    let divided = whole.map(|w| std::array::from_fn(|k| w[k] / n[k] as f64));
    let (field, size): (_, [f64; N]) = match (one, divided) {
        (Some(d), Some(w)) => {
            let same = (0..N).all(|k| (d[k] - w[k]).abs() <= 1e-4 * w[k].abs());
            ensure(same, place, &fields("d"), format!("{d:?}"), format!("{w:?}, which is s{what}/n{what}"))?;
            (fields("d"), d)
        }
        (Some(d), None) => (fields("d"), d),
        (None, Some(w)) => (fields("s"), w),
        (None, None) => return Err(Error::invalid(place, fields("s"), "nothing", format!("lengths along {axes}"))),
    };
    let fits = size.iter().all(|s| s.is_finite() && *s > 0.0);
    let expected = format!("positive finite lengths along {axes}");
    ensure(fits, place, &field, format!("{:?}", one.or(whole).unwrap_or(size)), expected)?;
    Ok(size)
}

fn projections(folder: &Path, place: &str, field: &str, frames: &[Frame], shape: [usize; 2]) -> Result<Array3<f32>> {
    let mut all: Vec<f32> = Vec::new();
    let mut named = folder::NamedFiles::default();
    for (i, frame) in frames.iter().enumerate() {
        let field = format!("{field}[{i}].file_path");
        let path = folder::inside(folder, place, &field, &frame.file_path)?;
        named.once(place, &field, &path, None)?;
        let image: Array2<f32> = npy::read(&path, &["row", "column"])?
            .into_dimensionality::<Ix2>()
            .map_err(|e| Error::invalid(path.display().to_string(), "shape", e, "two axes"))?;
        let (found, expected) = (format!("{:?}", image.shape()), format!("{shape:?}, as scanner.nDetector says"));
        ensure(image.shape() == shape, &path.display().to_string(), "shape", found, expected)?;
        memory::grow(&mut all, image.len(), usize::MAX, place, &field)?;
        all.extend(image.iter());
    }
    Array3::from_shape_vec((frames.len(), shape[0], shape[1]), all)
        .map_err(|e| Error::invalid(place, field, e, "one projection per view"))
}

fn volume(folder: &Path, place: &str, name: &str, shape: [usize; 3]) -> Result<Array3<f32>> {
    let path = folder::inside(folder, place, "vol", name)?;
    let data = npy::read(&path, &["x", "y", "z"])?;
    let (found, expected) = (format!("{:?}", data.shape()), format!("{shape:?}, as scanner.nVoxel says"));
    ensure(data.shape() == shape, &path.display().to_string(), "shape", found, expected)?;
    data.into_dimensionality::<Ix3>().map_err(|e| Error::invalid(path.display().to_string(), "shape", e, "three axes"))
}

/// Writes R2-Gaussian's folder, lengths in the unit of `train`. R2-Gaussian's own reader requires a volume; without one
/// the folder is still written, for other readers.
///
/// Refuses what the format cannot express: a scan that is not a circle about z, and a test scan with another orbit,
/// detector or grid. Replaces an earlier folder only if it is empty or an R2-Gaussian folder with nothing else in it.
pub fn write_r2(folder: impl AsRef<Path>, train: &Scan, test: Option<&Scan>, volume: Option<&Volume>) -> Result<()> {
    let folder = folder.as_ref();
    let place = folder.display().to_string();
    let (orbit, test_orbit) = common_orbit(&place, "R2-Gaussian's format", train, test, volume)?;
    let known = |n: &str| [META, "proj_train", "proj_test", "vol_gt.npy"].contains(&n);
    folder::may_replace(folder, "R2-Gaussian folder", &known, &[META])?;
    for split in ["proj_train", "proj_test"] {
        let known = |n: &str| n.starts_with(&format!("{split}_")) && n.ends_with(".npy");
        let first = format!("{split}_0000.npy");
        folder::may_replace(&folder.join(split), "R2-Gaussian folder", &known, &[&first])?;
    }

    let mm = train.unit.mm;
    let (g, grid) = (&train.geometry, &train.geometry.volume);
    let size = grid.size();
    let half = size.iter().copied().fold(0.0, f64::max) / 2.0;
    let frames = |split: &str, angles: &[f64]| -> Vec<Value> {
        let frame = |(i, a): (usize, &f64)| json!({ "file_path": format!("{split}/{split}_{i:04}.npy"), "angle": a });
        angles.iter().enumerate().map(frame).collect()
    };
    let (mode, [dso, dsd], [pixel, offset]) = written(&orbit, grid);
    let mut meta = json!({
        "scanner": {
            "mode": mode,
            "filter": null,
            "DSD": dsd / mm,
            "DSO": dso / mm,
            "nDetector": g.detector,
            "sDetector": [pixel[0] * g.detector[0] as f64 / mm, pixel[1] * g.detector[1] as f64 / mm],
            "nVoxel": grid.shape,
            "sVoxel": size.map(|s| s / mm),
            "offOrigin": grid.center.map(|c| c / mm),
            "offDetector": [offset[1] / mm, -offset[0] / mm],
            "accuracy": 0.5,
            "totalAngle": 360.0,
            "startAngle": orbit.angles.first().copied().unwrap_or(0.0).to_degrees(),
            "noise": false,
        },
        "unit": train.unit,
        // In units of half the longest side, as in the published data.
        "bbox": grid.bounds().map(|b| b.map(|x| x / half)),
        "proj_train": frames("proj_train", &orbit.angles),
        "proj_test": frames("proj_test", test_orbit.as_ref().map_or(&[], |o| &o.angles)),
    });
    if volume.is_some() {
        meta["vol"] = json!("vol_gt.npy");
    }
    let text = serde_json::to_string_pretty(&meta)
        .map_err(|e| Error::invalid(&place, META, e, "numbers that JSON can hold"))?;
    write_folder_atomic(folder, &mut |new| {
        for (split, scan) in [("proj_train", Some(train)), ("proj_test", test)] {
            let sub = new.join(split);
            std::fs::create_dir(&sub).map_err(|e| Error::io(&sub, e))?;
            for (i, view) in scan.iter().flat_map(|s| s.projections.axis_iter(Axis(0))).enumerate() {
                let path = sub.join(format!("{split}_{i:04}.npy"));
                write_atomic(&path, &mut |w| npy::write(w, &path, &view.to_owned()))?;
            }
        }
        if let Some(v) = volume {
            crate::write_volume(new.join("vol_gt.npy"), v)?;
        }
        write_text_atomic(new.join(META), &text)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{consistent, data_set_comes_back, is_geometry, says, scan};
    use std::fs;

    /// Changes the description in the folder `path`.
    fn changed(path: &Path, change: &dyn Fn(&mut Value)) {
        let file = path.join(META);
        let mut meta = text::read(&file).unwrap();
        change(&mut meta);
        fs::write(&file, serde_json::to_string_pretty(&meta).unwrap()).unwrap();
    }

    /// The folder in `tests/fixtures` has lengths in metres.
    #[test]
    fn the_unit_comes_from_the_numbers() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("r2");
        let (s, volume) = consistent(Unit { name: "r2".into(), mm: 1.0 });
        write_r2(&path, &s, None, Some(&volume)).unwrap();
        changed(&path, &|meta| drop(meta.as_object_mut().unwrap().remove("unit")));
        let back = read(&path, true).unwrap();
        assert_eq!((back.train.unit, &back.train.provenance["unit_from"]), (s.unit, &json!("volume and projections")));
        is_geometry(&back.train.geometry, &s.geometry);
    }

    #[test]
    fn what_is_written_comes_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("r2");
        data_set_comes_back(&path, &|p, s, test, v| write_r2(p, s, test, v), &read);
        // Lengths are written in the scan's own unit, centimetres here.
        let meta: Value = text::read(&path.join(META)).unwrap();
        assert!((meta["scanner"]["DSO"].as_f64().unwrap() - 50.0).abs() < 1e-9);
        fs::write(path.join("mine.txt"), "").unwrap();
        says(write_r2(&path, &scan(), None, None), &["mine.txt"]);
    }

    #[test]
    fn keys_that_move_something_and_are_not_read_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("r2");
        write_r2(&path, &scan(), None, None).unwrap();
        let found = || others(text::read(&path.join(META)).unwrap());
        assert_eq!(found(), Vec::<String>::new());
        changed(&path, &|meta| {
            meta["scanner"]["rotDetector"] = json!([0, 0.01, 0]);
            meta["scanner"]["COR"] = json!(0);
            meta["scanner"]["possion_noise"] = json!(1e4);
            meta["proj_train"][3]["offDetector"] = json!([1, 0]);
            // A backslash separates folders: the file was made on Windows.
            for (i, frame) in meta["proj_train"].as_array_mut().unwrap().iter_mut().enumerate() {
                frame["file_path"] = json!(format!("proj_train\\proj_train_{i:04}.npy"));
            }
        });
        assert_eq!(found(), ["scanner.rotDetector = [0,0.01,0]", "proj_train[3].offDetector"]);
        assert_eq!(read(&path, true).unwrap().train.projections, scan().projections);
    }

    #[test]
    fn lying_descriptions_are_refused_in_words() {
        let refused = |lie: &dyn Fn(&mut Value), words: &[&str]| {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("r2");
            write_r2(&path, &scan(), None, None).unwrap();
            changed(&path, lie);
            says(read(&path, true), words);
        };
        refused(&|m| m["scanner"]["nVoxel"] = json!([1u64 << 40, 1u64 << 40, 1]), &["volume.shape"]);
        refused(&|m| m["scanner"]["sVoxel"] = json!(null), &["scanner.sVoxel", "nothing"]);
        refused(&|m| m["scanner"]["dVoxel"] = json!([9, 9, 9]), &["scanner.dVoxel", "sVoxel"]);
        refused(&|m| m["vol"] = json!("vol_gt.npy"), &["vol", "vol_gt.npy"]);
        refused(&|m| m["unit"]["mm"] = json!(0), &["unit.mm"]);
    }
}
