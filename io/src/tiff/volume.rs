//! Reads a stack of slices as a volume: the pages of one file, or a folder with one file per slice.
//!
//! Voxel sizes are read where ImageJ's text on the first page states their unit; the affine where conefield's writer
//! has added it.

use super::images::entry;
use super::{Pages, stack, values};
use crate::affine::{self, Affine};
use crate::{file_order, folder, text};
use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::Volume;
use conefield_core::{Error, Result, allowance};
use ndarray::{Array3, s};
use std::path::Path;
use tiff::decoder::ifd::Value;
use tiff::tags::Tag;

/// Key of the affine in the text of the first page: twelve numbers, row by row, RAS in mm.
pub(super) const AFFINE: &str = "affine";

/// Reads the pages of one file as slices along z, with rows along y and columns along x. The affine is RAS, in mm, and
/// `grid.center` is `[0, 0, 0]`. Without voxel sizes they are 1 mm, and the affine is `None`.
pub(crate) fn read_volume(path: &Path) -> Result<Volume> {
    let place = path.display().to_string();
    let mut text = StackText::default();
    let (pages, images) = stack(path, &mut |decoder| text = StackText::of(decoder))?;
    let (slices, rows, columns) = pages.dim();
    if let Some(n) = images.claim.map(|c| c.volumes).filter(|n| *n > 1) {
        let found = format!("{n} channels or points in time");
        return Err(Error::invalid(place, "ImageDescription", found, "1: one volume, one number per voxel"));
    }
    let (grid, affine) = text.place_of_voxels(&place, [columns, rows, slices])?;
    file_order::read(&place, grid, affine, pages.into_raw_vec_and_offset().0)
}

/// Whether there is a TIFF file in `folder`, by its name.
pub(crate) fn is_stack(folder: &Path) -> bool {
    slices(folder).is_ok_and(|names| !names.is_empty())
}

/// Number of voxels of [`read_folder`], from the directories of its files.
pub(crate) fn folder_voxels(folder: &Path) -> Result<u64> {
    let place = folder.display().to_string();
    slices(folder)?
        .iter()
        .try_fold(0u64, |sum, name| Ok(sum.saturating_add(values(&folder::inside(folder, &place, "slices", name)?)?)))
}

/// Reads the TIFF files of `folder`, in the order of the numbers in their names, as slices along z; otherwise like
/// [`read_volume`].
pub(crate) fn read_folder(folder: &Path) -> Result<Volume> {
    let place = folder.display().to_string();
    let names = slices(folder)?;
    text::warn(&place, folder::oddity(&names));
    // Claims are checked against file sizes here, before memory for all files is allocated.
    let voxels = usize::try_from(folder_voxels(folder)?).unwrap_or(usize::MAX);
    allowance::numbers(&place, "slices", voxels)?;
    let mut text = StackText::default();
    let (mut data, mut sample) = (None::<Array3<f32>>, None);
    for (z, name) in names.iter().enumerate() {
        let path = folder::inside(folder, &place, "slices", name)?;
        let (slice, images) = stack(&path, &mut |decoder| {
            if z == 0 {
                text = StackText::of(decoder);
            }
        })?;
        let (pages, rows, columns) = slice.dim();
        let invalid = |field: &str, found: String, expected: String| {
            Err(Error::invalid(path.display().to_string(), field, found, expected))
        };
        let numbers = *sample.get_or_insert(images.sample);
        if images.sample != numbers {
            return invalid("numbers", images.sample.to_string(), format!("{numbers}, as in {}", names[0]));
        }
        if pages != 1 {
            return invalid("pages", pages.to_string(), "1: one slice per file, or all slices in one file".into());
        }
        let data = match &mut data {
            Some(data) => data,
            // The claims of all files, which must then be equal, are as many.
            None if Some(voxels) == rows.checked_mul(columns).and_then(|n| n.checked_mul(names.len())) => {
                data.insert(Array3::zeros([columns, rows, names.len()]))
            }
            None => {
                let found = format!("{} files like {name} ({rows} x {columns} pixels), {voxels} pixels", names.len());
                return Err(Error::invalid(&place, "slices", found, "files of one size, one page each"));
            }
        };
        if [columns, rows] != data.shape()[..2] {
            let expected = format!("{} x {} pixels, as in {}", data.shape()[1], data.shape()[0], names[0]);
            return invalid("image", format!("{rows} x {columns} pixels"), expected);
        }
        data.slice_mut(s![.., .., z]).assign(&slice.slice(s![0, .., ..]).t());
    }
    let Some(data) = data else {
        return Err(Error::invalid(place, "slices", "no TIFF file", "one TIFF file per slice"));
    };
    let [x, y, z] = [0, 1, 2].map(|k| data.shape()[k]);
    let (grid, affine) = text.place_of_voxels(&place, [x, y, z])?;
    Ok(Volume { data, grid, affine })
}

