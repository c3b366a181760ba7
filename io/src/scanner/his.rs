//! HIS, the images of Elekta's XVI and of PerkinElmer's detectors, and the `_Frames.xml` that describes a scan of XVI.
//!
//! Source of the layout and of the geometry: RTK (`HisImageIO`, `ElektaXVI5GeometryXMLFileReader`). A file has a header
//! of 68 bytes and one of the image, whose length it states, and then 16-bit pixels.
//!
//! `_Frames.xml` has an element `Frame` for each image, in the order of the numbers in their names, with `GantryAngle`
//! in degrees and `UCentre` and `VCentre` in mm: minus RTK's shift of the detector along columns and rows, which run up.
//! Distances and the detector's size are fixed: 1000 and 1536 mm, 409.6 mm. The counts of XVI are 65536 less the number
//! stored, and the open beam is 65536; 0 and 65535 are pixels without a count, which RTK takes for air.

use super::Description;
use super::keys::Keys;
use super::vendor::{Open, Response};
use crate::folder;
use crate::folder::folder_of;
use crate::input::{Input, LONGEST_TEXT};
use crate::number::{ByteOrder, Number};
use crate::text::{self, read_foreign};
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use std::path::Path;

/// The type of the file, 0x7000, and the length of its header.
pub(super) const MAGIC: &[u8] = b"\x00\x70\x44\x00";

/// Words that only such a text holds.
pub(super) const MARK: &str = "<UCentre";

const HEADER: usize = 68;

/// The type of 16-bit pixels.
const UNSIGNED_SHORT: usize = 4;

/// Distances from the source to the axis and the detector, and the detector's side, in mm.
const SID: f64 = 1000.0;
const SDD: f64 = 1536.0;
const SIDE: f64 = 409.6;

/// The open beam of XVI.
pub(super) const I0: f32 = 65536.0;

/// Views, rows and columns, and the file after its headers.
fn open(path: &Path) -> Result<([usize; 3], Input)> {
    let mut input = Input::open_plain(path)?;
    let header = input.exactly(HEADER, "header")?;
    input.ensure(header.starts_with(MAGIC), "format", format!("{:02x?} at the start", &header[..4]), "00 70 44 00")?;
    let word = |at: usize| usize::from(u16::from_le_bytes([header[at], header[at + 1]]));
    let [left, top, right, bottom] = [12, 14, 16, 18].map(word);
    let side = |field: &str, from: usize, to: usize| {
        let fits = from <= to;
        fits.then(|| to - from + 1)
            .ok_or_else(|| input.invalid(field, format!("{from} to {to}"), "a last one after the first"))
    };
    let shape = [word(20), side("rows", top, bottom)?, side("columns", left, right)?];
    ensure(shape[0] > 0, &input.place(), "frames", 0, "at least one")?;
    let kind = word(32);
    ensure(kind == UNSIGNED_SHORT, &input.place(), "type of numbers", kind, "4, unsigned 16-bit integers")?;
    input.skip(word(10) as u64, "header of the image")?;
    Ok((shape, input))
}

/// Views, rows and columns.
pub(super) fn shape(path: &Path) -> Result<[usize; 3]> {
    open(path).map(|(shape, _)| shape)
}

/// Shape and numbers as stored.
pub(super) fn read(path: &Path) -> Result<([usize; 3], Vec<f32>)> {
    let (shape, mut input) = open(path)?;
    Ok((shape, input.singles("pixels", shape.iter().product(), Number::U16, ByteOrder::Little)?))
}

/// The scan that `_Frames.xml` at `path` describes.
pub(super) fn scan(path: &Path) -> Result<Description> {
    let text = read_foreign(path, LONGEST_TEXT)?;
    let place = path.display().to_string();
    let document = text::xml(&place, &text, "Elekta's _Frames.xml")?;
    let folder = folder_of(path);
    let images = folder::names(folder, &["his"])?;
    let first = images.first().ok_or_else(|| Error::invalid(&place, "images", "none", "*.his beside the file"))?;
    let [_, rows, columns] = shape(&folder::inside(folder, &place, "images", first)?)?;
    let pixel = [SIDE / rows as f64, SIDE / columns as f64];
    let mut stands = Vec::new();
    for frame in document.descendants().filter(|n| n.tag_name().name() == "Frame") {
        let keys = Keys::below(format!("{place}: frame {}", stands.len() + 1), frame);
        let detector = [-keys.number("UCentre")?, -keys.number("VCentre")?];
        stands.push((keys.number("GantryAngle")?, detector));
    }
    let expected = format!("{}, one for each image (are frames or images missing?)", images.len());
    ensure(stands.len() == images.len(), &place, "frames", stands.len(), expected)?;
    let (size, open) = ([rows, columns], Open::Number(I0.into()));
    let scan = Description::on_gantry(&place, images, open, [SID, SDD], size, pixel, &stands, vec![])?;
    Ok(Description { response: Response::Inverted, ..scan })
}

#[cfg(test)]
mod tests {
    use crate::testing::{damage_is_refused, is_integral, is_view, read_scan, read_scanner, replaced, says_just};
    use std::fmt::Write;
    use std::fs;
    use std::path::PathBuf;

    /// The stored number: dark where it is high.
    fn pixel(i: usize, row: usize, column: usize) -> u16 {
        (20_000 * i + 1000 * row + 100 * column) as u16
    }

