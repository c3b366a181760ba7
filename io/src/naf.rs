//! The scan files of NAF and SAX-NeRF: one pickle with a dict of TIGRE's names.
//!
//! Their world is conefield's: source at `DSO·(cos a, sin a, 0)`, columns along `(-sin a, cos a, 0)`, rows towards −z.
//! `nDetector`, `dDetector` and `offDetector` are \[v, u\]. As in TIGRE, the offset's v points towards +z, against the
//! rows. Volumes are \[x, y, z\]; `offOrigin` is the volume's centre. Lengths are millimetres. The format does not name
//! the unit of `image`: see [`read`].

use crate::input::read_bytes;
use crate::orbit::{common_orbit, written};
use crate::pickle::{self, Item, Out, Pickle};
use crate::scan::DataSet;
use crate::unit::{self, Reading, Units};
use crate::{rays, text, write_atomic};
use conefield_core::finite::stray;
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::orbit::{Beam, CircularOrbit};
use conefield_core::scan::{Scan, Unit, Volume};
use conefield_core::{Error, Result};
use ndarray::{Array3, Ix3};
use serde_json::json;
use std::path::Path;

/// Required keys.
const REQUIRED: [&str; 8] = ["mode", "DSO", "DSD", "nDetector", "dDetector", "nVoxel", "dVoxel", "train"];

/// Optional keys that change the scan.
const OPTIONAL: [&str; 7] = ["offOrigin", "offDetector", "image", "val", "numTrain", "numVal", "unit"];

/// Keys of the published files that only their generator needs: none of them moves source, detector or volume.
const STILL: [&str; 12] = [
    "accuracy", "filter", "totalAngle", "startAngle", "randomAngle", "convert", "rescale_slope", "rescale_intercept",
    "normalize", "noise", "sDetector", "sVoxel",
];

/// How similar an unknown key must be to a missing one to count as a misspelling.
const NEAR: f64 = 0.9;

/// Two turns either way: larger angles are probably degrees.
const MOST_RADIANS: f64 = 4.0 * std::f64::consts::PI + 1e-6;

/// Possible units of a file that does not name one.
const READINGS: [Reading; 2] = [
    Reading {
        ratio: 1.0,
        unit: "mm",
        unit_mm: 1.0,
        length_mm: 1.0,
        found: "image and projections: attenuation in 1/mm",
    },
    Reading {
        ratio: 0.001,
        unit: "m",
        unit_mm: 1000.0,
        length_mm: 1.0,
        found: "image and projections: lengths in mm, attenuation in 1/m",
    },
];

