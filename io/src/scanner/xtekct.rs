//! Nikon's scan description `.xtekct`: an INI file next to the folder of its 16-bit TIFFs.
//!
//! Lengths are mm, angles degrees. Source of the meaning of the keys: CIL (`cil.io.NikonDataReader`). The source looks
//! along +y at a detector whose first pixel is at the top right, at the distance `SrcToDetector`. The object rotates at
//! the distance `SrcToObject`, with its axis `ObjectOffsetX` to the left (without that key, computed from the centres
//! of rotation at the top and bottom of the detector and the magnification), rolled about the ray and tilted towards
//! it. `WhiteLevel` is the open-beam count.

use super::turning::TurningObject;
use super::{Description, Files, I0Text, LayoutTable, ValueKind, ValuesTable, Vectors};
use crate::input::LONGEST_TEXT;
use crate::stack::Names;
use crate::table::Numbers;
use conefield_core::files::read_text;
use conefield_core::geometry::{View, VoxelGrid};
use conefield_core::{Error, Result};
use std::collections::HashMap;
use std::path::Path;

/// Most views of a description: a circle in steps of about one second of arc.
const MOST_VIEWS: f64 = 1e6;

/// Whether `path` has the extension of such a file.
pub(crate) fn is_xtekct(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("xtekct"))
}

/// The scan as a description in the terms of `scanner.toml`.
pub(super) fn description(path: &Path) -> Result<Description> {
    let text = read_text(path, LONGEST_TEXT)?;
    let keys = Keys::of(path.display().to_string(), &text)?;
    let whole = |key: &str, most: f64| -> Result<usize> {
        let found = keys.number(key)?;
        let fits = found.fract() == 0.0 && (1.0..=most).contains(&found);
        if fits {
            Ok(found as usize)
        } else {
            Err(keys.invalid(key, found, format!("a whole number from 1 to {most}")))
        }
    };
    let count = whole("Projections", MOST_VIEWS)?;
    let [columns, rows] = [whole("DetectorPixelsX", 1e6)?, whole("DetectorPixelsY", 1e6)?];
    let [column, row] = [keys.length("DetectorPixelSizeX")?, keys.length("DetectorPixelSizeY")?];
    let [object, detector] = [keys.length("SrcToObject")?, keys.length("SrcToDetector")?];
    let [top, bottom] = [keys.or("CentreOfRotationTop", 0.0)?, keys.or("CentreOfRotationBottom", 0.0)?];
    let aside = keys.or("ObjectOffsetX", 0.5 * (top + bottom) * object / detector)?;
    let roll = match keys.or("ObjectRoll", f64::NAN)? {
        x if x.is_nan() => -(top - bottom).atan2(rows as f64 * row),
        degrees => degrees.to_radians(),
    };
    let tilt = -keys.or("ObjectTilt", 0.0)?.to_radians();
    let (first, step) = (keys.number("InitialAngle")?, keys.number("AngularStep")?);
    let rest = TurningObject {
        source: [0.0; 3],
        detector: [0.0, detector, 0.0],
        u: [-column, 0.0, 0.0],
        v: [0.0, 0.0, -row],
        axis: [-aside, object, 0.0],
        // Rx(tilt)·Ry(roll)·z.
        axis_direction: [roll.sin(), -tilt.sin() * roll.cos(), tilt.cos() * roll.cos()],
    };
    let numbers = |v: View| [v.source, v.detector, v.u, v.v].concat();
    let cone_vec = rest.views((0..count).map(|i| first + step * i as f64 - 180.0)).into_iter().map(numbers).collect();
    Ok(Description {
        _format: String::new(),
        _version: 0,
        files: Files { projections: projections(&keys, path, count), flat: None, dark: None },
        circle: None,
        vectors: Some(Vectors { cone_vec: Numbers::List(cone_vec) }),
        rtk: None,
        cil: None,
        layout: LayoutTable::default(),
        values: ValuesTable {
            kind: ValueKind::Counts,
            i0: Some(I0Text::Number(keys.length("WhiteLevel")?)),
            ..ValuesTable::default()
        },
        volume: volume(&keys, [columns, rows], [column, row].map(|x| x * object / detector))?,
        detector: Some([rows, columns]),
    })
}

