//! Writes a volume as a stack: one page per slice along z, rows along y, columns along x, 32-bit floats.
//!
//! All directories come first, then all pixels in one piece, so that the file is written front to back. Above 4 GiB it
//! is a BigTIFF. The first page describes the stack in ImageJ's terms, which `tifffile`, Fiji and napari understand:
//! the number of slices and their distance in mm; the resolution gives the pixel size. ImageJ's terms have no place for
//! directions: a line that only conefield reads holds the affine.

use super::volume::AFFINE;
use crate::affine::{self, Affine};
use crate::file_order::{self, FileOrder};
use conefield_core::error::ensure;
use conefield_core::parts::Voxels;
use conefield_core::{Error, Result};
use std::io::Write;
use std::path::Path;

/// Largest offset in a TIFF that is not a BigTIFF.
const CLASSIC: u64 = u32::MAX as u64;

/// Directory entries per page.
const ENTRIES: u64 = 14;

/// Types of entries.
const TEXT: u16 = 2;
const SHORT: u16 = 3;
const LONG: u16 = 4;
const RATIO: u16 = 5;
const LONG8: u16 = 16;

/// Refuses a shape whose slice does not fit a page: its sides are 32-bit numbers.
pub(crate) fn check_shape(place: &str, shape: [usize; 3]) -> Result<()> {
    let fits = shape.iter().all(|n| u32::try_from(*n).is_ok());
    ensure(fits, place, "shape", format!("{shape:?}"), format!("at most {} along each axis", u32::MAX))
}

pub(crate) fn write(w: &mut dyn Write, path: &Path, voxels: &mut dyn Voxels) -> Result<()> {
    let grid = voxels.grid();
    let place = path.display().to_string();
    check_shape(&place, grid.shape)?;
    let (affine, _) = affine::of(voxels, &place);
    let head = Head::of(grid.shape, grid.spacing, &affine, voxels.hounsfield());
    w.write_all(&head.bytes()).map_err(|e| Error::io(path, e))?;
    file_order::write(w, path, voxels, FileOrder::XFastest)
}

/// Everything before the pixels.
struct Head {
    /// Columns, rows, pages.
    shape: [u64; 3],
    /// Pixels per mm, as a fraction.
    resolution: [[u32; 2]; 2],
    text: String,
    big: bool,
}

impl Head {
    fn of(shape: [usize; 3], spacing: [f64; 3], affine: &Affine, hounsfield: Option<&str>) -> Self {
        let shape = shape.map(|n| n as u64);
        let pages = shape[2];
        let rows: Vec<String> = affine[..3].iter().flatten().map(f64::to_string).collect();
        let values = hounsfield.map_or(String::new(), |hu| format!("values={hu}\n"));
        let text = format!(
            "ImageJ=1.54f\nimages={pages}\nslices={pages}\nunit=mm\nspacing={}\nloop=false\n{values}{AFFINE}={}\n\0",
            spacing[2],
            rows.join(" ")
        );
        // The largest power of ten whose product with the size fits keeps decimal sizes exact.
        let ratio = |s: f64| {
            let fits = |n: &u32| f64::from(*n) * s <= f64::from(u32::MAX);
            let top = (0..10).rev().map(|k| 10u32.pow(k)).find(fits).unwrap_or(1);
            [top, (f64::from(top) * s).round() as u32]
        };
        let head = Self { shape, resolution: [ratio(spacing[0]), ratio(spacing[1])], text, big: false };
        let classic = head.length() + 4 * shape.iter().product::<u64>() <= CLASSIC;
        Self { big: !classic, ..head }
    }

    fn header_bytes(&self) -> u64 {
        if self.big { 16 } else { 8 }
    }

    fn directory_bytes(&self) -> u64 {
        if self.big { 8 + 20 * ENTRIES + 8 } else { 2 + 12 * ENTRIES + 4 }
    }

    /// Offset of the text; the two fractions follow it.
    fn text_at(&self) -> u64 {
        self.header_bytes() + self.shape[2] * self.directory_bytes()
    }

    fn ratios_at(&self) -> u64 {
        (self.text_at() + self.text.len() as u64).next_multiple_of(8)
    }

    /// Bytes before the pixels.
    fn length(&self) -> u64 {
        self.ratios_at() + 16
    }