/// Reads a scan of NAF, SAX-NeRF or TIGRE's demos: training views, `val` views if `with_test` says so, and `image`.
///
/// Lengths are mm and angles radians; a warning is logged if the angles look like degrees. The format does not name the
/// unit of `image`. A `unit` entry, as [`write_naf`] adds, decides. Otherwise the rays decide: if the integrals of
/// `image` over millimetres match the projections, `image` is in 1/mm; if they are a thousand times larger, as in the
/// published files, it is in 1/m. Any other ratio counts as 1/mm with a warning, and a file without `image` as 1/mm.
/// `provenance.unit_from` records the decision.
///
/// The published code orders `offDetector` as \[u, v\], TIGRE itself as \[v, u\]. The latter is used unless the rays
/// through `image` fit clearly better with the former (`provenance.offset_from`).
///
/// Nothing in the file is ever called. Names other than those of NumPy's arrays, missing or misspelt keys, shapes that
/// do not match and values that are not finite are refused with the byte or the key.
pub(crate) fn read(path: &Path, with_test: bool) -> Result<DataSet> {
    let place = path.display().to_string();
    let bytes = read_bytes(path)?;
    let pickle = Pickle::parse(&place, &bytes)?;
    let top = pickle.top();
    let file = Description::read(&top)?;
    text::warn(&place, text::unread(&others(&top)?));
    let name = path.file_name().map(|n| n.to_string_lossy());
    let provenance = json!({ "format": "naf", "file": name });
    let scan = |views: &Item| -> Result<Scan> {
        let (geometry, projections) = file.views(&place, views)?;
        Ok(Scan { geometry, projections, unit: Unit::default(), provenance: provenance.clone() })
    };
    let mut train = scan(&required(&top, "train")?)?;
    check_count(&top, "numTrain", train.geometry.views.len())?;
    let test = if with_test { top.get("val")? } else { None };
    // NAF writes the key even without test views.
    let mut test = test.filter(|t| has_views(t)).map(|t| scan(&t)).transpose()?;
    let data = file.image(&top)?;

    let said = stated_unit(&place, &top)?;
    let mut agreement = data.as_ref().and_then(|d| rays::agreement(&train, d));
    if let (None, Some(data), Some(given)) = (&said, &data, agreement)
        && file.offset[0] != file.offset[1]
    {
        let other = Description { offset: [file.offset[1], file.offset[0]], ..file.clone() };
        let mut turned = train.clone();
        other.turn(&mut turned.geometry, &file);
        if let Some(better) = rays::agreement(&turned, data).filter(|o| o.residual < 0.5 * given.residual) {
            tracing::warn!("{place}: offDetector fits the image as [u, v], not as [v, u], and is read so");
            (train, agreement) = (turned, Some(better));
            test.iter_mut().for_each(|t| other.turn(&mut t.geometry, &file));
            for s in [Some(&mut train), test.as_mut()].into_iter().flatten() {
                s.provenance["offset_from"] = json!("image and projections: offDetector is [u, v]");
            }
        }
    }
    let units = match said {
        Some(unit) => Units { unit, length_mm: 1.0, found: unit::SAID },
        None => {
            unit::from_numbers(&place, agreement, &READINGS, "nothing: taken for lengths in mm, attenuation in 1/mm")
        }
    };
    units.data_set(&place, train, test, data)
}

/// Reads only the volume. Its voxel sizes are in mm whatever the unit of its values, so the projections are not needed.
pub(crate) fn read_truth(path: &Path) -> Result<Option<Volume>> {
    let place = path.display().to_string();
    let bytes = read_bytes(path)?;
    let pickle = Pickle::parse(&place, &bytes)?;
    let file = Description::read(&pickle.top())?;
    let data = file.image(&pickle.top())?;
    Ok(data.map(|data| Volume { data, grid: file.grid, affine: None }))
}

/// The entries shared by all views, in mm.
#[derive(Clone)]
struct Description {
    beam: Beam,
    dso: f64,
    dsd: f64,
    detector: [usize; 2],
    pixel: [f64; 2],
    /// As in the file: along v towards +z, along u.
    offset: [f64; 2],
    grid: VoxelGrid,
}

impl Description {
    fn read(top: &Item) -> Result<Self> {
        check_keys(top)?;
        let mode = required(top, "mode")?;
        let beam = match mode.text()? {
            "cone" => Beam::Cone,
            "parallel" => Beam::Parallel,
            other => return Err(mode.invalid(format!("\"{other}\""), "\"cone\" or \"parallel\"")),
        };
        let distance = |key: &str| -> Result<f64> {
            let item = required(top, key)?;
            let found = item.number()?;
            if found > 0.0 { Ok(found) } else { Err(item.invalid(found, "a positive finite distance in mm")) }
        };
        Ok(Self {
            beam,
            dso: distance("DSO")?,
            dsd: distance("DSD")?,
            detector: counts(top, "nDetector", "pixels along [v, u]")?,
            pixel: lengths(top, "dDetector", "pixel size", "[v, u]")?,
            offset: top.get("offDetector")?.map_or(Ok([0.0; 2]), |i| i.list("mm along [v, u]"))?,
            grid: VoxelGrid {
                shape: counts(top, "nVoxel", "voxels along [x, y, z]")?,
                spacing: lengths(top, "dVoxel", "voxel size", "[x, y, z]")?,
                center: top.get("offOrigin")?.map_or(Ok([0.0; 3]), |i| i.list("mm along [x, y, z]"))?,
            },
        })
    }

