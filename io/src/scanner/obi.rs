//! Varian's HND and HNC, the images of an On-Board Imager, and the `ProjectionInfo.xml` that describes a scan of them.
//!
//! Source of the layouts and of the geometry: RTK (`HndImageIO`, `HncImageIO`, `VarianObiGeometryReader`). Both have one
//! header: text and numbers at fixed places, with the size of the image, the pixel in mm and the gantry angle. HNC has
//! 512 bytes of it and then 16-bit pixels; HND has 1024 and then a table and [`differences`].
//!
//! The text has the distances `CalibratedSAD` and `CalibratedSID` and the shift of the detector,
//! `CalibratedDetectorOffsetX` and `Y`, in mm; with the `FanType` `HalfFan`, `DetectorPosLat` adds to it. The angle and
//! the shifts are RTK's own: columns run along its x, rows up. The image says nothing of the open beam; RTK's number for
//! this detector is taken.

use super::keys::Keys;
use super::vendor::Open;
use super::{Description, differences};
use crate::folder;
use crate::folder::folder_of;
use crate::input::Input;
use crate::number::{ByteOrder, Number};
use conefield_core::Result;
use conefield_core::error::ensure;
use std::path::Path;

/// The start of both formats, and of others that are not read.
pub(super) const MAGIC: &[u8] = b"VARIAN_V";

/// Words that only such a text holds.
pub(super) const MARK: &str = "<CalibratedSAD";

const HNC: &[u8] = b"VARIAN_VA_INTERNAL_HNC";
const HND: &[u8] = b"VARIAN_VA_INTERNAL_HND";

/// Bytes before the data of each.
const HNC_HEADER: usize = 512;
const HND_HEADER: usize = 1024;

/// Where the header keeps what is read of it.
const COLUMNS: usize = 120;
const ROWS: usize = 124;
const PIXEL_X: usize = 352;
const PIXEL_Y: usize = 360;
const ANGLE: usize = 432;

/// Counts of the open beam in RTK (`VarianObiRawImageFilter`).
const I0: f64 = 139_000.0;

/// Folders below that of the text in which images are looked for.
const DEPTH: usize = 2;

/// What a file says of its image.
pub(super) struct Head {
    /// Rows and columns.
    pub size: [usize; 2],
    /// Along rows and columns, in mm.
    pixel: [f64; 2],
    /// The gantry's, in degrees.
    angle: f64,
    compressed: bool,
}

fn open(path: &Path) -> Result<(Head, Input)> {
    let mut input = Input::open_plain(path)?;
    let header = input.exactly(HNC_HEADER, "header")?;
    let compressed = header.starts_with(HND);
    let found = String::from_utf8_lossy(&header[..32]).trim_end_matches('\0').escape_debug().to_string();
    let expected = "VARIAN_VA_INTERNAL_HND or VARIAN_VA_INTERNAL_HNC";
    input.ensure(compressed || header.starts_with(HNC), "format", found, expected)?;
    let whole = |at: usize| u32::from_le_bytes(std::array::from_fn(|k| header[at + k])) as usize;
    let number = |field: &str, at: usize| {
        let found = f64::from_le_bytes(std::array::from_fn(|k| header[at + k]));
        if found.is_finite() { Ok(found) } else { Err(input.invalid(field, found, "a number")) }
    };
    let head = Head {
        size: [whole(ROWS), whole(COLUMNS)],
        pixel: [number("pixel height", PIXEL_Y)?, number("pixel width", PIXEL_X)?],
        angle: number("projection angle", ANGLE)?,
        compressed,
    };
    Ok((head, input))
}

/// What the image `path` says of itself.
pub(super) fn head(path: &Path) -> Result<Head> {
    open(path).map(|(head, _)| head)
}

/// Shape and numbers of the image `path`.
pub(super) fn read(path: &Path) -> Result<([usize; 3], Vec<f32>)> {
    let (Head { size: [rows, columns], compressed, .. }, mut input) = open(path)?;
    let shape = [1, rows, columns];
    if !compressed {
        let count = rows.saturating_mul(columns);
        return Ok((shape, input.singles("pixels", count, Number::U16, ByteOrder::Little)?));
    }
    input.skip((HND_HEADER - HNC_HEADER) as u64, "header")?;
    let left = usize::try_from(input.left().unwrap_or(0)).unwrap_or(usize::MAX);
    let table = rows.saturating_sub(1).saturating_mul(columns) / 4;
    let (found, expected) =
        (format!("{table} bytes, for {rows} x {columns} pixels"), format!("at most the {left} left in the file"));
    ensure(table <= left, &input.place(), "lookup table", found, expected)?;
    let codes = input.exactly(table, "lookup table")?;
    let packed = input.exactly(left - table, "pixels")?;
    Ok((shape, differences::unpack(&input.place(), [rows, columns], &codes, &packed)?))
}

