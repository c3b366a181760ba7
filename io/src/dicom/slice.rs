//! The part of a series' file that a volume needs.

use super::lengths::{self, PixelStorage};
use super::pixels::{self, PixelFormat};
use crate::folder::file_name;
use conefield_core::error::ensure;
use conefield_core::geometry::{dot, norm};
use conefield_core::{Error, Result, allowance, files};
use dicom_object::{DefaultDicomObject, InMemDicomObject, OpenFileOptions, Tag};
use std::io::Read;
use std::path::{Path, PathBuf};

/// A tag with its name in errors.
pub(super) type Attribute = (Tag, &'static str);

pub(super) const PIXEL_DATA: Attribute = (Tag(0x7fe0, 0x0010), "PixelData");
const SERIES: Attribute = (Tag(0x0020, 0x000e), "SeriesInstanceUID");
const SERIES_NAME: Attribute = (Tag(0x0008, 0x103e), "SeriesDescription");
const MODALITY: Attribute = (Tag(0x0008, 0x0060), "Modality");
const ORIENTATION: Attribute = (Tag(0x0020, 0x0037), "ImageOrientationPatient");
const POSITION: Attribute = (Tag(0x0020, 0x0032), "ImagePositionPatient");
const SPACING: Attribute = (Tag(0x0028, 0x0030), "PixelSpacing");
const THICKNESS: Attribute = (Tag(0x0018, 0x0050), "SliceThickness");
const BETWEEN: Attribute = (Tag(0x0018, 0x0088), "SpacingBetweenSlices");
const SLOPE: Attribute = (Tag(0x0028, 0x1053), "RescaleSlope");
const INTERCEPT: Attribute = (Tag(0x0028, 0x1052), "RescaleIntercept");
const ROWS: Attribute = (Tag(0x0028, 0x0010), "Rows");
const COLUMNS: Attribute = (Tag(0x0028, 0x0011), "Columns");
const SAMPLES: Attribute = (Tag(0x0028, 0x0002), "SamplesPerPixel");
pub(super) const FRAMES: Attribute = (Tag(0x0028, 0x0008), "NumberOfFrames");
const ALLOCATED: Attribute = (Tag(0x0028, 0x0100), "BitsAllocated");
const STORED: Attribute = (Tag(0x0028, 0x0101), "BitsStored");
const HIGH: Attribute = (Tag(0x0028, 0x0102), "HighBit");
const SIGN: Attribute = (Tag(0x0028, 0x0103), "PixelRepresentation");

/// One slice without its values; lengths in mm, directions in LPS.
#[derive(Debug)]
pub(super) struct Slice {
    path: PathBuf,
    /// The byte after the pixels.
    end: u64,
    /// Its place in a file of several.
    pub frame: usize,
    pub series: String,
    /// Modality and description of the series, for messages.
    pub about: String,
    pub modality: String,
    /// Unit vectors along a row (to the next column) and down a column (to the next row).
    pub axes: [[f64; 3]; 2],
    /// Centre of the first pixel.
    pub position: [f64; 3],
    /// Distance from row to row and from column to column.
    pub spacing: [f64; 2],
    thickness: Option<f64>,
    rescale: [f64; 2],
    pub format: PixelFormat,
}

/// The elements of an open file.
pub(super) struct Elements<'a> {
    pub place: &'a str,
    pub object: &'a InMemDicomObject,
}

