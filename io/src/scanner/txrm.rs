//! Zeiss' and Xradia's TXRM: an OLE compound file with the images of a scan and its geometry.
//!
//! Source of the layout: dxchange (`read_txrm`); of the geometry: CIL (`ZEISSDataReader`). Values are little-endian
//! streams: `ImageInfo/NoOfImages`, `ImageWidth`, `ImageHeight` and `DataType` (5: 16 bits, 10: floats of 32), the
//! images in `ImageData1/Image1` and so on, a hundred to a folder, and the open beam in `ReferenceData/Image`.
//!
//! `StoRADistance` and `DtoRADistance` are the distances of source and detector to the axis in mm, `PixelSize` is the
//! pixel at the axis in micrometres, and `Angles` are those of the object in degrees. The first row is the lowest, as
//! CIL reads it. `Alignment/X-Shifts` and `Y-Shifts` are, for each view, the pixels by which its image belongs further
//! along columns and rows.

use super::Description;
use super::turning::TurningObject;
use super::vendor::{MOST_VIEWS, Open, field_of_view};
use crate::folder::file_name;
use crate::hdf5::ScanPart;
use crate::input::read_up_to;
use crate::memory;
use crate::number::{ByteOrder, Number};
use crate::stack::Names;
use cfb::CompoundFile;
use conefield_core::error::ensure;
use conefield_core::geometry::View;
use conefield_core::{Error, Result, files};
use ndarray::Array3;
use std::fs::File;
use std::path::Path;

/// The start of every OLE compound file.
pub(super) const MAGIC: &[u8] = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1";

/// Images in one folder.
const FOLDER: usize = 100;

const IMAGES: &str = "ImageInfo/NoOfImages";
const TAKEN: &str = "ImageInfo/ImagesTaken";
const FLAT: &str = "ReferenceData/Image";

/// An open file.
struct Txrm {
    place: String,
    /// Bytes on disk.
    size: u64,
    file: CompoundFile<File>,
}

impl Txrm {
    fn open(path: &Path) -> Result<Self> {
        let (file, size) = files::open(path)?;
        let place = path.display().to_string();
        let file =
            CompoundFile::open(file).map_err(|e| Error::invalid(&place, "OLE", e, "a compound file that is whole"))?;
        Ok(Self { place, size, file })
    }

    fn invalid(&self, field: &str, found: impl ToString, expected: impl ToString) -> Error {
        Error::invalid(&self.place, field, found, expected)
    }

    fn has(&self, name: &str) -> bool {
        self.file.is_stream(name)
    }

    /// The first `bytes` bytes of a stream, which must hold as many.
    fn bytes(&mut self, name: &str, bytes: usize) -> Result<Vec<u8>> {
        ensure(self.has(name), &self.place, name, "nothing", format!("{bytes} bytes"))?;
        let read = self.file.open_stream(name).and_then(|mut stream| read_up_to(&mut stream, bytes as u64));
        let raw = read.map_err(|e| self.invalid(name, e, "a stream that can be read"))?;
        ensure(raw.len() == bytes, &self.place, name, format!("{} bytes", raw.len()), format!("{bytes} bytes"))?;
        Ok(raw)
    }

    fn integer(&mut self, name: &str) -> Result<i64> {
        let raw = self.bytes(name, 4)?;
        Ok(i64::from(i32::from_le_bytes([raw[0], raw[1], raw[2], raw[3]])))
    }

    /// A whole number above 0.
    fn whole(&mut self, name: &str, most: usize) -> Result<usize> {
        let found = self.integer(name)?;
        let fits = usize::try_from(found).ok().filter(|n| (1..=most).contains(n));
        fits.ok_or_else(|| self.invalid(name, found, format!("a whole number from 1 to {most}")))
    }

    /// The first `count` floats of a stream.
    fn floats(&mut self, name: &str, count: usize) -> Result<Vec<f64>> {
        let raw = self.bytes(name, count.saturating_mul(4))?;
        let all: Vec<f64> = raw.as_chunks().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect();
        match all.iter().position(|x| !x.is_finite()) {
            Some(i) => Err(self.invalid(&format!("{name}[{i}]"), all[i], "a finite number")),
            None => Ok(all),
        }
    }

    /// A length other than 0; signs say on which side of the axis something is.
    fn length(&mut self, name: &str) -> Result<f64> {
        let found = self.floats(name, 1)?[0].abs();
        if found > 0.0 { Ok(found) } else { Err(self.invalid(name, found, "a length other than 0")) }
    }

    /// Views, rows and columns. An interrupted scan has fewer images than it was to have.
    fn shape(&mut self) -> Result<[usize; 3]> {
        let stated = self.whole(IMAGES, MOST_VIEWS)?;
        let taken = if self.has(TAKEN) { self.whole(TAKEN, MOST_VIEWS)? } else { stated };
        let [rows, columns] = ["ImageInfo/ImageHeight", "ImageInfo/ImageWidth"].map(|n| self.whole(n, 1 << 20));
        Ok([stated.min(taken), rows?, columns?])
    }

