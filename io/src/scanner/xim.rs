//! Varian's XIM, the images of TrueBeam, Halcyon and ProBeam, and the `Scan.xml` that describes a scan of them.
//!
//! Source of the layout and of the geometry: RTK (`XimImageIO`, `VarianProBeamGeometryReader`); of the open beam and the
//! monitor: TIGRE (`varian_io`). A file has eight bytes `VMS.XI`, version, columns, rows, bits and bytes per pixel and
//! whether it is compressed (32-bit integers), the pixels, a histogram and properties. Compressed pixels are
//! [`differences`]. Properties have a name, a type and a value: lengths in cm, angles in degrees.
//!
//! `Scan.xml` has the distances `SAD` and `SID` in mm, and lies above `Acquisitions/NUMBER/Proj_*.xim`. The gantry angle
//! in RTK's terms is 180 degrees less `KVSourceRtn`, and the detector is shifted by `KVDetectorLat` along its columns
//! and by `KVDetectorLng` along its rows, which run up. TIGRE's geometry is the same one upside down.
//!
//! The open beam is the mean of `Calibrations/Air-*/…/FilterBowtie*.xim` (`Filter*.xim` for a scan without a bow tie).
//! The chamber before the patient, `KVNormChamber`, measures the beam of each image: counts are brought to that of the
//! open beam.

use super::keys::Keys;
use super::vendor::{Open, Response};
use super::{Description, differences};
use crate::folder;
use crate::folder::folder_of;
use crate::input::Input;
use crate::number::{ByteOrder, Number};
use crate::stack::Names;
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use std::collections::HashMap;
use std::path::Path;

pub(super) const MAGIC: &[u8] = b"VMS.XI";

/// Words that only such a `Scan.xml` holds.
pub(super) const MARK: &str = "<Acquisitions";

/// Longest name of a property, in bytes.
const LONGEST_NAME: usize = 256;

/// Folders below that of `Scan.xml` in which images are looked for.
const DEPTH: usize = 5;

const CHAMBER: &str = "KVNormChamber";

/// What a file says of its image.
pub(super) struct Head {
    place: String,
    /// Rows and columns.
    pub size: [usize; 2],
    /// Properties that are one number.
    numbers: HashMap<String, f64>,
}

impl Head {
    fn number(&self, name: &str) -> Result<f64> {
        let found = self.numbers.get(name).copied().filter(|x| x.is_finite());
        found.ok_or_else(|| {
            let shown = self.numbers.get(name).map_or("nothing".into(), f64::to_string);
            Error::invalid(&self.place, name, shown, "a number among the properties")
        })
    }

    /// A length in mm, above 0.
    fn length(&self, name: &str) -> Result<f64> {
        let found = 10.0 * self.number(name)?;
        ensure(found > 0.0, &self.place, name, found, "a length above 0")?;
        Ok(found)
    }
}

/// The file after its header, rows and columns, and the bytes of a pixel if they are not compressed.
fn open(path: &Path) -> Result<(Input, [usize; 2], Option<usize>)> {
    let mut input = Input::open_plain(path)?;
    let found = input.take(8)?;
    input.ensure(found.starts_with(MAGIC), "format", format!("{found:02x?} at the start"), "VMS.XI")?;
    let [_, columns, rows, _, bytes, compressed] = [
        integer(&mut input, "version")?,
        integer(&mut input, "columns")?,
        integer(&mut input, "rows")?,
        integer(&mut input, "bits per pixel")?,
        integer(&mut input, "bytes per pixel")?,
        integer(&mut input, "compression")?,
    ];
    Ok((input, [rows, columns], (compressed == 0).then_some(bytes)))
}

/// The next 32-bit integer, which is not negative.
fn integer(input: &mut Input, field: &str) -> Result<usize> {
    let raw = input.exactly(4, field)?;
    let found = i32::from_le_bytes([raw[0], raw[1], raw[2], raw[3]]);
    usize::try_from(found).map_err(|_| input.invalid(field, found, "a number that is not negative"))
}

/// A number of bytes, which the rest of the file must hold.
fn length(input: &mut Input, field: &str) -> Result<usize> {
    let found = integer(input, field)?;
    let left = input.left().unwrap_or(0);
    let expected = format!("at most the {left} left in the file");
    input.ensure(found as u64 <= left, field, format!("{found} bytes"), expected)?;
    Ok(found)
}