    fn orbit(&self, angles: Vec<f64>) -> CircularOrbit {
        let offset = [-self.offset[0], self.offset[1]];
        let orbit = CircularOrbit { dso: self.dso, dsd: self.dsd, pixel: self.pixel, offset, angles };
        orbit.with_beam(self.beam, &self.grid)
    }

    /// Geometry and projections of `train` or `val`. Checks shapes before it decodes a number.
    fn views(&self, place: &str, views: &Item) -> Result<(Geometry, Array3<f32>)> {
        let item = required(views, "angles")?;
        let angles = item.numbers()?;
        if let Some(a) = angles.iter().find(|a| a.abs() > MOST_RADIANS) {
            tracing::warn!("{place}: {}: {a} looks like degrees but is read as radians", item.key());
        }
        let count = angles.len();
        let geometry = Geometry { detector: self.detector, views: self.orbit(angles).views(), volume: self.grid };
        geometry.validate(&format!("{place}: {}", views.key()))?;
        let want = [count, self.detector[0], self.detector[1]];
        let item = required(views, "projections")?;
        let values = item.values(&want, "[view, row, column], as angles and nDetector say")?;
        let values = values.into_dimensionality::<Ix3>().map_err(|e| item.invalid(e, "three axes"))?;
        Ok((geometry, values))
    }

    /// Moves the detectors of `geometry` from the offset of `from` to the offset of `self`.
    fn turn(&self, geometry: &mut Geometry, from: &Self) {
        let [dv, du] = [from.offset[0] - self.offset[0], self.offset[1] - from.offset[1]];
        for view in &mut geometry.views {
            for k in 0..3 {
                view.detector[k] += dv / self.pixel[0] * view.v[k] + du / self.pixel[1] * view.u[k];
            }
        }
    }

    fn image(&self, top: &Item) -> Result<Option<Array3<f32>>> {
        let Some(image) = top.get("image")? else { return Ok(None) };
        let values = image.values(&self.grid.shape, "[x, y, z], as nVoxel says")?;
        values.into_dimensionality::<Ix3>().map(Some).map_err(|e| image.invalid(e, "three axes"))
    }
}

fn required<'p, 'a>(item: &Item<'p, 'a>, key: &str) -> Result<Item<'p, 'a>> {
    if let Some(found) = item.get(key)? {
        return Ok(found);
    }
    let keys = item.keys()?;
    let unknown = keys.iter().filter(|k| !REQUIRED.contains(k) && !OPTIONAL.contains(k));
    let found = match nearest(key, unknown) {
        Some((name, _)) if keys.contains(&key) => format!("None (and \"{name}\")"),
        Some((name, near)) if near > 0.75 => format!("no such key, but \"{name}\""),
        _ if keys.contains(&key) => "None".into(),
        _ => "no such key".into(),
    };
    let path = if item.key() == "content" { key.to_owned() } else { format!("{}.{key}", item.key()) };
    Err(item.invalid_at(path, found, format!("the key \"{key}\"")))
}

/// Refuses an unknown key that resembles one of the keys in use. Other keys are ignored: the published files have many
/// that only their generator needs.
fn check_keys(top: &Item) -> Result<()> {
    let keys = top.keys()?;
    for key in OPTIONAL.iter().filter(|k| !keys.contains(k)) {
        let unknown = keys.iter().filter(|k| !REQUIRED.contains(k) && !OPTIONAL.contains(k));
        if let Some((name, near)) = nearest(key, unknown)
            && near > NEAR
        {
            return Err(top.invalid_at((*name).to_owned(), "a key that is not known here", format!("\"{key}\"")));
        }
    }
    Ok(())
}