/// The scan that the text `path` describes.
pub(super) fn scan(path: &Path) -> Result<Description> {
    let keys = Keys::xml(path, "Varian's ProjectionInfo.xml")?;
    let place = keys.place();
    let [sid, sdd] = [keys.length("CalibratedSAD")?, keys.length("CalibratedSID")?];
    let half = match keys.text("FanType") {
        Some(fan) if fan.eq_ignore_ascii_case("HalfFan") => keys.number("DetectorPosLat")?,
        Some(_) => 0.0,
        None => return Err(keys.invalid("FanType", "nothing", "HalfFan or FullFan")),
    };
    let detector = [keys.number("CalibratedDetectorOffsetX")? + half, keys.number("CalibratedDetectorOffsetY")?];
    let folder = folder_of(path);
    let images = folder::below(folder, DEPTH, &["hnd", "hnc"])?;
    let heads: Vec<Head> =
        images.iter().map(|n| head(&folder::inside(folder, place, "images", n)?)).collect::<Result<_>>()?;
    let expected = "*.hnd or *.hnc beside the file or in a folder there";
    let first = heads.first().ok_or_else(|| keys.invalid("images", "none", expected))?;
    for (field, x) in [("pixel height", first.pixel[0]), ("pixel width", first.pixel[1])] {
        ensure(x > 0.0, &images[0], field, x, "a length above 0")?;
    }
    let stands: Vec<_> = heads.iter().map(|h| (h.angle, detector)).collect();
    let remark = format!("the files do not state the open beam; {I0} counts are taken, as RTK does (--i0 sets others)");
    let (open, size, pixel) = (Open::Number(I0), first.size, first.pixel);
    Description::on_gantry(place, images, open, [sid, sdd], size, pixel, &stands, vec![remark])
}

#[cfg(test)]
mod tests {
    use super::differences::tests::pack;
    use super::*;
    use crate::testing::{damage_is_refused, is_integral, is_view, read_scan, read_scanner, replaced, says_just};
    use std::fs;
    use std::path::PathBuf;

    const SIZE: [usize; 2] = [5, 4];

    fn pixel(i: usize, row: usize, column: usize) -> i32 {
        let steep = if (row, column) == (2, 3) { 40_000 } else { 0 };
        (2000 * (i + 1) + 300 * row + 10 * column + steep) as i32
    }

    /// An image at the gantry angle `angle`.
    fn image(i: usize, compressed: bool, angle: f64) -> Vec<u8> {
        let [rows, columns] = SIZE;
        let values: Vec<i32> = (0..rows * columns).map(|k| pixel(i, k / columns, k % columns)).collect();
        let mut out = vec![0; if compressed { HND_HEADER } else { HNC_HEADER }];
        let mut put = |at: usize, bytes: &[u8]| out[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, if compressed { b"VARIAN_VA_INTERNAL_HND_1.0" } else { b"VARIAN_VA_INTERNAL_HNC_1.0" });
        put(COLUMNS, &(columns as u32).to_le_bytes());
        put(ROWS, &(rows as u32).to_le_bytes());
        put(PIXEL_X, &0.4f64.to_le_bytes());
        put(PIXEL_Y, &0.5f64.to_le_bytes());
        put(ANGLE, &angle.to_le_bytes());
        if compressed {
            let (table, packed) = pack(&values, columns);
            out.extend([table, packed].concat());
        } else {
            out.extend(values.iter().flat_map(|x| (*x as u16).to_le_bytes()));
        }
        out
    }

    const INFO: &str = "<?xml version=\"1.0\"?>\n<ProjectionInfo><CalibratedSAD>1000.0</CalibratedSAD>\
        <CalibratedSID>1500.0</CalibratedSID><FanType>HalfFan</FanType>\
        <CalibratedDetectorOffsetX>1.5</CalibratedDetectorOffsetX>\
        <CalibratedDetectorOffsetY>-2.0</CalibratedDetectorOffsetY><DetectorPosLat>-148.5</DetectorPosLat>\
        </ProjectionInfo>\n";