/// Size and properties of the image `path`.
pub(super) fn head(path: &Path) -> Result<Head> {
    let (mut input, size, bytes) = open(path)?;
    let compressed = bytes.is_none();
    if compressed {
        let table = length(&mut input, "lookup table")?;
        input.skip(table as u64, "lookup table")?;
    }
    let pixels = length(&mut input, "pixels")?;
    input.skip(pixels as u64, "pixels")?;
    if compressed {
        integer(&mut input, "uncompressed size")?;
    }
    let bins = integer(&mut input, "histogram")?;
    input.skip(4 * bins as u64, "histogram")?;
    let mut numbers = HashMap::new();
    // Each takes bytes of the file, which ends.
    for _ in 0..integer(&mut input, "properties")? {
        let longest = integer(&mut input, "length of a property's name")?;
        let expected = format!("at most {LONGEST_NAME}");
        input.ensure(longest <= LONGEST_NAME, "length of a property's name", longest, expected)?;
        let name = String::from_utf8_lossy(&input.exactly(longest, "name of a property")?).into_owned();
        let kind = integer(&mut input, &name)?;
        match kind {
            0 => {
                let raw = input.exactly(4, &name)?;
                numbers.insert(name, f64::from(i32::from_le_bytes([raw[0], raw[1], raw[2], raw[3]])));
            }
            1 => {
                let raw = input.exactly(8, &name)?;
                numbers.extend(raw.as_chunks().0.iter().map(|b| (name.clone(), f64::from_le_bytes(*b))));
            }
            2 | 4 | 5 => {
                let bytes = length(&mut input, &name)?;
                input.skip(bytes as u64, &name)?;
            }
            _ => return Err(input.invalid(format!("type of {name}"), kind, "0, 1, 2, 4 or 5")),
        }
    }
    Ok(Head { place: input.place(), size, numbers })
}

/// Shape and numbers of the image `path`.
pub(super) fn read(path: &Path) -> Result<([usize; 3], Vec<f32>)> {
    let (mut input, [rows, columns], bytes) = open(path)?;
    let shape = [1, rows, columns];
    let Some(bytes) = bytes else {
        let length_of_table = length(&mut input, "lookup table")?;
        let table = input.exactly(length_of_table, "lookup table")?;
        let length_of_pixels = length(&mut input, "pixels")?;
        let packed = input.exactly(length_of_pixels, "pixels")?;
        return Ok((shape, differences::unpack(&input.place(), [rows, columns], &table, &packed)?));
    };
    let number = match bytes {
        1 => Number::U8,
        2 => Number::U16,
        4 => Number::I32,
        _ => return Err(input.invalid("bytes per pixel", bytes, "1, 2 or 4")),
    };
    let count = rows.saturating_mul(columns);
    let (found, wanted) = (length(&mut input, "pixels")?, count.saturating_mul(bytes));
    let expected = format!("{wanted} for {rows} x {columns} pixels");
    ensure(found == wanted, &input.place(), "pixels", format!("{found} bytes"), expected)?;
    Ok((shape, input.part(found as u64).singles("pixels", count, number, ByteOrder::Little)?))
}