/// The images: by the names that the description implies, else all of the folder.
fn projections(keys: &Keys, path: &Path, count: usize) -> Names {
    let text = |key| keys.0.get(key).map_or("", |v| v.as_str());
    let folder = match text("InputFolderName") {
        "" => ".",
        name => name,
    };
    let digits = text("InputDigits").parse().unwrap_or(4usize).min(9);
    let name = |i: usize| format!("{folder}/{}{}{i:0digits$}.tif", text("Name"), text("InputSeparator"));
    match path.parent().is_some_and(|p| p.join(name(1)).is_file()) {
        true => Names::Many((1..=count).map(name).collect()),
        false => Names::One(folder.to_owned()),
    }
}

/// The volume in the file, else as many voxels as pixels, with the pixel size at the axis.
fn volume(keys: &Keys, [columns, rows]: [usize; 2], [across, along]: [f64; 2]) -> Result<VoxelGrid> {
    let axes = ["X", "Y", "Z"];
    let named = axes.iter().all(|a| keys.0.contains_key(&format!("Voxels{a}")));
    let (shape, spacing) = if named {
        let numbers =
            |name: &str| -> Result<Vec<f64>> { axes.iter().map(|a| keys.length(&format!("{name}{a}"))).collect() };
        let (n, size) = (numbers("Voxels")?, numbers("VoxelSize")?);
        ([n[0], n[1], n[2]].map(|x| x as usize), [size[0], size[1], size[2]])
    } else {
        ([columns, columns, rows], [across, across, along])
    };
    let grid = VoxelGrid { shape, spacing, center: [0.0; 3] };
    grid.validate(&keys.1)?;
    Ok(grid)
}

/// The keys of all sections, with the file's name.
struct Keys(HashMap<String, String>, String);

impl Keys {
    fn of(place: String, text: &str) -> Result<Self> {
        let mut all = HashMap::new();
        for (i, line) in text.lines().enumerate() {
            let Some((key, value)) = line.split_once('=') else { continue };
            let (key, value) = (key.trim().to_owned(), value.trim().to_owned());
            // Later sections may use the same names for other devices.
            if all.get(&key).is_some_and(|v| *v != value) && KNOWN.contains(&key.as_str()) {
                let at = format!("{place}: line {}", i + 1);
                return Err(Error::invalid(at, key, format!("a second value, {value}"), "one value"));
            }
            all.entry(key).or_insert(value);
        }
        Ok(Self(all, place))
    }

    fn invalid(&self, key: &str, found: impl ToString, expected: impl Into<String>) -> Error {
        Error::invalid(&self.1, key, found, expected)
    }

    fn number(&self, key: &str) -> Result<f64> {
        let Some(text) = self.0.get(key) else { return Err(self.invalid(key, "nothing", "a number")) };
        let found = text.parse::<f64>().ok().filter(|x| x.is_finite());
        found.ok_or_else(|| self.invalid(key, format!("\"{}\"", text.chars().take(60).collect::<String>()), "a number"))
    }

    fn length(&self, key: &str) -> Result<f64> {
        let found = self.number(key)?;
        if found > 0.0 { Ok(found) } else { Err(self.invalid(key, found, "a number above 0")) }
    }

    fn or(&self, key: &str, otherwise: f64) -> Result<f64> {
        if self.0.contains_key(key) { self.number(key) } else { Ok(otherwise) }
    }
}

/// Keys of the geometry: two different values of one are an error.
const KNOWN: &[&str] = &[
    "Projections",
    "WhiteLevel",
    "DetectorPixelsX",
    "DetectorPixelsY",
    "DetectorPixelSizeX",
    "DetectorPixelSizeY",
    "SrcToObject",
    "SrcToDetector",
    "InitialAngle",
    "AngularStep",
];

#[cfg(test)]
mod tests {
    use super::super::{ImportOptions, read_scanner};
    use super::*;
    use conefield_core::geometry::{Millimetres, Radians};
    use std::fs;
    use tiff::encoder::{TiffEncoder, colortype::Gray16};

    const TEXT: &str = "[XTekCT]\nName=bone\nVoxelsX=4\nVoxelSizeX=0.5\nVoxelsY=4\nVoxelSizeY=0.5\nVoxelsZ=3\nVoxelSizeZ=0.75\n\
        InputSeparator=_\nInputFolderName=\nInputDigits=4\nProjections=3\nWhiteLevel=50000\nDetectorPixelsX=5\n\
        DetectorPixelSizeX=2\nDetectorPixelsY=4\nDetectorPixelSizeY=1.5\nSrcToObject=500.000\nSrcToDetector=800\n\
        InitialAngle=30\nAngularStep=120\nCentreOfRotationTop=1.6\nCentreOfRotationBottom=1.6\n[Xrays]\nXraykV=120\n";