/// The names of the TIFF files in `folder`, in the order of their numbers.
fn slices(folder: &Path) -> Result<Vec<String>> {
    folder::names(folder, &["tif", "tiff"])
}

/// Description of the voxels on the first page.
#[derive(Default)]
struct StackText {
    /// ImageJ's lines; empty for another program's file.
    text: String,
    /// Columns and rows per unit of length.
    resolution: [Option<f64>; 2],
}

impl StackText {
    /// A tag that is damaged or of another type counts as absent: the slices do not depend on it.
    fn of(decoder: &mut Pages) -> Self {
        let mut tag = |tag| decoder.find_tag(tag).ok().flatten();
        let text = tag(Tag::ImageDescription).and_then(|v| v.into_string().ok());
        let ratio = |v: Option<Value>| match v? {
            Value::Rational(a, b) => Some(f64::from(a) / f64::from(b)),
            _ => None,
        };
        let resolution = [ratio(tag(Tag::XResolution)), ratio(tag(Tag::YResolution))];
        Self { text: text.filter(|t| t.starts_with("ImageJ=")).unwrap_or_default(), resolution }
    }

    /// The voxel sizes in mm, if the file states all of them.
    fn spacing(&self) -> Option<[f64; 3]> {
        let mm = match entry(&self.text, "unit")? {
            "mm" | "millimeter" => 1.0,
            "cm" => 10.0,
            "m" => 1000.0,
            "um" | "µm" | "μm" | "\\u00B5m" | "micron" | "microns" => 0.001,
            "nm" => 1e-6,
            "inch" => 25.4,
            _ => return None,
        };
        // ImageJ leaves out a distance of 1 between the slices of a stack.
        let number = |name| entry(&self.text, name)?.parse::<f64>().ok();
        let between = number("spacing").or_else(|| number("images").filter(|n| *n > 1.0).map(|_| 1.0))?;
        let [x, y] = self.resolution;
        let spacing = [mm / x?, mm / y?, mm * between];
        spacing.iter().all(|s| s.is_finite() && *s > 0.0).then_some(spacing)
    }

    /// The affine that conefield wrote, if it has voxels of about `spacing`: other programs may have rescaled the image
    /// since.
    fn affine(&self, spacing: [f64; 3]) -> Option<Affine> {
        let numbers: Option<Vec<f64>> =
            entry(&self.text, AFFINE)?.split_ascii_whitespace().map(|t| t.parse().ok()).collect();
        let rows: [f64; 12] = numbers?.try_into().ok()?;
        let row = |i: usize| [rows[4 * i], rows[4 * i + 1], rows[4 * i + 2], rows[4 * i + 3]];
        let affine = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
        (affine::is_regular(&affine) && affine::fits(&affine, spacing)).then_some(affine)
    }

    /// The grid of `shape` voxels, and the affine.
    fn place_of_voxels(&self, place: &str, shape: [usize; 3]) -> Result<(VoxelGrid, Option<Affine>)> {
        let mut grid = VoxelGrid { shape, spacing: self.spacing().unwrap_or([1.0; 3]), center: [0.0; 3] };
        grid.validate(place)?;
        let affine = self.spacing().map(|spacing| self.affine(spacing).unwrap_or_else(|| affine::centred(&grid)));
        // The resolution is a fraction of 32-bit numbers: the affine is more exact.
        if let Some(affine) = &affine {
            grid.spacing = affine::spacing(affine);
        }
        Ok((grid, affine))
    }
}

#[cfg(test)]
mod tests {
    use crate::testing::says;
    use crate::{is_volume, read_volume, volume_voxels};
    use std::fs::File;
    use std::path::Path;
    use tiff::encoder::{Rational, TiffEncoder, colortype::Gray16};
    use tiff::tags::Tag;

    /// Pages of 3 x 2 pixels, with a text on the first one.
    fn write(path: &Path, pages: u16, text: Option<&str>) {
        let mut w = TiffEncoder::new(File::create(path).unwrap()).unwrap();
        for page in 0..pages {
            let mut image = w.new_image::<Gray16>(3, 2).unwrap();
            if let Some(text) = text {
                image.encoder().write_tag(Tag::ImageDescription, text).unwrap();
                image.encoder().write_tag(Tag::XResolution, Rational { n: 4, d: 1 }).unwrap();
                image.encoder().write_tag(Tag::YResolution, Rational { n: 1, d: 2 }).unwrap();
            }
            let data: Vec<u16> = (0..6).map(|i| 10 * page + i).collect();
            image.write_data(&data).unwrap();
        }
    }

