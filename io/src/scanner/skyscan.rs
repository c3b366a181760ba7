//! Bruker's and SkyScan's scan description `.log`: an INI file beside its 16-bit TIFFs.
//!
//! Source of the meaning of the keys: TIGRE (`BrukerDataLoader`); of `Image Pixel Size` and `Postalignment`: the ASTRA
//! toolbox's parser of these files (`SkyScanParser`). Image `i`, numbered from 0, stands at `i` times `Rotation Step`.
//! The scanner names the pixel at the axis, `Image Pixel Size`, which includes binning; at the distance
//! `Camera to Source` it is larger by the magnification. The row `Optical Axis`, counted from the top, is at the height
//! of the source. `Postalignment` shifts the detector along its columns, in pixels; NRecon adds it to its own copy of
//! the file. `Vertical Object Position` moves the object along the axis and changes nothing here.
//!
//! `Rotation Direction` is `CC` or `CW`. TIGRE ignores it: its source turns counterclockwise, and images are as the source
//! sees them. That is `CC` here, and `CW` the opposite. The mirror image of both, a source that turns clockwise and
//! images seen the other way, fits the same images: no open reader says which is true.
//!
//! `Reference Intensity` is the count to which the scanner scales its open beam (`Flat Field Correction=ON`).

use super::Description;
use super::keys::Keys;
use super::vendor::{MOST_PIXELS, MOST_VIEWS, Open, field_of_view};
use crate::folder;
use crate::folder::folder_of;
use crate::stack::Names;
use crate::text::{shortened, unread};
use conefield_core::error::ensure;
use conefield_core::orbit::CircularOrbit;
use conefield_core::{Error, Result};
use std::path::Path;

/// Words that only such a file holds.
pub(super) const MARK: &str = "Object to Source (mm)";

const FILES: &str = "Number of Files";
const ROWS: &str = "Number of Rows";
const COLUMNS: &str = "Number of Columns";
const PIXEL: &str = "Image Pixel Size (um)";
const OBJECT: &str = MARK;
const CAMERA: &str = "Camera to Source (mm)";
const STEP: &str = "Rotation Step (deg)";
const DIRECTION: &str = "Rotation Direction";
const AXIS: &str = "Optical Axis (line)";
const POSTALIGNMENT: &str = "Postalignment";
const REFERENCE: &str = "Reference Intensity";
const TRAJECTORY: &str = "Scanning Trajectory";
const POSITIONS: &str = "Number Of Horizontal Offset Positions";
const PREFIX: &str = "Filename Prefix";

/// Parts of the names of other keys that may move the images against the axis.
const MOVING: &[&str] = &["Image Rotation", "crop origin", "Table Feed"];

/// Keys of the geometry: two different values of one are an error.
const KNOWN: &[&str] = &[
    FILES, ROWS, COLUMNS, PIXEL, OBJECT, CAMERA, STEP, DIRECTION, AXIS, POSTALIGNMENT, REFERENCE, TRAJECTORY, POSITIONS,
];

pub(super) fn scan(path: &Path) -> Result<Description> {
    let keys = Keys::ini(path, KNOWN)?;
    if let Some(found) = keys.text(TRAJECTORY).filter(|t| !t.eq_ignore_ascii_case("round")) {
        let what = format!("{}: {TRAJECTORY} {}", keys.place(), shortened(found));
        return Err(Error::unsupported(what, "only circles are read (ROUND)"));
    }
    if keys.or(POSITIONS, 1.0)? != 1.0 {
        let what = format!("{}: {POSITIONS} above 1", keys.place());
        return Err(Error::unsupported(what, "join the images of the camera's positions to one scan first"));
    }
    let [rows, columns] = [keys.whole(ROWS, MOST_PIXELS)?, keys.whole(COLUMNS, MOST_PIXELS)?];
    let [dso, dsd] = [keys.length(OBJECT)?, keys.length(CAMERA)?];
    ensure(dsd > dso, keys.place(), CAMERA, dsd, format!("more than the {dso} of {OBJECT}"))?;
    // In micrometres, at the axis.
    let at_axis = keys.length(PIXEL)? / 1000.0;
    let pixel = at_axis * dsd / dso;
    let middle = rows as f64 / 2.0;
    let offset = [(middle - keys.or(AXIS, middle)?) * pixel, keys.or(POSTALIGNMENT, 0.0)? * pixel];
    let step = keys.length(STEP)?;
    let sense = match keys.text(DIRECTION) {
        Some("CC") | None => 1.0,
        Some("CW") => -1.0,
        Some(other) => return Err(keys.invalid(DIRECTION, shortened(other), "CC or CW")),
    };
    let mut remarks = Vec::new();
    if keys.text(DIRECTION).is_none() {
        remarks.push(format!("no {DIRECTION}: CC is taken; if it is wrong, the volume is mirrored"));
    }
    remarks.extend(unread(&keys.others(MOVING, KNOWN)));
    let (projections, count) = projections(&keys, path, step, &mut remarks)?;
    let angles = (0..count).map(|i| (sense * step * i as f64).to_radians()).collect();
    let open = match keys.text(REFERENCE) {
        Some(_) => Open::Number(keys.length(REFERENCE)?),
        None => Open::Air,
    };
    let views = CircularOrbit { dso, dsd, pixel: [pixel; 2], offset, angles }.views();
    let aside = offset[1] * dso / dsd;
    let volume = field_of_view(keys.place(), [rows, columns], [at_axis; 2], aside, &mut remarks)?;
    Ok(Description::of_vendor(projections, open, views, [rows, columns], volume, remarks))
}