    fn written(text: &str) -> (tempfile::TempDir, std::path::PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        for i in 1..=4u16 {
            let file = fs::File::create(dir.path().join(format!("bone_{i:04}.tif"))).unwrap();
            TiffEncoder::new(file).unwrap().write_image::<Gray16>(5, 4, &[10_000 * i; 20]).unwrap();
        }
        let path = dir.path().join("bone.xtekct");
        fs::write(&path, text).unwrap();
        (dir, path)
    }

    #[test]
    fn a_description_of_nikons_becomes_a_scan() {
        let (_dir, path) = written(TEXT);
        let scan = crate::read_scan(&path).unwrap();
        assert_eq!(scan.projections.dim(), (3, 4, 5));
        assert!((scan.projections[[1, 0, 0]] - 2.5f32.ln()).abs() < 1e-6);
        assert_eq!((scan.geometry.volume.shape, scan.geometry.volume.spacing), ([4, 4, 3], [0.5, 0.5, 0.75]));
        assert_eq!(crate::scan_size(&path).unwrap().pixels, 60);
        let mm = Millimetres;
        for (view, i) in scan.geometry.views.iter().zip(0..) {
            // The source starts below; its columns run against ours. The axis is 1 mm to the left: relative to it,
            // source and first pixel are 1 mm to the right.
            let at = Radians(f64::to_radians(30.0 + 120.0 * f64::from(i) - 180.0 - 90.0));
            let want = View::circular(at, mm(500.0), mm(800.0), [mm(1.5), mm(2.0)], [mm(0.0); 2]);
            let (s, c) = at.0.sin_cos();
            let aside = |p: [f64; 3]| [p[0] - s, p[1] + c, p[2]];
            for (found, want) in [
                (view.source, aside(want.source)),
                (view.detector, aside(want.detector)),
                (view.u, want.u.map(|x| -x)),
                (view.v, want.v),
            ] {
                assert!((0..3).all(|k| (found[k] - want[k]).abs() < 1e-9), "{i}: {found:?} {want:?}");
            }
        }
        // Default voxel sizes are the pixel sizes at the axis.
        let without: String = TEXT.lines().filter(|l| !l.starts_with("Voxel")).flat_map(|l| [l, "\n"]).collect();
        let (_dir, path) = written(&without);
        let grid = crate::read_scan(&path).unwrap().geometry.volume;
        assert_eq!((grid.shape, grid.spacing), ([5, 5, 4], [1.25, 1.25, 0.9375]));
    }

    #[test]
    fn what_is_missing_or_wrong_is_named() {
        for (from, to, words) in [
            ("SrcToObject=500.000", "", ["SrcToObject", "nothing"]),
            ("SrcToObject=500.000", "SrcToObject=-5", ["SrcToObject", "above 0"]),
            ("SrcToObject=500.000", "SrcToObject=five", ["SrcToObject", "\"five\""]),
            ("SrcToObject=500.000", "SrcToObject=500\nSrcToObject=400", ["line 19: SrcToObject", "one value"]),
            ("Projections=3", "Projections=1e9", ["Projections", "1000000"]),
            ("Projections=3", "Projections=2.5", ["Projections", "whole number"]),
            ("Projections=3", "Projections=9", ["files.projections[4]", "bone_0005.tif"]),
            ("DetectorPixelsX=5", "DetectorPixelsX=6", ["4 x 5", "4 x 6"]),
            ("VoxelsX=4", "VoxelsX=-4", ["VoxelsX", "above 0"]),
            ("InputFolderName=", "InputFolderName=../elsewhere", ["files.projections", "\"..\""]),
            ("AngularStep=120", "AngularStep=inf", ["AngularStep", "\"inf\""]),
        ] {
            assert!(TEXT.contains(from), "{from}");
            let (_dir, path) = written(&TEXT.replace(from, to));
            let e = read_scanner(&path, &ImportOptions::default()).unwrap_err().to_string();
            assert!(e.contains("bone") && words.iter().all(|w| e.contains(w)), "{words:?} are not all in: {e}");
        }
    }
}
