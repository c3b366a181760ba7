//! Nikon's scan description `.xtekct`: an INI file next to the folder of its 16-bit TIFFs.
//!
//! Lengths are mm, angles degrees. Source of the meaning of the keys: CIL (`cil.io.NikonDataReader`). The source looks
//! along +y at a detector whose first pixel is at the top right, at the distance `SrcToDetector`; `DetectorOffsetX`
//! shifts it along its columns, to the left, `DetectorOffsetY` up. The object rotates at the distance `SrcToObject`,
//! with its axis `ObjectOffsetX` to the left (without that key, computed from the centres of rotation at the top and
//! bottom of the detector and the magnification), rolled about the ray and tilted towards it. `WhiteLevel` is the
//! open-beam count.
//!
//! The angles are those of the stage in `_ctdata.txt` or `Name.ang` (rows of a projection's number and its angle, as
//! TIGRE reads them), unless `AngleFile_Use` is `False`; without such a file, even steps.

use super::Description;
use super::keys::Keys;
use super::turning::TurningObject;
use super::vendor::{MOST_PIXELS, MOST_VIEWS, Open, field_of_view};
use crate::folder;
use crate::folder::folder_of;
use crate::input::LONGEST_TEXT;
use crate::stack::Names;
use crate::text::{read_foreign, shortened, unread};
use conefield_core::geometry::VoxelGrid;
use conefield_core::{Error, Result};
use std::path::Path;

/// Share of a step by which measured angles may differ from even steps before a warning.
const UNEVEN: f64 = 0.1;

pub(super) fn scan(path: &Path) -> Result<Description> {
    let keys = Keys::ini(path, KNOWN)?;
    if let Some(unit) = keys.text("Units").filter(|u| !u.eq_ignore_ascii_case("mm")) {
        return Err(keys.invalid("Units", shortened(unit), "mm"));
    }
    let count = keys.whole("Projections", MOST_VIEWS)?;
    let [columns, rows] = [keys.whole("DetectorPixelsX", MOST_PIXELS)?, keys.whole("DetectorPixelsY", MOST_PIXELS)?];
    let [column, row] = [keys.length("DetectorPixelSizeX")?, keys.length("DetectorPixelSizeY")?];
    let [object, detector] = [keys.length("SrcToObject")?, keys.length("SrcToDetector")?];
    let [aside_detector, above] = [keys.or("DetectorOffsetX", 0.0)?, keys.or("DetectorOffsetY", 0.0)?];
    let [top, bottom] = [keys.or("CentreOfRotationTop", 0.0)?, keys.or("CentreOfRotationBottom", 0.0)?];
    let aside = keys.or("ObjectOffsetX", 0.5 * (top + bottom) * object / detector)?;
    let roll = match keys.or("ObjectRoll", f64::NAN)? {
        x if x.is_nan() => -(top - bottom).atan2(rows as f64 * row),
        degrees => degrees.to_radians(),
    };
    let tilt = -keys.or("ObjectTilt", 0.0)?.to_radians();
    let rest = TurningObject {
        source: [0.0; 3],
        detector: [-aside_detector, detector, above],
        u: [-column, 0.0, 0.0],
        v: [0.0, 0.0, -row],
        axis: [-aside, object, 0.0],
        // Rx(tilt)·Ry(roll)·z.
        axis_direction: [roll.sin(), -tilt.sin() * roll.cos(), tilt.cos() * roll.cos()],
    };
    let mut remarks = Vec::new();
    let angles = angles(&keys, path, count, &mut remarks)?;
    let white = keys.length("WhiteLevel")?;
    let projections = projections(&keys, path, count, &mut remarks);
    remarks.extend(unread(&keys.others(MOVING, KNOWN)));
    let at_axis = [row, column].map(|x| x * object / detector);
    let volume = volume(&keys, [rows, columns], at_axis, aside - aside_detector * object / detector, &mut remarks)?;
    let views = rest.views(angles.into_iter().map(|a| a - 180.0));
    Ok(Description::of_vendor(projections, Open::Number(white), views, [rows, columns], volume, remarks))
}

/// The angles of `count` views, in degrees: measured ones, else even steps.
fn angles(keys: &Keys, path: &Path, count: usize, remarks: &mut Vec<String>) -> Result<Vec<f64>> {
    let (first, step) = (keys.number("InitialAngle")?, keys.number("AngularStep")?);
    let even = |i: usize| first + step * i as f64;
    let Some((file, measured)) = measured_angles(keys, path, count, remarks)? else {
        return Ok((0..count).map(even).collect());
    };
    let used = !keys.text("AngleFile_Use").is_some_and(|u| u.eq_ignore_ascii_case("false"));
    // Relative to the first view, within half a turn.
    let off = |(i, a): (usize, &f64)| {
        let off = a - measured[0] - step * i as f64;
        (off - 360.0 * (off / 360.0).round()).abs()
    };
    let most = measured.iter().enumerate().map(off).fold(0.0, f64::max);
    let differ = format!("the angles in {file} differ by up to {most:.3} degrees from steps of {step}");
    if most > UNEVEN * step.abs() {
        let which = if used { "those of the file are used" } else { "the steps are used, as AngleFile_Use says" };
        remarks.push(format!("{differ}; {which}"));
    }
    Ok(if used { measured } else { (0..count).map(even).collect() })
}