/// The scan that the `Scan.xml` at `path` describes.
pub(super) fn scan(path: &Path) -> Result<Description> {
    let keys = Keys::xml(path, "Varian's Scan.xml")?;
    let place = keys.place();
    let [sid, sdd] = [keys.length("SAD")?, keys.length("SID")?];
    let bow_tie = keys.text("Bowtie").is_some_and(|b| !b.eq_ignore_ascii_case("none"));
    let folder = folder_of(path);
    let all = folder::below(folder, DEPTH, &["xim"])?;
    let in_acquisitions = |n: &&String| n.to_lowercase().starts_with("acquisitions/") && name_of(n).starts_with("proj");
    let mut images: Vec<String> = all.iter().filter(in_acquisitions).cloned().collect();
    if images.is_empty() {
        images = all.iter().filter(|n| !n.contains('/') && name_of(n).starts_with("proj")).cloned().collect();
    }
    let start = if bow_tie { "filterbowtie" } else { "filter" };
    let air = |n: &&String| {
        let in_air = n.to_lowercase().split('/').any(|part| part.starts_with("air-"));
        in_air && name_of(n).starts_with(start) && (bow_tie || !name_of(n).starts_with("filterbowtie"))
    };
    let flats: Vec<String> = all.iter().filter(air).cloned().collect();
    let heads = |names: &[String]| -> Result<Vec<Head>> {
        names.iter().map(|n| head(&folder::inside(folder, place, "images", n)?)).collect()
    };
    let (found, open) = (heads(&images)?, heads(&flats)?);
    let mut remarks = Vec::new();
    // The first images of a scan may hold no pixels.
    let (images, found): (Vec<String>, Vec<Head>) =
        images.into_iter().zip(found).filter(|(_, h)| h.size.iter().all(|n| *n > 0)).unzip();
    let first = found.first().ok_or_else(|| {
        keys.invalid("images", "none", "Proj_*.xim with pixels beside Scan.xml or below Acquisitions")
    })?;
    let pixel = [first.length("PixelHeight")?, first.length("PixelWidth")?];
    let stand = |h: &Head| -> Result<_> {
        let detector = [10.0 * h.number("KVDetectorLat")?, 10.0 * h.number("KVDetectorLng")?];
        Ok((180.0 - h.number("KVSourceRtn")?, detector))
    };
    let stands = found.iter().map(stand).collect::<Result<Vec<_>>>()?;
    let (open, response) = if open.is_empty() {
        remarks.push("no open beam in Calibrations/Air-*: it is estimated from the border of each view".to_owned());
        (Open::Air, Response::Counts)
    } else {
        let beam = open.iter().map(|h| h.length(CHAMBER)).sum::<Result<f64>>()? / open.len() as f64;
        let factor = |h: &Head| h.length(CHAMBER).map(|c| (beam / c) as f32);
        (Open::Flat(Names::Many(flats)), Response::Factors(found.iter().map(factor).collect::<Result<_>>()?))
    };
    let scan = Description::on_gantry(place, images, open, [sid, sdd], first.size, pixel, &stands, remarks)?;
    Ok(Description { response, ..scan })
}

/// The name of the file at a relative path, in small letters.
fn name_of(path: &str) -> String {
    path.rsplit('/').next().unwrap_or_default().to_lowercase()
}

#[cfg(test)]
mod tests {
    use super::differences::tests::pack;
    use crate::testing::{damage_is_refused, is_integral, is_view, read_scan, read_scanner, replaced, says_just};
    use std::fs;
    use std::path::PathBuf;

    const SIZE: [usize; 2] = [4, 6];

    /// The pixels of image `i`, without symmetry, with differences of one, two and four bytes.
    fn pixel(i: usize, row: usize, column: usize) -> i32 {
        let steep = if (row, column) == (2, 3) { 70_000 } else { 0 };
        (1000 * (i + 1) + 100 * row + 10 * column + steep) as i32
    }

    fn int(x: i32) -> [u8; 4] {
        x.to_le_bytes()
    }

    /// An image; `numbers` are its properties.
    fn image(i: usize, compressed: bool, numbers: &[(&str, f64)]) -> Vec<u8> {
        let [rows, columns] = SIZE;
        let values: Vec<i32> = (0..rows * columns).map(|k| pixel(i, k / columns, k % columns)).collect();
        let mut out = b"VMS.XI\0\0".to_vec();
        for x in [1, columns as i32, rows as i32, 32, 4, compressed.into()] {
            out.extend(int(x));
        }
        if compressed {
            let (table, packed) = pack(&values, columns);
            out.extend([&int(table.len() as i32)[..], &table, &int(packed.len() as i32), &packed].concat());
            out.extend(int(4 * values.len() as i32));
        } else {
            out.extend(int(4 * values.len() as i32));
            out.extend(values.iter().flat_map(|x| int(*x)));
        }
        // A histogram of two bins; a text, a list of numbers and an integer among the properties.
        out.extend([&int(2)[..], &int(7), &int(8), &int(3 + numbers.len() as i32)].concat());
        out.extend([&int(4)[..], b"Name", &int(2), &int(3), b"abc"].concat());
        out.extend([&int(4)[..], b"List", &int(4), &int(16), &[0; 16]].concat());
        out.extend([&int(5)[..], b"Count", &int(0), &int(7)].concat());
        for (name, x) in numbers {
            out.extend([&int(name.len() as i32)[..], name.as_bytes(), &int(1), &x.to_le_bytes()].concat());
        }
        out
    }

    const SCAN: &str = "<?xml version=\"1.0\"?>\n<Scan xmlns=\"http://baseline.varian.com/schema.xsd\" Version=\"2.7\">\n\
        <Acquisitions><Velocity>6</Velocity><SAD>1000</SAD><SID>1500</SID><Fan>Half</Fan><Bowtie>Half Bowtie</Bowtie>\
        </Acquisitions>\n</Scan>\n";