    #[test]
    fn voxel_sizes_are_those_of_imagej_or_1_mm() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        let known = |spacing: [f64; 3]| (spacing, true);
        for (text, want) in [
            (None, ([1.0; 3], false)),
            (Some("a microscope"), ([1.0; 3], false)),
            (Some("ImageJ=1.54f\nimages=2\nunit=pixel\nspacing=3"), ([1.0; 3], false)),
            (Some("ImageJ=1.54f\nimages=2\nunit=mm\nspacing=3"), known([0.25, 2.0, 3.0])),
            (Some("ImageJ=1.54f\nimages=2\nunit=mm"), known([0.25, 2.0, 1.0])),
            (Some("ImageJ=1.54f\nimages=2\nunit=cm\nspacing=0.5"), known([2.5, 20.0, 5.0])),
            (Some("ImageJ=1.54f\nimages=2\nunit=mm\nspacing=-1"), ([1.0; 3], false)),
            // Rescaled since conefield wrote it.
            (
                Some("ImageJ=1.54f\nimages=2\nunit=mm\nspacing=3\naffine=9 0 0 0 0 9 0 0 0 0 9 0\n"),
                known([0.25, 2.0, 3.0]),
            ),
            (
                Some("ImageJ=1.54f\nimages=2\nunit=mm\nspacing=3\naffine=inf 0 0 0 0 9 0 0 0 0 9\n"),
                known([0.25, 2.0, 3.0]),
            ),
        ] {
            write(&path, 2, text);
            let v = read_volume(&path).unwrap();
            assert_eq!(v.grid.shape, [3, 2, 2]);
            assert_eq!((v.data[[2, 0, 0]], v.data[[0, 1, 0]], v.data[[1, 1, 1]]), (2.0, 3.0, 14.0));
            assert_eq!((v.grid.spacing, v.affine.is_some()), want, "{text:?}");
        }
        write(&path, 2, Some("ImageJ=1.54f\nimages=2\nchannels=2\n"));
        says(read_volume(&path), &["a.tif: ImageDescription: found 2 channels"]);
        write(&path, 2, Some("ImageJ=1.54f\nimages=3\n"));
        says(read_volume(&path), &["a.tif: images: found 3", "expected 2"]);
    }

    #[test]
    fn a_folder_of_slices_is_read_in_the_order_of_their_numbers() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        assert!(!is_volume(dir.path()));
        for (name, value) in [("s2.tif", 20u16), ("s10.TIFF", 100), ("s1.tif", 10)] {
            let mut w = TiffEncoder::new(File::create(at(name)).unwrap()).unwrap();
            w.write_image::<Gray16>(3, 2, &[value, 1, 2, 3, 4, 5]).unwrap();
        }
        std::fs::write(at("log.txt"), "any").unwrap();
        let v = read_volume(dir.path()).unwrap();
        assert_eq!((v.grid.shape, v.grid.spacing, v.affine), ([3, 2, 3], [1.0; 3], None));
        assert_eq!(v.data.slice(ndarray::s![0, 0, ..]).to_vec(), [10.0, 20.0, 100.0]);
        assert_eq!(v.data.slice(ndarray::s![.., 1, 0]).to_vec(), [3.0, 4.0, 5.0]);
        assert!(is_volume(dir.path()) && v.data.is_standard_layout());
        assert_eq!(volume_voxels(dir.path()).unwrap(), 18);
        // The folder of a scan is not a volume.
        std::fs::write(at("scanner.toml"), "").unwrap();
        assert!(!is_volume(dir.path()));
        let refused = |words: &[&str]| {
            says(read_volume(dir.path()), words);
        };
        refused(&["volume", "the folder of a scan"]);
        std::fs::remove_file(at("scanner.toml")).unwrap();

        write(&at("s3.tif"), 2, None);
        refused(&["slices", "4 files like s1.tif"]);
        let mut w = TiffEncoder::new(File::create(at("s3.tif")).unwrap()).unwrap();
        w.write_image::<Gray16>(2, 3, &[0; 6]).unwrap();
        drop(w);
        refused(&["s3.tif: image", "3 x 2 pixels", "2 x 3 pixels, as in s1.tif"]);
        std::fs::write(at("s3.tif"), "no image").unwrap();
        refused(&["s3.tif", "TIFF"]);
    }
}