/// The first of `_ctdata.txt` and `Name.ang` beside the description, and the angles in it.
fn measured_angles(
    keys: &Keys,
    path: &Path,
    count: usize,
    remarks: &mut Vec<String>,
) -> Result<Option<(String, Vec<f64>)>> {
    let folder = folder_of(path);
    let name = keys.text("Name").unwrap_or_default();
    let names = folder::names(folder, &["txt", "ang"])?;
    let wanted = ["_ctdata.txt".to_owned(), format!("{name}_ctdata.txt"), format!("{name}.ang")];
    let Some(file) = wanted.iter().find_map(|w| names.iter().find(|n| n.eq_ignore_ascii_case(w))) else {
        return Ok(None);
    };
    let path = folder::inside(folder, keys.place(), "angles", file)?;
    let place = path.display().to_string();
    let mut rows: Vec<(usize, f64)> = Vec::new();
    for line in read_foreign(&path, LONGEST_TEXT)?.lines().filter(|l| !l.trim().is_empty()) {
        let mut cells = line.split(|c: char| c.is_whitespace() || c == ':' || c == ';').filter(|c| !c.is_empty());
        let Some(number) = cells.next().and_then(|c| c.parse().ok()) else {
            // The names of columns: rows of numbers before them belong to another table.
            rows.clear();
            continue;
        };
        // Some systems write a decimal comma.
        let angle = cells.next().and_then(|a| a.replace(',', ".").parse().ok()).filter(|a: &f64| a.is_finite());
        let shown = || Error::invalid(&place, format!("projection {number}"), shortened(line), "an angle");
        rows.push((number, angle.ok_or_else(shown)?));
    }
    let mut angles = vec![f64::NAN; count];
    let mut beyond = 0;
    // Projections are numbered from 1; some files number them from 0.
    let first = usize::from(rows.iter().all(|(number, _)| *number > 0));
    for (number, angle) in rows {
        match number.checked_sub(first).and_then(|i| angles.get_mut(i)) {
            Some(at) => *at = angle,
            None => beyond += 1,
        }
    }
    if let Some(i) = angles.iter().position(|a| a.is_nan()) {
        let expected = format!("one for each of the {count} Projections (move the file away to take even steps)");
        return Err(Error::invalid(place, format!("angle of projection {}", i + 1), "none", expected));
    }
    if beyond > 0 {
        remarks.push(format!("{file}: {beyond} angles beyond the {count} Projections are not used"));
    }
    Ok(Some((file.clone(), angles)))
}

/// The images: those that have the name in the description and a number, else all of the folder.
fn projections(keys: &Keys, path: &Path, count: usize, remarks: &mut Vec<String>) -> Names {
    let text = |key| keys.text(key).unwrap_or_default();
    let folder = match text("InputFolderName") {
        "" => ".",
        name => name,
    };
    let start = format!("{}{}", text("Name"), text("InputSeparator"));
    let digits = text("InputDigits").parse().unwrap_or(4usize).min(9);
    let within = folder::within(folder_of(path), keys.place(), "InputFolderName", folder);
    // The reader of the images reports a folder that is not there.
    let all = within.and_then(|f| folder::names(&f, &["tif", "tiff"])).unwrap_or_default();
    let mut numbered = folder::numbered(&all, &start);
    if !numbered.contains_key(&1) {
        return Names::One(folder.to_owned());
    }
    let name = |i: usize| {
        // A missing image is reported with the name that it should have.
        let name = numbered.remove(&i).unwrap_or_else(|| format!("{start}{i:0digits$}.tif"));
        format!("{folder}/{name}")
    };
    let names = (1..=count).map(name).collect();
    if numbered.keys().any(|n| *n > count) {
        let more = numbered.len();
        remarks.push(format!("{more} images beyond the {count} Projections are not read"));
    }
    Names::Many(names)
}