    /// A scan of three images and an empty one, of which the last is not compressed, with two open beams.
    fn written() -> (tempfile::TempDir, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let put = |name: &str, bytes: &[u8]| {
            let path = dir.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, bytes).unwrap();
        };
        let numbers = |angle: f64, chamber: f64| {
            [
                ("KVSourceRtn", angle),
                ("KVDetectorLat", -16.0),
                ("KVDetectorLng", 0.5),
                ("KVNormChamber", chamber),
                ("PixelWidth", 0.04),
                ("PixelHeight", 0.05),
            ]
        };
        put("Acquisitions/733061622/Proj_00000.xim", &[&b"VMS.XI\0\0"[..], &[0; 40]].concat());
        for (i, (angle, chamber)) in [(90.0, 500.0), (180.0, 250.0), (-30.0, 500.0)].into_iter().enumerate() {
            let name = format!("Acquisitions/733061622/Proj_{:05}.xim", i + 1);
            put(&name, &image(i, i < 2, &numbers(angle, chamber)));
        }
        for (name, i, chamber) in [("FilterBowtie_CC", 9, 900.0), ("FilterBowtie_CW", 19, 1100.0), ("Filter", 50, 1.0)]
        {
            let name = format!("Calibrations/AIR-Half-Bowtie-125KV/Current/{name}.xim");
            put(&name, &image(i, true, &numbers(0.0, chamber)));
        }
        put("Scan.xml", SCAN.as_bytes());
        let path = dir.path().join("Scan.xml");
        (dir, path)
    }

    #[test]
    fn a_scan_of_a_truebeam_is_read() {
        let (_dir, path) = written();
        let scan = read_scan(&path).unwrap();
        assert_eq!(scan.projections.dim(), (3, 4, 6));
        // Rows are flipped: the file's first is the lowest.
        for (i, row, column) in [(0, 0, 0), (1, 3, 5), (2, 2, 3)] {
            let air = 0.5 * f64::from(pixel(9, row, column) + pixel(19, row, column));
            let counts = f64::from(pixel(i, row, column)) * 1000.0 / [500.0, 250.0, 500.0][i];
            is_integral(&scan, [i, 3 - row, column], (air / counts).ln());
        }
        // The gantry stands at 180 degrees less the source's angle; the detector is shifted by -160 mm along u, 5 mm up.
        let views = &scan.geometry.views;
        is_view(&views[0], [[0.0, 1000.0, 0.0], [160.0, -500.0, 5.0], [-0.4, 0.0, 0.0], [0.0, 0.0, -0.5]]);
        is_view(&views[1], [[1000.0, 0.0, 0.0], [-500.0, -160.0, 5.0], [0.0, 0.4, 0.0], [0.0, 0.0, -0.5]]);
        let (s, c) = 210f64.to_radians().sin_cos();
        let detector = [-500.0 * c + 160.0 * s, -500.0 * s - 160.0 * c, 5.0];
        is_view(&views[2], [[1000.0 * c, 1000.0 * s, 0.0], detector, [-0.4 * s, 0.4 * c, 0.0], [0.0, 0.0, -0.5]]);
        // 6 pixels and twice 160 mm, at the axis, in at most 512 voxels.
        let grid = scan.geometry.volume;
        let wide = (6.0 * 0.4 + 320.0) / 1.5;
        assert_eq!(grid.shape, [512, 512, 3]);
        assert!((grid.spacing[0] - wide / 512.0).abs() < 1e-9, "{grid:?}");
    }

    #[test]
    fn without_an_open_beam_it_is_estimated_and_a_scan_without_a_bow_tie_takes_its_own() {
        let (dir, path) = written();
        fs::write(&path, SCAN.replace("Half Bowtie", "None")).unwrap();
        let scan = read_scan(&path).unwrap();
        let want = f64::from(pixel(50, 3, 0)) / (f64::from(pixel(0, 3, 0)) / 500.0);
        is_integral(&scan, [0, 0, 0], want.ln());
        fs::remove_dir_all(dir.path().join("Calibrations")).unwrap();
        let crate::Stored::Counts(counts) = crate::read_scan(&path).unwrap() else { panic!("no counts") };
        assert_eq!(counts.conversion.open, crate::OpenBeam::Air);
        assert_eq!(counts.values[[1, 3, 5]], pixel(1, 3, 5) as f32);
    }

    #[test]
    fn images_stand_in_a_description_too() {
        let (dir, _) = written();
        let views = dir.path().join("Acquisitions/733061622");
        fs::remove_file(views.join("Proj_00000.xim")).unwrap();
        let text = "format = \"conefield-scanner\"\nversion = 1\n[files]\nprojections = \"Acquisitions/733061622\"\n[circle]\n\
                    dso = 1000\ndsd = 1500\npixel = { u = 0.4, v = 0.5 }\nrange_deg = 360\ndirection = \"clockwise\"\n\
                    [values]\ni0 = 100000\n[volume]\nshape = [6, 6, 4]\nspacing = [1.0, 1.0, 1.0]\n";
        fs::write(dir.path().join("scanner.toml"), text).unwrap();
        let scan = read_scan(dir.path()).unwrap();
        is_integral(&scan, [2, 1, 4], (100_000.0 / f64::from(pixel(2, 1, 4))).ln());
    }

    #[test]
    fn hostile_files_are_refused_in_words() {
        let (_dir, path) = written();
        let first = "Acquisitions/733061622/Proj_00001.xim";
        let refused = |change: &dyn Fn(&mut Vec<u8>), words: &str| damage_is_refused(&path, first, change, words);
        let set = |at: usize, x: i32| move |b: &mut Vec<u8>| b[at..at + 4].copy_from_slice(&int(x));
        refused(&|b| b.truncate(20), "bits per pixel: found the end of the file after 0 bytes, expected 4 bytes");
        refused(&|b| b.truncate(5), "format: found [56, 4d, 53, 2e, 58] at the start, expected VMS.XI");
        refused(&set(12, -5), "columns: found -5, expected a number that is not negative");
        refused(
            &set(12, i32::MAX),
            "lookup table: found 5 bytes, expected at least 1610612735 for 4 x 2147483647 pixels",
        );
        refused(&set(16, 400), "lookup table: found 5 bytes, expected at least 599 for 400 x 6 pixels");
        refused(
            &set(16, 2),
            "pixels: found 24 bytes after the last, expected none (the size is wrong, or another file follows)",
        );
        refused(&set(32, 1 << 30), "lookup table: found 1073741824 bytes, expected at most the 321 left in the file");
        refused(&|b| b[36] = 0xff, "lookup table: found the code 3, expected 0, 1 or 2 for one, two or four bytes");
        refused(&|b| b[36..40].fill(0xaa), "pixels: found the end after 14 of 24, expected a difference for each");
        refused(&|b| b.truncate(150), "List: found the end of the file after 1 bytes, expected 4 bytes");
        // Other bytes behind the name of a property and `skip` more.
        let behind = |name: &'static str, skip: usize, bytes: &'static [u8]| {
            move |b: &mut Vec<u8>| {
                let at = b.windows(name.len()).position(|w| w == name.as_bytes()).unwrap() + name.len() + skip;
                b[at..at + bytes.len()].copy_from_slice(bytes);
            }
        };
        let expected = "expected a number among the properties";
        refused(&behind("KVSourceRt", 0, b"X"), &format!("KVSourceRtn: found nothing, {expected}"));
        refused(&behind("KVSourceRtn", 4, &[0xff; 8]), &format!("KVSourceRtn: found NaN, {expected}"));
        refused(&behind("PixelWidth", 4, &[0; 8]), "PixelWidth: found 0, expected a length above 0");
        refused(&behind("Name", 0, &[3]), "type of Name: found 3, expected 0, 1, 2, 4 or 5");
        let third = &first.replace("00001", "00003");
        // It is not compressed.
        damage_is_refused(&path, third, &set(24, 3), "bytes per pixel: found 3, expected 1, 2 or 4");
    }

    #[test]
    fn a_text_without_distances_or_images_is_refused() {
        let (dir, path) = written();
        for (from, to, words) in [
            ("<SAD>1000</SAD>", "", "SAD: found nothing, expected a number"),
            ("1500", "-1500", "SID: found -1500, expected a number above 0"),
            ("1500", "far", "SID: found \"far\", expected a number"),
        ] {
            damage_is_refused(&path, "Scan.xml", &replaced(from, to), words);
        }
        fs::remove_dir_all(dir.path().join("Acquisitions")).unwrap();
        let words =
            "Scan.xml: images: found none, expected Proj_*.xim with pixels beside Scan.xml or below Acquisitions";
        says_just(read_scanner(&path, None), dir.path(), words);
    }
}