impl Elements<'_> {
    pub fn invalid(&self, field: Attribute, found: impl ToString, expected: &str) -> Error {
        Error::invalid(self.place, field.1, found, expected)
    }

    pub fn ensure(&self, ok: bool, field: Attribute, found: impl ToString, expected: &str) -> Result<()> {
        ensure(ok, self.place, field.1, found, expected)
    }

    fn text(&self, field: Attribute) -> Option<String> {
        let text = self.object.get(field.0)?.to_str().ok()?;
        Some(text.trim_end_matches(['\0', ' ']).trim_start().to_owned()).filter(|t| !t.is_empty())
    }

    /// `N` finite numbers, or `None` if the element is missing.
    fn numbers<const N: usize>(&self, field: Attribute) -> Result<Option<[f64; N]>> {
        let Some(element) = self.object.get(field.0).filter(|e| e.value().multiplicity() > 0) else { return Ok(None) };
        let expected = || format!("{N} finite numbers");
        let all = element.to_multi_float64().map_err(|e| self.invalid(field, e, &expected()))?;
        match <[f64; N]>::try_from(all) {
            Ok(n) if n.iter().all(|x| x.is_finite()) => Ok(Some(n)),
            Ok(n) => Err(self.invalid(field, format!("{n:?}"), &expected())),
            Err(n) => Err(self.invalid(field, format!("{} numbers", n.len()), &expected())),
        }
    }

    fn required<const N: usize>(&self, field: Attribute) -> Result<[f64; N]> {
        self.numbers(field)?.ok_or_else(|| self.invalid(field, "no such element", &format!("{N} numbers")))
    }

    fn whole(&self, field: Attribute) -> Result<Option<i64>> {
        let Some(element) = self.object.get(field.0).filter(|e| e.value().multiplicity() > 0) else { return Ok(None) };
        element.to_int().map(Some).map_err(|e| self.invalid(field, e, "a whole number"))
    }

    /// A whole number that `fits`, or `default` if the element is missing.
    pub fn within(
        &self,
        field: Attribute,
        default: Option<i64>,
        fits: impl Fn(i64) -> bool,
        expected: &str,
    ) -> Result<i64> {
        match self.whole(field)?.or(default) {
            Some(n) if fits(n) => Ok(n),
            Some(n) => Err(self.invalid(field, n, expected)),
            None => Err(self.invalid(field, "no such element", expected)),
        }
    }

    pub fn format(&self) -> Result<PixelFormat> {
        let side = |field| self.within(field, None, |n| (1..=65535).contains(&n), "1 to 65535");
        let (rows, columns) = (side(ROWS)?, side(COLUMNS)?);
        self.within(SAMPLES, Some(1), |n| n == 1, "1: one number per pixel")?;
        let allocated = self.within(ALLOCATED, None, |n| matches!(n, 8 | 16 | 32), "8, 16 or 32")?;
        let stored = self.within(STORED, Some(allocated), |n| (1..=allocated).contains(&n), "1 to BitsAllocated")?;
        let in_range = |n| (stored - 1..allocated).contains(&n);
        let high = self.within(HIGH, Some(stored - 1), in_range, "BitsStored - 1 to BitsAllocated - 1")?;
        let sign = self.within(SIGN, Some(0), |n| n == 0 || n == 1, "0 (unsigned) or 1 (signed)")?;
        Ok(PixelFormat {
            rows: rows as usize,
            columns: columns as usize,
            bytes: allocated as usize / 8,
            stored: stored as u32,
            high: high as u32,
            signed: sign == 1,
        })
    }

    fn axes(&self) -> Result<[[f64; 3]; 2]> {
        let six = self.required::<6>(ORIENTATION)?;
        let axes = [[six[0], six[1], six[2]], [six[3], six[4], six[5]]];
        // Files round the numbers: each axis is normalized again.
        let fits = axes.iter().all(|a| (norm(*a) - 1.0).abs() <= 1e-2) && dot(axes[0], axes[1]).abs() <= 1e-2;
        self.ensure(fits, ORIENTATION, format!("{six:?}"), "two orthogonal unit vectors")?;
        Ok(axes.map(|a| a.map(|x| x / norm(a))))
    }
}

impl Slice {
    /// Reads everything but the values of the DICOM file `path`; `None` with a warning if it has no image.
    pub fn read(path: &Path) -> Result<Option<Self>> {
        let place = path.display().to_string();
        let (pixels, end) = lengths::check(path)?;
        if pixels == PixelStorage::None {
            tracing::warn!("{place}: skipped, it has no image");
            return Ok(None);
        }
        let object = open(path, end, OpenFileOptions::new().read_until(PIXEL_DATA.0))?;
        let e = Elements { place: &place, object: &object };
        e.within(FRAMES, Some(1), |n| n == 1, "1: one slice per file (a file of several is read by its own name)")?;
        let format = e.format()?;
        pixels.must_hold(&place, format.count() as u64, format.bytes as u64)?;
        Self::of(path, end, 0, &e, format).map(Some)
    }