    fn written(compressed: bool) -> (tempfile::TempDir, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("Scan0")).unwrap();
        for (i, angle) in [0.0, 90.0, 270.0].into_iter().enumerate() {
            let name = format!("Scan0/Proj_{i:05}.{}", if compressed { "hnd" } else { "hnc" });
            fs::write(dir.path().join(name), image(i, compressed, angle)).unwrap();
        }
        let path = dir.path().join("ProjectionInfo.xml");
        fs::write(&path, INFO).unwrap();
        (dir, path)
    }

    #[test]
    fn scans_of_an_on_board_imager_are_read() {
        for compressed in [true, false] {
            let (_dir, path) = written(compressed);
            let scan = read_scan(&path).unwrap();
            assert_eq!(scan.projections.dim(), (3, 5, 4));
            for (i, row, column) in [(0, 0, 0), (1, 4, 3), (2, 2, 3), (2, 3, 1)] {
                // The file's first row is the lowest.
                is_integral(&scan, [i, 4 - row, column], (139_000.0 / f64::from(pixel(i, row, column))).ln());
            }
            // Half fan: 1.5 - 148.5 mm along u; 2 mm down.
            let views = &scan.geometry.views;
            is_view(&views[0], [[1000.0, 0.0, 0.0], [-500.0, -147.0, -2.0], [0.0, 0.4, 0.0], [0.0, 0.0, -0.5]]);
            is_view(&views[1], [[0.0, 1000.0, 0.0], [147.0, -500.0, -2.0], [-0.4, 0.0, 0.0], [0.0, 0.0, -0.5]]);
            is_view(&views[2], [[0.0, -1000.0, 0.0], [-147.0, 500.0, -2.0], [0.4, 0.0, 0.0], [0.0, 0.0, -0.5]]);
            fs::write(&path, INFO.replace("HalfFan", "FullFan")).unwrap();
            let full = &read_scan(&path).unwrap().geometry;
            is_view(&full.views[0], [[1000.0, 0.0, 0.0], [-500.0, 1.5, -2.0], [0.0, 0.4, 0.0], [0.0, 0.0, -0.5]]);
            assert_eq!(full.volume.shape, [12, 12, 5]);
        }
    }

    #[test]
    fn hostile_files_are_refused_in_words() {
        let [(dir, hnd), (_dir, hnc)] = [true, false].map(written);
        let refused = |change: &dyn Fn(&mut Vec<u8>), words: &str| {
            damage_is_refused(&hnd, "Scan0/Proj_00001.hnd", change, words);
        };
        let set = |at: usize, x: u32| move |b: &mut Vec<u8>| b[at..at + 4].copy_from_slice(&x.to_le_bytes());
        refused(&|b| b.truncate(100), "header: found the end of the file after 100 bytes, expected 512 bytes");
        refused(
            &|b| b[19..22].copy_from_slice(b"HNA"),
            "format: found VARIAN_VA_INTERNAL_HNA_1.0, expected VARIAN_VA_INTERNAL_HND or VARIAN_VA_INTERNAL_HNC",
        );
        let angle = |b: &mut Vec<u8>| b[ANGLE..ANGLE + 8].copy_from_slice(&f64::INFINITY.to_le_bytes());
        refused(&angle, "projection angle: found inf, expected a number");
        refused(
            &set(ROWS, u32::MAX),
            "lookup table: found 4294967294 bytes, for 4294967295 x 4 pixels, expected at most the 51 left in the file",
        );
        refused(&set(ROWS, 1), "size: found 1 x 4 pixels, expected at least two rows of a pixel");
        refused(&set(ROWS, 6), "pixels: found the end after 19 of 24, expected a difference for each");
        refused(&|b| b.truncate(1030), "pixels: found 2 bytes, expected at least 35 for 5 x 4 pixels");
        let words = "pixels: found 40 bytes of data in the file, expected 42949672950 bytes (21474836475 values of 2 bytes, \
                     as the header says)";
        damage_is_refused(&hnc, "Scan0/Proj_00001.hnc", &set(COLUMNS, u32::MAX), words);
        for (from, to, words) in [
            (
                "<CalibratedSAD>1000.0</CalibratedSAD>",
                "<CalibratedSAD/>",
                "CalibratedSAD: found \"\", expected a number",
            ),
            ("1500.0", "NaN", "CalibratedSID: found \"NaN\", expected a number"),
            ("<FanType>HalfFan</FanType>", "", "FanType: found nothing, expected HalfFan or FullFan"),
            ("<DetectorPosLat>-148.5</DetectorPosLat>", "", "DetectorPosLat: found nothing, expected a number"),
            (
                "</ProjectionInfo>",
                "",
                "XML: found the root node was opened but never closed, expected Varian's ProjectionInfo.xml",
            ),
        ] {
            damage_is_refused(&hnd, "ProjectionInfo.xml", &replaced(from, to), words);
        }
        fs::remove_dir_all(dir.path().join("Scan0")).unwrap();
        let words =
            "ProjectionInfo.xml: images: found none, expected *.hnd or *.hnc beside the file or in a folder there";
        says_just(read_scanner(&hnd, None), dir.path(), words);
    }
}