    /// How a stream of this type stores a pixel.
    fn number(&mut self, name: &str) -> Result<Number> {
        match self.integer(name)? {
            5 => Ok(Number::U16),
            10 => Ok(Number::F32),
            other => Err(self.invalid(name, other, "5 (16-bit integers) or 10 (32-bit floats)")),
        }
    }

    /// `count` images, which the file must be large enough to hold; `name` gives each one's name.
    fn images(
        &mut self,
        count: usize,
        name: &dyn Fn(usize) -> String,
        number: Number,
        [rows, columns]: [usize; 2],
    ) -> Result<Array3<f32>> {
        let pixels = rows.saturating_mul(columns);
        let bytes = pixels.saturating_mul(number.bytes());
        let all = (count as u64).saturating_mul(bytes as u64);
        let found = format!("{count} images of {rows} x {columns} pixels in a file of {} bytes", self.size);
        ensure(all <= self.size, &self.place, "size", found, format!("a file of at least {all} bytes"))?;
        let mut values: Vec<f32> = Vec::new();
        memory::grow(&mut values, count * pixels, usize::MAX, &self.place, "images")?;
        for i in 0..count {
            let raw = self.bytes(&name(i), bytes)?;
            number.singles(ByteOrder::Little, &raw, &mut values);
        }
        let all = Array3::from_shape_vec((count, rows, columns), values)
            .map_err(|e| self.invalid("images", e, "as many pixels as rows and columns say"))?;
        memory::all_finite(&self.place, all, &|(i, r, c)| format!("{}, row {r}, column {c}", name(i)))
    }
}

/// Views, rows and columns.
pub(super) fn shape(path: &Path) -> Result<[usize; 3]> {
    Txrm::open(path)?.shape()
}

/// The projections or the open beam of `path`.
pub(super) fn read(path: &Path, part: ScanPart) -> Result<Array3<f32>> {
    let mut txrm = Txrm::open(path)?;
    let [count, rows, columns] = txrm.shape()?;
    let size = [rows, columns];
    match part {
        ScanPart::Projections => {
            let number = txrm.number("ImageInfo/DataType")?;
            txrm.images(count, &|i| format!("ImageData{}/Image{}", i / FOLDER + 1, i + 1), number, size)
        }
        ScanPart::Flat => {
            let number = txrm.number("ReferenceData/DataType")?;
            txrm.images(1, &|_| FLAT.to_owned(), number, size)
        }
        ScanPart::Dark => Err(txrm.invalid("dark", "no dark field", "a file that has one")),
    }
}