/// Numbers other than 0 that are not read, such as TIGRE's `rotDetector` and `COR`.
fn others(top: &Item) -> Result<Vec<String>> {
    let known = |key: &str| REQUIRED.contains(&key) || OPTIONAL.contains(&key) || STILL.contains(&key);
    let mut all = Vec::new();
    for key in top.keys()?.into_iter().filter(|k| !known(k)) {
        let Some(item) = top.get(key)? else { continue };
        let numbers = |item: &Item| {
            let one = || item.number().map(|x| vec![x]);
            one().or_else(|_| item.list::<2>("").map(Vec::from)).or_else(|_| item.list::<3>("").map(Vec::from))
        };
        if numbers(&item).is_ok_and(|n| n.iter().any(|x| *x != 0.0)) {
            all.push(key.to_owned());
        }
    }
    Ok(all)
}

fn nearest<'k>(key: &str, names: impl Iterator<Item = &'k &'k str>) -> Option<(&'k str, f64)> {
    let near = |name: &str| strsim::jaro_winkler(&name.to_lowercase(), &key.to_lowercase());
    names.map(|n| (*n, near(n))).max_by(|a, b| a.1.total_cmp(&b.1))
}

fn counts<const N: usize>(top: &Item, key: &str, axes: &str) -> Result<[usize; N]> {
    let item = required(top, key)?;
    let found: [f64; N] = item.list(axes)?;
    let whole = found.iter().all(|x| x.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(x));
    item.ensure(whole, format!("{found:?}"), format!("at least 1, whole numbers of {axes}"))?;
    Ok(found.map(|x| x as usize))
}

fn lengths<const N: usize>(top: &Item, key: &str, what: &str, axes: &str) -> Result<[f64; N]> {
    let item = required(top, key)?;
    let found: [f64; N] = item.list(&format!("{what} along {axes}"))?;
    item.ensure(found.iter().all(|x| *x > 0.0), format!("{found:?}"), format!("positive lengths in mm along {axes}"))?;
    Ok(found)
}

/// Checks a count of views that NAF itself uses; it may be smaller than the number of views in the file.
fn check_count(top: &Item, key: &str, views: usize) -> Result<()> {
    let Some(item) = top.get(key)? else { return Ok(()) };
    let said = item.number()?;
    item.ensure(said <= views as f64, said, format!("{views}, as many as there are views"))?;
    if said != views as f64 {
        tracing::warn!("{key} is {said}, but there are {views} views: all are read");
    }
    Ok(())
}

fn has_views(views: &Item) -> bool {
    views.get("angles").is_ok_and(|a| a.is_some_and(|a| !a.numbers().is_ok_and(|n| n.is_empty())))
}

/// The `unit` entry that [`write_naf`] adds; NAF's programs ignore it.
fn stated_unit(place: &str, top: &Item) -> Result<Option<Unit>> {
    let Some(item) = top.get("unit")? else { return Ok(None) };
    let (name, mm) = (required(&item, "name")?.text()?, required(&item, "mm")?.number()?);
    let unit = Unit { name: name.into(), mm };
    unit::check(place, &unit)?;
    Ok(Some(unit))
}