    /// An image of 8 x 8 pixels, with a header of 32 bytes.
    fn image(i: usize) -> Vec<u8> {
        let mut words = [0u16; 50];
        words[..4].copy_from_slice(&[0x7000, 68, 100, 0]);
        // The image's header, its sides from 1, one frame, and the type of numbers.
        words[5..11].copy_from_slice(&[32, 1, 1, 8, 8, 1]);
        words[16] = 4;
        let pixels = (0..64).map(|k| pixel(i, k / 8, k % 8));
        words.into_iter().chain(pixels).flat_map(u16::to_le_bytes).collect()
    }

    fn written() -> (tempfile::TempDir, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let mut text =
            "\u{feff}<?xml version=\"1.0\" encoding=\"utf-8\"?>\n<ProjectionSet><Image><kV>120</kV></Image><Frames>\n"
                .to_owned();
        for (i, (angle, u, v)) in FRAMES.iter().enumerate() {
            fs::write(dir.path().join(format!("{:05}.1.3.46.his", i + 1)), image(i)).unwrap();
            writeln!(
                text,
                "<Frame><Seq>{}</Seq><GantryAngle>{angle}</GantryAngle><UCentre>{u}</UCentre><VCentre>{v}</VCentre></Frame>",
                i + 1
            )
            .unwrap();
        }
        let path = dir.path().join("_Frames.xml");
        fs::write(&path, text + "</Frames></ProjectionSet>\n").unwrap();
        (dir, path)
    }

    const FRAMES: [(f64, f64, f64); 3] = [(0.0, 115.0, -2.0), (90.0, 114.0, 1.0), (-90.0, 115.5, 0.0)];

    #[test]
    fn a_scan_of_xvi_is_read() {
        let (_dir, path) = written();
        let scan = read_scan(&path).unwrap();
        assert_eq!(scan.projections.dim(), (3, 8, 8));
        for (i, row, column) in [(0, 1, 0), (1, 7, 3), (2, 2, 6)] {
            let counts = 65536.0 - f64::from(pixel(i, row, column));
            is_integral(&scan, [i, row, column], (65536.0 / counts).ln());
        }
        // 0 is a pixel without a count: air.
        assert!(scan.projections[[0, 0, 0]].abs() < 1e-4);
        // The shifts differ between views, so that these are no circle: rows run up, as RTK's.
        let p = 51.2;
        let views = &scan.geometry.views;
        is_view(&views[0], [[1000.0, 0.0, 0.0], [-536.0, -115.0, 2.0], [0.0, p, 0.0], [0.0, 0.0, p]]);
        is_view(&views[1], [[0.0, 1000.0, 0.0], [114.0, -536.0, -1.0], [-p, 0.0, 0.0], [0.0, 0.0, p]]);
        is_view(&views[2], [[0.0, -1000.0, 0.0], [-115.5, 536.0, 0.0], [p, 0.0, 0.0], [0.0, 0.0, p]]);
        // 409.6 and twice 115.5 mm wide, seen at the axis with pixels of 33.3 mm.
        assert_eq!(scan.geometry.volume.shape, [13, 13, 8]);
    }

    #[test]
    fn hostile_files_are_refused_in_words() {
        let (dir, path) = written();
        let refused =
            |change: &dyn Fn(&mut Vec<u8>), words: &str| damage_is_refused(&path, "00001.1.3.46.his", change, words);
        let set = |at: usize, x: u16| move |b: &mut Vec<u8>| b[at..at + 2].copy_from_slice(&x.to_le_bytes());
        refused(&|b| b.truncate(60), "header: found the end of the file after 60 bytes, expected 68 bytes");
        refused(&set(0, 0x7100), "format: found [00, 71, 44, 00] at the start, expected 00 70 44 00");
        refused(&set(16, 0), "columns: found 1 to 0, expected a last one after the first");
        refused(
            &set(16, 65535),
            "pixels: found 128 bytes of data in the file, expected 1048560 bytes (524280 values of 2 bytes, as the header \
             says)",
        );
        refused(&set(20, 0), "frames: found 0, expected at least one");
        refused(&set(32, 32), "type of numbers: found 32, expected 4, unsigned 16-bit integers");
        refused(
            &set(10, 60000),
            "header of the image: found the end of the file after 160 bytes, expected 60000 bytes",
        );
        for (from, to, words) in [
            ("<UCentre>114</UCentre>", "", "frame 2: UCentre: found nothing, expected a number"),
            ("<GantryAngle>90<", "<GantryAngle>NaN<", "frame 2: GantryAngle: found \"NaN\", expected a number"),
            (
                "</Frames>",
                "<Frame><GantryAngle>1</GantryAngle><UCentre>0</UCentre><VCentre>0</VCentre></Frame></Frames>",
                "frames: found 4, expected 3, one for each image (are frames or images missing?)",
            ),
        ] {
            damage_is_refused(&path, "_Frames.xml", &replaced(from, to), words);
        }
        for i in 1..=3 {
            fs::remove_file(dir.path().join(format!("{i:05}.1.3.46.his"))).unwrap();
        }
        let words = "_Frames.xml: images: found none, expected *.his beside the file";
        says_just(read_scanner(&path, None), dir.path(), words);
    }
}