    fn bytes(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.length() as usize);
        out.extend(b"II");
        if self.big {
            out.extend([43u16, 8, 0].iter().flat_map(|x| x.to_le_bytes()));
        } else {
            out.extend(42u16.to_le_bytes());
        }
        self.offset(&mut out, self.header_bytes());
        for page in 0..self.shape[2] {
            self.directory(&mut out, page);
        }
        out.extend(self.text.as_bytes());
        out.resize(self.ratios_at() as usize, 0);
        out.extend(self.resolution.iter().flatten().flat_map(|x| x.to_le_bytes()));
        out
    }

    fn offset(&self, out: &mut Vec<u8>, at: u64) {
        let bytes = at.to_le_bytes();
        out.extend(if self.big { &bytes[..] } else { &bytes[..4] });
    }

    fn directory(&self, out: &mut Vec<u8>, page: u64) {
        let [columns, rows, pages] = self.shape;
        let page_bytes = 4 * columns * rows;
        let long = if self.big { LONG8 } else { LONG };
        let ratios = self.ratios_at();
        // The text belongs to the first page; the other pages get a shorter one, its end.
        let text = if page == 0 { 0 } else { self.text.len() as u64 - 1 };
        let entries: [(u16, u16, u64, u64); ENTRIES as usize] = [
            (256, LONG, 1, columns),
            (257, LONG, 1, rows),
            (258, SHORT, 1, 32),
            (259, SHORT, 1, 1),
            // Black is zero.
            (262, SHORT, 1, 1),
            (270, TEXT, self.text.len() as u64 - text, if page == 0 { self.text_at() } else { 0 }),
            (273, long, 1, self.length() + page * page_bytes),
            // Samples per pixel.
            (277, SHORT, 1, 1),
            (278, LONG, 1, rows),
            (279, long, 1, page_bytes),
            (282, RATIO, 1, ratios),
            (283, RATIO, 1, ratios + 8),
            // The text names the resolution's unit.
            (296, SHORT, 1, 1),
            // Floats.
            (339, SHORT, 1, 3),
        ];
        if self.big {
            out.extend(ENTRIES.to_le_bytes());
        } else {
            out.extend((ENTRIES as u16).to_le_bytes());
        }
        for (tag, kind, count, value) in entries {
            out.extend(tag.to_le_bytes());
            out.extend(kind.to_le_bytes());
            self.offset(out, count);
            // In a BigTIFF a fraction fits into the value field.
            if self.big && kind == RATIO {
                let [a, b] = self.resolution[usize::from(tag - 282)];
                out.extend([a, b].iter().flat_map(|x| x.to_le_bytes()));
            } else {
                self.offset(out, value);
            }
        }
        let next = self.header_bytes() + (page + 1) * self.directory_bytes();
        self.offset(out, if page + 1 < pages { next } else { 0 });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::says;
    use conefield_core::scan::Volume;
    use ndarray::Array3;

    #[test]
    fn a_stack_comes_back_page_by_page_in_either_size_of_offsets() {
        let volume = Volume::centered(
            Array3::from_shape_fn((4, 3, 2), |(x, y, z)| (x + 10 * y + 100 * z) as f32),
            [0.5, 0.75, 2.0],
        );
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        let (affine, _) = affine::of(&&volume, "a.tif");
        for big in [false, true] {
            let head = Head { big, ..Head::of([4, 3, 2], [0.5, 0.75, 2.0], &affine, Some("HU")) };
            assert_eq!(head.bytes().len() as u64, head.length());
            let mut bytes = head.bytes();
            file_order::write(&mut bytes, &path, &mut &volume, FileOrder::XFastest).unwrap();
            std::fs::write(&path, bytes).unwrap();
            let pages = crate::tiff::read(&path).unwrap().values;
            assert_eq!(pages, volume.data.t().to_owned(), "{big}");
            let back = crate::tiff::read_volume(&path).unwrap();
            assert_eq!((&back.data, back.grid, back.affine), (&volume.data, volume.grid, Some(affine)), "{big}");
        }
        let big = |side| Head::of([side, 1000, 1000], [1.0; 3], &affine, None).big;
        assert!(!big(1000) && big(1100));
        says(check_shape("a.tif", [1 << 33, 1, 1]), &["a.tif: shape", "4294967295"]);
    }
}