    /// The slice with the elements `e`, stored in `format` as frame `frame` of the first `end` bytes of `path`.
    pub fn of(path: &Path, end: u64, frame: usize, e: &Elements<'_>, format: PixelFormat) -> Result<Self> {
        let series = e.text(SERIES).ok_or_else(|| e.invalid(SERIES, "no such element", "the series' identifier"))?;
        let modality = e.text(MODALITY).unwrap_or_default();
        let about = format!("{modality}, {}", e.text(SERIES_NAME).unwrap_or_else(|| "no description".into()));
        let spacing = e.required::<2>(SPACING)?;
        e.ensure(spacing.iter().all(|s| *s > 0.0), SPACING, format!("{spacing:?}"), "millimetres above 0")?;
        let between = e.numbers::<1>(BETWEEN)?.map(|[x]| x.abs());
        let thickness = between.or(e.numbers::<1>(THICKNESS)?.map(|[x]| x)).filter(|x| *x > 0.0);
        let [slope] = e.numbers(SLOPE)?.unwrap_or([1.0]);
        let [intercept] = e.numbers(INTERCEPT)?.unwrap_or([0.0]);
        let (axes, position) = (e.axes()?, e.required(POSITION)?);
        Ok(Self {
            path: path.to_path_buf(),
            end,
            frame,
            series,
            about,
            modality,
            axes,
            position,
            spacing,
            thickness,
            rescale: [slope, intercept],
            format,
        })
    }

    /// The file's name.
    pub fn name(&self) -> String {
        file_name(&self.path)
    }

    /// Refuses a slice of another size, pixel size or orientation than `first`.
    pub fn must_fit(&self, first: &Self) -> Result<()> {
        let refuse = |field: Attribute, found: String, want: String| {
            let expected = format!("{want}, as in {}", first.name());
            Err(Error::invalid(self.path.display().to_string(), field.1, found, expected))
        };
        for (field, [own, want]) in
            [(ROWS, [self.format.rows, first.format.rows]), (COLUMNS, [self.format.columns, first.format.columns])]
        {
            if own != want {
                return refuse(field, own.to_string(), want.to_string());
            }
        }
        let near = |a: f64, b: f64, tolerance: f64| (a - b).abs() <= tolerance;
        if !self.spacing.iter().zip(first.spacing).all(|(a, b)| near(*a, b, 1e-3 * b)) {
            return refuse(SPACING, format!("{:?}", self.spacing), format!("{:?}", first.spacing));
        }
        if !self.axes.iter().flatten().zip(first.axes.iter().flatten()).all(|(a, b)| near(*a, *b, 1e-3)) {
            return refuse(ORIENTATION, format!("{:?}", self.axes), format!("{:?}", first.axes));
        }
        Ok(())
    }

    /// Slice thickness, for a series of a single slice.
    pub fn thickness(&self) -> Result<f64> {
        let expected = "millimetres above 0, which a single slice needs";
        self.thickness.ok_or_else(|| Error::invalid(self.path.display().to_string(), THICKNESS.1, "none", expected))
    }

    /// The rescaled values, row after row.
    pub fn values(&self) -> Result<Vec<f32>> {
        self.rescaled(stored(&self.path, self.end, &self.format)?)
    }

    /// The rescaled values of `stored` ones.
    pub fn rescaled(&self, stored: impl IntoIterator<Item = f64>) -> Result<Vec<f32>> {
        let [slope, intercept] = self.rescale;
        let rescaled: Vec<f32> = stored.into_iter().map(|v| (slope * v + intercept) as f32).collect();
        let expected = "a factor that keeps values in the range of 32-bit floats";
        ensure(rescaled.iter().all(|x| x.is_finite()), &self.path.display().to_string(), SLOPE.1, slope, expected)?;
        Ok(rescaled)
    }
}

/// The stored values in the first `end` bytes of `path`, whose lengths have been checked.
pub(super) fn stored(path: &Path, end: u64, format: &PixelFormat) -> Result<Vec<f64>> {
    let place = path.display().to_string();
    // The library keeps the fragments it reads and returns copies.
    allowance::memory(&place, PIXEL_DATA.1, end.saturating_mul(2))?;
    let object = open(path, end, OpenFileOptions::new().read_to(PIXEL_DATA.0))?;
    let element = object.get(PIXEL_DATA.0);
    let element = element.ok_or_else(|| Error::invalid(&place, PIXEL_DATA.1, "no such element", "a picture"))?;
    pixels::values(&place, &object, element, format)
}

/// The first `end` bytes of a file, whose lengths have been checked.
pub(super) fn open(path: &Path, end: u64, options: OpenFileOptions) -> Result<DefaultDicomObject> {
    options.from_reader(files::open(path)?.0.take(end)).map_err(|e| {
        // The outer message says only that reading failed; the causes are nested in it.
        let reasons: Vec<String> =
            std::iter::successors(std::error::Error::source(&e), |e| e.source()).map(ToString::to_string).collect();
        let found = if reasons.is_empty() { e.to_string() } else { reasons.join(": ") };
        Error::invalid(path.display().to_string(), "elements", found, "a DICOM file")
    })
}