/// Writes a NAF file: lengths in mm, angles in radians, projections as line integrals, the volume unchanged, in
/// `1/unit` of `train`. The pickle has protocol 4, which NumPy 1 and 2 load.
///
/// NAF's own programs require both `image` and `val`, assume that `image` is in 1/m and support only square detectors.
/// Without a volume or test views the file is still written, for other readers. An additional `unit` entry records the
/// unit of the values.
///
/// Refuses what the format cannot express: a scan that is not a circle about z, a volume whose shape differs from the
/// scan's grid, and a test scan with another orbit, detector or grid.
pub fn write_naf(path: impl AsRef<Path>, train: &Scan, test: Option<&Scan>, volume: Option<&Volume>) -> Result<()> {
    let path = path.as_ref();
    let place = path.display().to_string();
    let (orbit, test_orbit) = common_orbit(&place, "NAF's format", train, test, volume)?;
    let (g, grid) = (&train.geometry, &train.geometry.volume);
    if let Some((at, x)) = volume.and_then(|v| stray(&v.data)) {
        let field = format!("voxel [{}, {}, {}]", at.0, at.1, at.2);
        return Err(Error::invalid(place, field, x, "a finite number"));
    }
    let ints = |xs: &[usize]| Out::List(xs.iter().map(|x| Out::Int(*x)).collect());
    let floats = |xs: &[f64]| Out::List(xs.iter().map(|x| Out::Float(*x)).collect());
    let (mode, [dso, dsd], [pixel, offset]) = written(&orbit, grid);
    let mut entries = vec![
        ("mode", Out::Text(mode)),
        ("filter", Out::None),
        ("accuracy", Out::Float(0.5)),
        ("DSO", Out::Float(dso)),
        ("DSD", Out::Float(dsd)),
        ("nDetector", ints(&g.detector)),
        ("dDetector", floats(&pixel)),
        ("nVoxel", ints(&grid.shape)),
        ("dVoxel", floats(&grid.spacing)),
        ("offOrigin", floats(&grid.center)),
        ("offDetector", floats(&[0.0 - offset[0], offset[1]])),
        ("totalAngle", Out::Float(total(&orbit.angles).to_degrees())),
        ("startAngle", Out::Float(orbit.angles.first().copied().unwrap_or(0.0).to_degrees())),
        ("randomAngle", Out::Bool(false)),
        ("noise", Out::Int(0)),
        ("normalize", Out::Bool(false)),
        ("convert", Out::Bool(false)),
        ("numTrain", Out::Int(orbit.angles.len())),
        ("numVal", Out::Int(test_orbit.as_ref().map_or(0, |o| o.angles.len()))),
        ("unit", Out::Dict(vec![("name", Out::Text(&train.unit.name)), ("mm", Out::Float(train.unit.mm))])),
        ("train", views_out(&orbit.angles, &train.projections)),
    ];
    if let (Some(orbit), Some(test)) = (&test_orbit, test) {
        entries.push(("val", views_out(&orbit.angles, &test.projections)));
    }
    if let Some(v) = volume {
        entries.push(("image", Out::Floats(v.data.view().into_dyn())));
    }
    let content = Out::Dict(entries);
    write_atomic(path, &mut |w| pickle::write(w, &content).map_err(|e| Error::io(path, e)))
}

fn views_out<'a>(angles: &'a [f64], projections: &'a Array3<f32>) -> Out<'a> {
    Out::Dict(vec![("angles", Out::Doubles(angles)), ("projections", Out::Floats(projections.view().into_dyn()))])
}