/// The scan in `path`.
pub(super) fn scan(path: &Path) -> Result<Description> {
    let mut txrm = Txrm::open(path)?;
    for (name, wanted, what) in [
        ("ImageInfo/AcquisitionMode", 0, "projections (0); a reconstructed volume is not read"),
        ("ImageInfo/XrayGeometry", 1, "a cone beam (1); parallel beams are not read"),
    ] {
        if txrm.has(name) {
            let found = txrm.integer(name)?;
            ensure(found == wanted, &txrm.place, name, found, what)?;
        }
    }
    let [count, rows, columns] = txrm.shape()?;
    let mut remarks = Vec::new();
    let stated = txrm.whole(IMAGES, MOST_VIEWS)?;
    if count < stated {
        remarks.push(format!("{count} of {stated} images were taken"));
    }
    let [source, detector] = [txrm.length("ImageInfo/StoRADistance")?, txrm.length("ImageInfo/DtoRADistance")?];
    let at_axis = txrm.length("ImageInfo/PixelSize")? / 1000.0;
    let pixel = at_axis * (source + detector) / source;
    let angles = txrm.floats("ImageInfo/Angles", count)?;
    let mut shifts = |name: &str| if txrm.has(name) { txrm.floats(name, count) } else { Ok(vec![0.0; count]) };
    let [x, y] = [shifts("Alignment/X-Shifts")?, shifts("Alignment/Y-Shifts")?];
    let rest = TurningObject {
        source: [0.0, -source, 0.0],
        detector: [0.0, detector, 0.0],
        u: [pixel, 0.0, 0.0],
        v: [0.0, 0.0, pixel],
        axis: [0.0; 3],
        axis_direction: [0.0, 0.0, 1.0],
    };
    let shifted = |(w, (x, y)): (View, (&f64, &f64))| View {
        detector: std::array::from_fn(|k| w.detector[k] + x * w.u[k] + y * w.v[k]),
        ..w
    };
    let views = rest.views(angles.iter().map(|a| -a)).into_iter().zip(x.iter().zip(&y)).map(shifted).collect();
    let own = Names::One(file_name(path));
    let open = if txrm.has(FLAT) {
        Open::Flat(own.clone())
    } else {
        remarks.push(format!("no {FLAT}: the open beam is estimated from the border of each view"));
        Open::Air
    };
    let aside = x.iter().sum::<f64>() / count as f64 * at_axis;
    let volume = field_of_view(&txrm.place, [rows, columns], [at_axis; 2], aside, &mut remarks)?;
    Ok(Description::of_vendor(own, open, views, [rows, columns], volume, remarks))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{is_integral, is_view, read_scan, read_scanner, says_just};
    use std::collections::BTreeMap;
    use std::io::Write;
    use std::path::PathBuf;

    fn pixel(i: usize, row: usize, column: usize) -> u16 {
        (1000 * (i + 1) + 100 * row + 10 * column) as u16
    }

    fn floats(all: &[f32]) -> Vec<u8> {
        all.iter().flat_map(|x| x.to_le_bytes()).collect()
    }

    /// The streams of three images of 4 x 6 pixels, with a reference of floats.
    fn streams() -> BTreeMap<&'static str, Vec<u8>> {
        let int = |x: i32| x.to_le_bytes().to_vec();
        let image = |i: usize| (0..24).flat_map(|k| pixel(i, k / 6, k % 6).to_le_bytes()).collect();
        let flat: Vec<f32> = (0..24).map(|k| 50_000.0 + k as f32).collect();
        BTreeMap::from([
            (IMAGES, int(3)),
            (TAKEN, int(3)),
            ("ImageInfo/ImageWidth", int(6)),
            ("ImageInfo/ImageHeight", int(4)),
            ("ImageInfo/DataType", int(5)),
            ("ImageInfo/AcquisitionMode", int(0)),
            ("ImageInfo/XrayGeometry", int(1)),
            ("ImageInfo/StoRADistance", floats(&[-20.0; 3])),
            ("ImageInfo/DtoRADistance", floats(&[60.0; 3])),
            ("ImageInfo/PixelSize", floats(&[2.5])),
            ("ImageInfo/Angles", floats(&[0.0, 90.0, -180.0])),
            ("Alignment/X-Shifts", floats(&[0.0, 1.5, 0.0])),
            ("Alignment/Y-Shifts", floats(&[0.0, -2.0, 0.0])),
            ("ImageData1/Image1", image(0)),
            ("ImageData1/Image2", image(1)),
            ("ImageData1/Image3", image(2)),
            ("ReferenceData/DataType", int(10)),
            (FLAT, floats(&flat)),
        ])
    }

    fn written(streams: &BTreeMap<&'static str, Vec<u8>>) -> (tempfile::TempDir, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("bone.txrm");
        let file = File::options().read(true).write(true).create(true).truncate(true).open(&path).unwrap();
        let mut file = CompoundFile::create_with_version(cfb::Version::V3, file).unwrap();
        for (name, bytes) in streams {
            file.create_storage_all(Path::new(name).parent().unwrap()).unwrap();
            file.create_stream(name).unwrap().write_all(bytes).unwrap();
        }
        file.flush().unwrap();
        (dir, path)
    }

    #[test]
    fn a_scan_of_zeiss_is_read() {
        let (_dir, path) = written(&streams());
        let scan = read_scan(&path).unwrap();
        assert_eq!(scan.projections.dim(), (3, 4, 6));
        for (i, row, column) in [(0, 0, 0), (1, 3, 2), (2, 1, 5)] {
            let open = (50_000 + 6 * row + column) as f64;
            is_integral(&scan, [i, row, column], (open / f64::from(pixel(i, row, column))).ln());
        }
        // The pixel is 0.01 mm on the detector. The object turns by 90 degrees, the source by as much the other way.
        let views = &scan.geometry.views;
        is_view(&views[0], [[0.0, -20.0, 0.0], [0.0, 60.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.0, 0.01]]);
        is_view(&views[1], [[-20.0, 0.0, 0.0], [60.0, -0.015, -0.02], [0.0, -0.01, 0.0], [0.0, 0.0, 0.01]]);
        is_view(&views[2], [[0.0, 20.0, 0.0], [0.0, -60.0, 0.0], [-0.01, 0.0, 0.0], [0.0, 0.0, 0.01]]);
        assert_eq!(scan.geometry.volume.shape, [7, 7, 4]);
        assert!((scan.geometry.volume.spacing[0] - 0.0025).abs() < 1e-9);
    }

    #[test]
    fn floats_a_missing_reference_and_an_interrupted_scan_are_read() {
        let mut all = streams();
        all.remove(FLAT);
        all.insert(TAKEN, 2i32.to_le_bytes().to_vec());
        all.insert("ImageInfo/DataType", 10i32.to_le_bytes().to_vec());
        all.insert("ImageData1/Image1", floats(&[0.5; 24]));
        all.insert("ImageData1/Image2", floats(&[0.25; 24]));
        all.remove("Alignment/X-Shifts");
        let (_dir, path) = written(&all);
        let crate::Stored::Counts(counts) = crate::read_scan(&path).unwrap() else { panic!("no counts") };
        assert_eq!(counts.conversion.open, crate::OpenBeam::Air);
        assert_eq!((counts.values.dim(), counts.values[[1, 2, 3]]), ((2, 4, 6), 0.25));
    }

    #[test]
    fn more_than_a_hundred_images_lie_in_several_folders() {
        let mut all = streams();
        let names: Vec<String> = (0..101).map(|i| format!("ImageData{}/Image{}", i / 100 + 1, i + 1)).collect();
        for name in &names {
            all.insert(name.clone().leak(), all["ImageData1/Image2"].clone());
        }
        for (name, value) in [(IMAGES, 101i32), (TAKEN, 101)] {
            all.insert(name, value.to_le_bytes().to_vec());
        }
        all.insert("ImageInfo/Angles", floats(&(0..101).map(|i| i as f32).collect::<Vec<_>>()));
        all.remove("Alignment/X-Shifts");
        all.remove("Alignment/Y-Shifts");
        let (_dir, path) = written(&all);
        assert_eq!(read_scan(&path).unwrap().projections.dim(), (101, 4, 6));
    }

    #[test]
    fn hostile_files_are_refused_in_words() {
        let int = |x: i32| Some(x.to_le_bytes().to_vec());
        // Words that begin with a colon are about the stream itself.
        for (name, bytes, words) in [
            (IMAGES, int(0), ": found 0, expected a whole number from 1 to 1000000"),
            (IMAGES, int(4), "ImageInfo/Angles: found 12 bytes, expected 16 bytes"),
            (IMAGES, Some(vec![1]), ": found 1 bytes, expected 4 bytes"),
            ("ImageInfo/ImageWidth", int(-6), ": found -6, expected a whole number from 1 to 1048576"),
            (
                "ImageInfo/ImageWidth",
                int(1 << 20),
                "size: found 3 images of 4 x 1048576 pixels in a file of SIZE bytes, expected a file of at least 25165824 \
                 bytes",
            ),
            ("ImageInfo/ImageHeight", int(5), "ImageData1/Image1: found 48 bytes, expected 60 bytes"),
            ("ImageInfo/DataType", int(3), ": found 3, expected 5 (16-bit integers) or 10 (32-bit floats)"),
            (
                "ImageInfo/AcquisitionMode",
                int(2),
                ": found 2, expected projections (0); a reconstructed volume is not read",
            ),
            ("ImageInfo/XrayGeometry", int(0), ": found 0, expected a cone beam (1); parallel beams are not read"),
            ("ImageInfo/StoRADistance", None, ": found nothing, expected 4 bytes"),
            ("ImageInfo/DtoRADistance", Some(floats(&[0.0])), ": found 0, expected a length other than 0"),
            (
                "ImageInfo/PixelSize",
                Some(floats(&[f32::NAN])),
                "ImageInfo/PixelSize[0]: found NaN, expected a finite number",
            ),
            (
                "ImageInfo/Angles",
                Some(floats(&[0.0, f32::INFINITY, 1.0])),
                "ImageInfo/Angles[1]: found inf, expected a finite number",
            ),
            ("ImageData1/Image2", None, ": found nothing, expected 48 bytes"),
            ("Alignment/Y-Shifts", Some(floats(&[1.0])), ": found 4 bytes, expected 12 bytes"),
            (
                FLAT,
                Some(floats(&[f32::NAN; 24])),
                "ReferenceData/Image, row 0, column 0: found NaN, expected a finite number",
            ),
            ("ReferenceData/DataType", None, ": found nothing, expected 4 bytes"),
        ] {
            let mut all = streams();
            // As many images as stated.
            all.remove(TAKEN);
            match bytes {
                Some(bytes) => all.insert(name, bytes),
                None => all.remove(name),
            };
            let (dir, path) = written(&all);
            let size = std::fs::metadata(&path).unwrap().len();
            let about = if words.starts_with(':') { name } else { "" };
            let words = format!("bone.txrm: {about}{}", words.replace("SIZE", &size.to_string()));
            says_just(read_scanner(&path, None), dir.path(), &words);
        }
        let (dir, path) = written(&streams());
        let bytes = std::fs::read(&path).unwrap();
        for cut in [0, 8, 600, bytes.len() / 2] {
            std::fs::write(&path, &bytes[..cut]).unwrap();
            assert!(read_scanner(&path, None).unwrap_err().to_string().contains("bone.txrm"), "{cut}");
        }
        drop(dir);
    }
}