/// The images, numbered from 0, before the first that completes a turn, and their number. They begin with the prefix in
/// the file or, if they were renamed with it, with the file's own name.
fn projections(keys: &Keys, path: &Path, step: f64, remarks: &mut Vec<String>) -> Result<(Names, usize)> {
    let folder = folder_of(path);
    let all = folder::names(folder, &["tif", "tiff"])?;
    let own = path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let prefix = keys.text(PREFIX).unwrap_or(&own);
    let mut numbered = folder::numbered(&all, prefix);
    // Slices are called after NRecon's copy.
    if numbered.is_empty() && !keys.has("Reconstruction Program") {
        numbered = folder::numbered(&all, &own);
    }
    let stated = keys.whole(FILES, MOST_VIEWS)?;
    let turn = (360.0 / step - 1e-3).ceil() as usize;
    // A scanner counts a last image that it may not keep.
    let count = stated.min(turn).min(if numbered.contains_key(&(stated - 1)) { stated } else { stated.max(2) - 1 });
    if let Some(i) = (0..count).find(|i| !numbered.contains_key(i)) {
        let expected = format!("image {i} of the {count}, such as {prefix}{i:08}.tif");
        return Err(Error::invalid(keys.place(), "images", "none", expected));
    }
    let more = numbered.len() - count;
    if more > 0 {
        let why = if count == turn { "that repeat a full turn" } else { "beyond the number of files" };
        remarks.push(format!("images {why} are not read: {more}"));
    }
    let names = (0..count).filter_map(|i| numbered.remove(&i)).collect();
    Ok((Names::Many(names), count))
}

#[cfg(test)]
mod tests {
    use crate::testing::{
        damage_is_refused, is_integral, is_view, read_scan, read_scanner, replaced, says, says_just, tiff16,
    };
    use conefield_core::orbit::CircularOrbit;
    use std::fs;
    use std::path::PathBuf;

    const TEXT: &str = "[System]\r\nScanner=SkyScan1275\r\nCamera Pixel Size (um)=   40.0\r\n[Acquisition]\r\n\
        Filename Prefix=bone_~00\r\nNumber Of Files=  5\r\nNumber Of Rows= 4\r\nNumber Of Columns= 6\r\n\
        Optical Axis (line)=  1\r\nObject to Source (mm)=50.000\r\nCamera to Source (mm)=200.0\r\n\
        Image Pixel Size (um)=10.0\r\nDepth (bits)=16\r\nReference Intensity=60000\r\nRotation Step (deg)=90.0\r\n\
        Use 360 Rotation=YES\r\nRotation Direction=CC\r\nScanning Trajectory=ROUND\r\n[Reconstruction]\r\n\
        Reconstruction Program=NRecon\r\nPostalignment=-1.50\r\n";

    /// No symmetry: the counts of image `i` tell row and column.
    fn count(i: usize, row: usize, column: usize) -> u16 {
        (10_000 * (i + 1) + 1000 * row + 100 * column) as u16
    }

    fn written(text: &str) -> (tempfile::TempDir, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        for i in 0..5 {
            tiff16(&dir.path().join(format!("bone_~00{i:08}.tif")), [4, 6], |r, c| count(i, r, c));
        }
        tiff16(&dir.path().join("bone_~00_spr.tif"), [2, 2], |_, _| 7);
        let path = dir.path().join("bone_~00.log");
        fs::write(&path, text).unwrap();
        (dir, path)
    }