/// The angle from the first view to the position of the next view after the last.
fn total(angles: &[f64]) -> f64 {
    match angles {
        [first, .., last] => (last - first) * angles.len() as f64 / (angles.len() - 1) as f64,
        _ => std::f64::consts::TAU,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{consistent, data_set_comes_back, is_geometry, says};
    use std::fs;
    use std::path::PathBuf;

    /// Writes the file of `train` without the `unit` entry.
    fn write_without_unit(path: &Path, train: &Scan, volume: Option<&Volume>) {
        write_naf(path, train, None, volume).unwrap();
        let bytes = fs::read(path).unwrap();
        // Renames the key to an unknown one of the same length.
        let key = b"\x04\0\0\0\0\0\0\0unit";
        let at = bytes.windows(key.len()).position(|w| w == key).unwrap() + key.len();
        let mut bytes = bytes;
        bytes[at - 4..at].copy_from_slice(b"____");
        fs::write(path, bytes).unwrap();
    }

    #[test]
    fn what_is_written_comes_back() {
        let dir = tempfile::tempdir().unwrap();
        data_set_comes_back(&dir.path().join("any name"), &|p, s, test, v| write_naf(p, s, test, v), &read);
    }

    #[test]
    fn the_unit_comes_from_the_rays() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.pickle");
        // As in the published files: lengths in millimetres, integrals over metres.
        for unit in [Unit { name: "m".into(), mm: 1000.0 }, Unit::default()] {
            let (s, volume) = consistent(unit);
            write_without_unit(&path, &s, Some(&volume));
            let back = read(&path, true).unwrap();
            assert_eq!(back.train.unit, s.unit);
            is_geometry(&back.train.geometry, &s.geometry);
            assert_eq!(back.volume.unwrap().data, volume.data);
            write_without_unit(&path, &s, None);
            let back = read(&path, true).unwrap();
            assert_eq!(back.train.unit, Unit::default());
            assert!(back.train.provenance["unit_from"].as_str().unwrap().starts_with("nothing"));
        }
        let (s, volume) = consistent(Unit { name: "cm".into(), mm: 10.0 });
        write_without_unit(&path, &s, Some(&volume));
        assert_eq!(read(&path, true).unwrap().train.unit, Unit::default());
    }

    #[test]
    fn the_published_order_of_the_offset_is_recognized_from_the_rays() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.pickle");
        let (s, volume) = consistent(Unit::default());
        let mut swapped = s.clone();
        let mut orbit = CircularOrbit::fit(&s.geometry.views).unwrap();
        // The file's [v, u] is [-offset[0], offset[1]].
        orbit.offset = [-orbit.offset[1], -orbit.offset[0]];
        swapped.geometry.views = orbit.views();
        write_without_unit(&path, &swapped, Some(&volume));
        let back = read(&path, true).unwrap();
        is_geometry(&back.train.geometry, &s.geometry);
        assert!(back.train.provenance["offset_from"].as_str().unwrap().contains("[u, v]"));
        // conefield's own files skip this comparison.
        write_naf(&path, &swapped, None, Some(&volume)).unwrap();
        is_geometry(&read(&path, true).unwrap().train.geometry, &swapped.geometry);
    }

    type Entries = Vec<(&'static str, Out<'static>)>;

    /// A minimal file whose entries can be changed.
    fn written(change: &dyn Fn(&mut Entries)) -> (tempfile::TempDir, PathBuf) {
        let ints = |xs: &[usize]| Out::List(xs.iter().map(|x| Out::Int(*x)).collect());
        let floats = |xs: &[f64]| Out::List(xs.iter().map(|x| Out::Float(*x)).collect());
        let mut entries = vec![
            ("mode", Out::Text("cone")),
            ("DSO", Out::Int(500)),
            ("DSD", Out::Float(800.0)),
            ("nDetector", floats(&[2.0, 3.0])),
            ("dDetector", ints(&[1, 2])),
            ("nVoxel", Out::Doubles(&[2.0, 2.0, 2.0])),
            ("dVoxel", Out::Doubles(&[1.0, 1.0, 1.5])),
            ("rescale_slope", Out::Float(1.0)),
            ("train", views(&[0.0, 1.0], [2, 2, 3], 0.5)),
        ];
        change(&mut entries);
        let content = Out::Dict(entries);
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.pickle");
        write_atomic(&path, &mut |w| pickle::write(w, &content).map_err(|e| Error::io(&path, e))).unwrap();
        (dir, path)
    }

    fn views(angles: &'static [f64], shape: [usize; 3], value: f32) -> Out<'static> {
        let projections: &'static Array3<f32> = Box::leak(Box::new(Array3::from_elem(shape, value)));
        views_out(angles, projections)
    }

    #[test]
    fn lists_arrays_ints_and_floats_will_do() {
        let (_dir, path) = written(&|_| {});
        let s = read(&path, true).unwrap().train;
        assert_eq!((s.geometry.detector, s.geometry.volume.shape), ([2, 3], [2, 2, 2]));
        assert_eq!(s.geometry.volume.spacing, [1.0, 1.0, 1.5]);
        // An empty list of test views counts as none.
        let (_dir, path) = written(&|e| e.push(("val", views(&[], [0, 2, 3], 0.0))));
        assert!(read(&path, true).unwrap().test.is_none());
    }

    #[test]
    fn keys_that_move_something_and_are_not_read_are_named() {
        let (_dir, path) = written(&|e| {
            e.push(("rotDetector", Out::Doubles(&[0.0, 0.1, 0.0])));
            e.push(("COR", Out::Int(0)));
            e.push(("noise", Out::Int(1)));
            e.push(("startAngle", Out::Float(30.0)));
            e.push(("comment", Out::Text("tilted")));
        });
        let bytes = fs::read(&path).unwrap();
        let pickle = Pickle::parse("a.pickle", &bytes).unwrap();
        assert_eq!(others(&pickle.top()).unwrap(), ["rotDetector"]);
        assert!(read(&path, true).is_ok());
    }

    #[test]
    fn lying_descriptions_are_refused_in_words() {
        let refused = |change: &dyn Fn(&mut Entries), words: &[&str]| {
            let (_dir, path) = written(change);
            says(read(&path, true), &[&["a.pickle"], words].concat());
        };
        refused(&|e| e[0].1 = Out::Int(1), &["mode", "found 1", "a text"]);
        refused(&|e| e[1].1 = Out::None, &["DSO", "None"]);
        refused(&|e| e[3].1 = Out::Doubles(&[2.0]), &["nDetector", "[1]", "2 numbers"]);
        refused(&|e| e[3].1 = Out::Doubles(&[2.5, 3.0]), &["nDetector", "2.5", "whole"]);
        refused(&|e| e[3].1 = Out::Doubles(&[1e300, 3.0]), &["nDetector", "whole"]);
        refused(&|e| e[5].1 = Out::Doubles(&[2.0, 0.0, 2.0]), &["nVoxel", "at least 1"]);
        refused(&|e| e[5].1 = Out::Doubles(&[4e9, 4e9, 4e9]), &["volume.shape"]);
        refused(&|e| e[6].1 = Out::Doubles(&[1.0, f64::INFINITY, 1.0]), &["dVoxel[1]", "inf"]);
        refused(&|e| e[6].1 = Out::Doubles(&[1e3, 1e3, 1e3]), &["train", "inside the volume"]);
        refused(&|e| e[3].1 = Out::Doubles(&[3.0, 2.0]), &["train.projections", "[2, 2, 3]", "[2, 3, 2]"]);
        refused(&|e| e[3].1 = Out::Doubles(&[4e9, 4e9]), &["train"]);
        refused(&|e| e[8].1 = views(&[0.0], [2, 2, 3], 0.0), &["train.projections", "[1, 2, 3]"]);
        refused(&|e| e[8].1 = views(&[], [0, 2, 3], 0.0), &["train", "at least one view"]);
        refused(&|e| e[8].1 = views(&[0.0, f64::NAN], [2, 2, 3], 0.0), &["train.angles[1]", "NaN"]);
        refused(&|e| e[8].1 = Out::List(vec![]), &["train", "a list of 0", "a dict"]);
        refused(&|e| e.push(("numTrain", Out::Int(3))), &["numTrain", "found 3", "2"]);
        refused(&|e| e.push(("image", Out::Doubles(&[1.0]))), &["image", "[1]", "[2, 2, 2]"]);
        refused(&|e| e.push(("val", views(&[0.0], [1, 2, 2], 0.0))), &["val.projections", "[1, 2, 3]"]);
        refused(&|e| e.push(("offDetector", Out::Doubles(&[1.0, 2.0, 3.0]))), &["offDetector", "[3]", "[v, u]"]);
        let broken = |mm| Out::Dict(vec![("name", Out::Text("x")), ("mm", Out::Float(mm))]);
        refused(&|e| e.push(("unit", broken(0.0))), &["unit.mm"]);
    }
}