/// The volume in the file, else one as wide as the detector's field of view.
fn volume(
    keys: &Keys,
    detector: [usize; 2],
    at_axis: [f64; 2],
    aside: f64,
    remarks: &mut Vec<String>,
) -> Result<VoxelGrid> {
    let axes = ["X", "Y", "Z"];
    if !axes.iter().all(|a| keys.has(&format!("Voxels{a}"))) {
        return field_of_view(keys.place(), detector, at_axis, aside, remarks);
    }
    let numbers =
        |name: &str| -> Result<Vec<f64>> { axes.iter().map(|a| keys.length(&format!("{name}{a}"))).collect() };
    let (n, size) = (numbers("Voxels")?, numbers("VoxelSize")?);
    let shape = [n[0], n[1], n[2]].map(|x| x as usize);
    let grid = VoxelGrid { shape, spacing: [size[0], size[1], size[2]], center: [0.0; 3] };
    grid.validate(keys.place())?;
    Ok(grid)
}

/// Parts of the names of keys that move something.
const MOVING: &[&str] = &[
    "Offset", "Shift", "Tilt", "Roll", "Pitch", "Yaw", "Skew", "Helic", "Helix", "Translation", "RotationOf",
    "RegionStart",
];

/// Keys of the geometry: two different values of one are an error.
const KNOWN: &[&str] = &[
    "Projections", "WhiteLevel", "DetectorPixelsX", "DetectorPixelsY", "DetectorPixelSizeX", "DetectorPixelSizeY",
    "DetectorOffsetX", "DetectorOffsetY", "SrcToObject", "SrcToDetector", "ObjectOffsetX", "ObjectRoll", "ObjectTilt",
    "CentreOfRotationTop", "CentreOfRotationBottom", "InitialAngle", "AngularStep",
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{is_integral, is_view, read_scan, read_scanner, says, tiff16};
    use conefield_core::geometry::{Millimetres, Radians, View};
    use conefield_core::orbit::CircularOrbit;
    use std::fs;

    const TEXT: &str = "[XTekCT]\nName=bone\nVoxelsX=4\nVoxelSizeX=0.5\nVoxelsY=4\nVoxelSizeY=0.5\nVoxelsZ=3\nVoxelSizeZ=0.75\n\
        InputSeparator=_\nInputFolderName=\nInputDigits=4\nProjections=3\nWhiteLevel=50000\nDetectorPixelsX=5\n\
        DetectorPixelSizeX=2\nDetectorPixelsY=4\nDetectorPixelSizeY=1.5\nSrcToObject=500.000\nSrcToDetector=800\n\
        InitialAngle=30\nAngularStep=120\nCentreOfRotationTop=1.6\nCentreOfRotationBottom=1.6\n[Xrays]\nXraykV=120\n";

    fn written(text: &str) -> (tempfile::TempDir, std::path::PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        for i in 1..=4u16 {
            tiff16(&dir.path().join(format!("bone_{i:04}.tif")), [4, 5], |_, _| 10_000 * i);
        }
        let path = dir.path().join("bone.xtekct");
        fs::write(&path, text).unwrap();
        (dir, path)
    }

    #[test]
    fn a_description_of_nikons_becomes_a_scan() {
        let (_dir, path) = written(TEXT);
        let scan = read_scan(&path).unwrap();
        assert_eq!(scan.projections.dim(), (3, 4, 5));
        is_integral(&scan, [1, 0, 0], 2.5f64.ln());
        assert_eq!((scan.geometry.volume.shape, scan.geometry.volume.spacing), ([4, 4, 3], [0.5, 0.5, 0.75]));
        let mm = Millimetres;
        for (view, i) in scan.geometry.views.iter().zip(0..) {
            // The source starts below; its columns run against ours. The axis is 1 mm to the left: relative to it,
            // source and first pixel are 1 mm to the right.
            let at = Radians(f64::to_radians(30.0 + 120.0 * f64::from(i) - 180.0 - 90.0));
            let want = View::circular(at, mm(500.0), mm(800.0), [mm(1.5), mm(2.0)], [mm(0.0); 2]);
            let (s, c) = at.0.sin_cos();
            let aside = |p: [f64; 3]| [p[0] - s, p[1] + c, p[2]];
            is_view(view, [aside(want.source), aside(want.detector), want.u.map(|x| -x), want.v]);
        }
        // Default voxel sizes are the pixel sizes at the axis, which lies 1 mm beside the middle of 5 columns.
        let without: String = TEXT.lines().filter(|l| !l.starts_with("Voxel")).flat_map(|l| [l, "\n"]).collect();
        let (_dir, path) = written(&without);
        let grid = read_scan(&path).unwrap().geometry.volume;
        assert_eq!((grid.shape, grid.spacing), ([7, 7, 4], [1.25, 1.25, 0.9375]));
    }

    /// The views of `TEXT` with the axis in the middle, after a change.
    fn views(from: &str, to: &str, files: &[(&str, &[u8])]) -> Result<Vec<View>> {
        let text = TEXT.replace("=1.6", "=0").replace(from, to);
        let (dir, path) = written(&text);
        files.iter().for_each(|(name, bytes)| fs::write(dir.path().join(name), bytes).unwrap());
        read_scan(&path).map(|s| s.geometry.views)
    }

    #[test]
    fn the_detectors_offset_moves_it_along_its_columns_and_up_and_the_circle_is_one() {
        let orbit = |from: &str, to: &str| CircularOrbit::fit(&views(from, to, &[]).unwrap()).unwrap();
        let plain = orbit("", "");
        assert_eq!((plain.dso, plain.pixel, plain.offset), (500.0, [1.5, 2.0], [0.0; 2]));
        let moved = orbit("[Xrays]", "DetectorOffsetX=8\nDetectorOffsetY=4.5\n[Xrays]");
        // Columns are reversed to run as on conefield's circles, so that along them is against Nikon's; rows run down.
        assert_eq!((moved.offset[0], moved.angles), (-4.5, plain.angles));
        assert!((moved.offset[1] + 8.0).abs() < 1e-9, "{:?}", moved.offset);
        let others = "DetectorOffsetX=8\nOffsetX=-4\nShuttling=True\nObjectOffsetY=0\n[Xrays]";
        let (_dir, path) = written(&TEXT.replace("[Xrays]", others));
        let found = scan(&path).unwrap().remarks;
        assert!(found.contains(&"not read, though they may change the geometry: OffsetX = -4".to_owned()), "{found:?}");
    }

    #[test]
    fn measured_angles_replace_even_steps() {
        let angles = |from: &str, to: &str, files: &[(&str, &[u8])]| -> Vec<f64> {
            let orbit = CircularOrbit::fit(&views(from, to, files).unwrap()).unwrap();
            orbit.angles.iter().map(|a| (a.to_degrees() + 270.0).rem_euclid(360.0)).collect()
        };
        let near = |found: Vec<f64>, want: [f64; 3]| {
            assert!(found.iter().zip(want).all(|(f, w)| (f - w).abs() < 1e-9), "{found:?} {want:?}");
        };
        near(angles("", "", &[]), [30.0, 150.0, 270.0]);
        let ctdata = b"Projs\tFrames\tExposure\r\n3142\t1\t500\r\nProjection\tAngle(deg)\tTime(s)\r\n\
                       1\t31.5\t0\r\n2\t140\t1\r\n3\t280.25\t2\r\n\r\n";
        near(angles("", "", &[("_ctdata.txt", ctdata)]), [31.5, 140.0, 280.25]);
        // Windows-1252, a decimal comma, another order and a row too many.
        let ang = b"Proj\tAngle(\xb0)\n2:\t140,5\n1:\t31,5\n3:\t280\n4:\t391,5\n";
        near(angles("", "", &[("BONE.ANG", ang)]), [31.5, 140.5, 280.0]);
        near(angles("", "", &[("bone.ang", b"Proj\tAngle\n0\t31\n1\t140\n2\t281\n")]), [31.0, 140.0, 281.0]);
        near(angles("[Xrays]", "[CTPro]\nAngleFile_Use=False\n", &[("bone.ang", ang)]), [30.0, 150.0, 270.0]);
        says(views("", "", &[("bone.ang", b"Proj\n1 31\n2 east\n3 280\n")]), &["projection 2", "2 east"]);
        says(views("", "", &[("bone.ang", b"")]), &["angle of projection 1", "none"]);
    }

    #[test]
    fn texts_of_windows_and_names_in_capitals_are_read() {
        let (dir, path) = written(TEXT);
        fs::create_dir(dir.path().join("Raw")).unwrap();
        for i in 1..=4 {
            let [from, to] = [format!("bone_{i:04}.tif"), format!("Raw/BONE_{i:05}.TIF")];
            fs::rename(dir.path().join(from), dir.path().join(to)).unwrap();
        }
        let text = TEXT.replace("InputFolderName=", "InputFolderName=.\\Raw");
        fs::write(&path, [&b"[XTekCT]\r\nOperatorID=K\xfcndig \xa9\r\n"[..], text.as_bytes()].concat()).unwrap();
        let scan = read_scan(&path).unwrap();
        assert_eq!(scan.projections.dim(), (3, 4, 5));
        is_integral(&scan, [1, 0, 0], 2.5f64.ln());
    }

    #[test]
    fn what_is_missing_or_wrong_is_named() {
        for (from, to, words) in [
            ("[Xrays]", "Units=inch\n[Xrays]", ["Units", "expected mm"]),
            ("SrcToObject=500.000", "SrcToObject=five", ["SrcToObject", "\"five\""]),
            ("Projections=3", "Projections=2.5", ["Projections", "whole number"]),
            ("VoxelsX=4", "VoxelsX=-4", ["VoxelsX", "above 0"]),
        ] {
            assert!(TEXT.contains(from), "{from}");
            let (_dir, path) = written(&TEXT.replace(from, to));
            says(read_scanner(&path, None), &[&["bone"], &words[..]].concat());
        }
    }
}