    #[test]
    fn a_log_becomes_a_scan() {
        let (_dir, path) = written(TEXT);
        let scan = read_scan(&path).unwrap();
        assert_eq!(scan.projections.dim(), (4, 4, 6));
        for (i, row, column) in [(0, 0, 0), (3, 1, 5), (2, 3, 2)] {
            is_integral(&scan, [i, row, column], (60_000.0 / f64::from(count(i, row, column))).ln());
        }
        // The pixel is 0.04 mm on the detector; its middle, row 2, is one row below the optical axis.
        let views = &scan.geometry.views;
        is_view(&views[0], [[50.0, 0.0, 0.0], [-150.0, -0.06, -0.04], [0.0, 0.04, 0.0], [0.0, 0.0, -0.04]]);
        is_view(&views[1], [[0.0, 50.0, 0.0], [0.06, -150.0, -0.04], [-0.04, 0.0, 0.0], [0.0, 0.0, -0.04]]);
        // Shifted by 1.5 pixels, the views see a disc that is 3 pixels wider.
        let grid = scan.geometry.volume;
        assert_eq!((grid.shape, grid.spacing), ([9, 9, 4], [0.01; 3]));
    }

    #[test]
    fn the_direction_and_the_end_of_the_turn_are_those_of_the_file() {
        let degrees = |changes: &[(&str, &str)]| -> Vec<i64> {
            let (_dir, path) = written(&changes.iter().fold(TEXT.to_owned(), |t, (from, to)| t.replace(from, to)));
            let orbit = CircularOrbit::fit(&read_scan(&path).unwrap().geometry.views).unwrap();
            orbit.angles.iter().map(|a| a.to_degrees().round() as i64).collect()
        };
        assert_eq!(degrees(&[]), [0, 90, 180, 270]);
        assert_eq!(degrees(&[("=CC", "=CW")]), [0, -90, -180, -270]);
        assert_eq!(degrees(&[("=90.0", "=45.0")]), [0, 45, 90, 135, 180]);
        assert_eq!(degrees(&[("=90.0", "=100.0")]), [0, 100, 200, 300]);
        // One file more is counted than kept.
        assert_eq!(degrees(&[("=90.0", "=45.0"), ("Files=  5", "Files=  6")]), [0, 45, 90, 135, 180]);
        // Without a prefix of theirs, the images are called after the file.
        let renamed = [("Prefix=bone_~00", "Prefix=old name"), ("Reconstruction Program=NRecon\r\n", "")];
        assert_eq!(degrees(&renamed).len(), 4);
    }

    #[test]
    fn what_is_missing_or_wrong_is_named() {
        let (dir, path) = written(TEXT);
        for (from, to, words) in [
            ("Camera to Source (mm)=200.0", "", "Camera to Source (mm): found nothing, expected a number"),
            (
                "Camera to Source (mm)=200.0",
                "Camera to Source (mm)=20",
                "Camera to Source (mm): found 20, expected more than the 50 of Object to Source (mm)",
            ),
            ("(um)=10.0", "(um)=NaN", "Image Pixel Size (um): found \"NaN\", expected a number"),
            ("(deg)=90.0", "(deg)=-1", "Rotation Step (deg): found -1, expected a number above 0"),
            ("=CC", "=left", "Rotation Direction: found \"left\", expected CC or CW"),
            ("=ROUND", "=HELICAL", "Scanning Trajectory \"HELICAL\": only circles are read (ROUND)"),
            (
                "=ROUND",
                "=ROUND\r\nNumber Of Horizontal Offset Positions=2",
                "Number Of Horizontal Offset Positions above 1: join the images of the camera's positions \
                 to one scan first",
            ),
            (
                "Files=  5",
                "Files=  1e15",
                "Number of Files: found 1000000000000000, expected a whole number from 1 to 1000000",
            ),
            (
                "Rows= 4",
                "Rows= 3",
                "files.projections: found 4 x 6, expected 3 x 6 (rows x columns), as the detector has",
            ),
            (
                "(mm)=50.000",
                "(mm)=50\r\nObject to Source (mm)=60",
                "line 11: Object to Source (mm): found a second value, 60, expected one value",
            ),
        ] {
            damage_is_refused(&path, "bone_~00.log", &replaced(from, to), words);
        }
        let text = TEXT.replace("=ROUND", "=ROUND\r\nImage crop origin X=0\r\nImage Rotation=-0.0380");
        fs::write(&path, text).unwrap();
        let found = super::scan(&path).unwrap().remarks;
        assert_eq!(found[0], "not read, though they may change the geometry: Image Rotation = -0.0380");
        assert_eq!(found[1], "images that repeat a full turn are not read: 1");
        fs::write(&path, TEXT).unwrap();
        fs::remove_file(dir.path().join("bone_~0000000002.tif")).unwrap();
        let words = "bone_~00.log: images: found none, expected image 2 of the 4, such as bone_~0000000002.tif";
        says_just(read_scanner(&path, None), dir.path(), words);
        // Another program's log is no scan.
        fs::write(&path, "Object to Source=5").unwrap();
        says(read_scan(&path), &["bone_~00.log: scan", "a file of another kind"]);
    }
}
