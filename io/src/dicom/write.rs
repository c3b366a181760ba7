//! Writes a CT series: one file per slice, CT Image Storage, explicit VR little-endian.
//!
//! Source: DICOM PS3.3 (CT Image IOD, A.3), PS3.5 (encoding), PS3.6 (tags). Values are signed 16-bit integers times a
//! slope, so they are rounded to half a slope. Identifiers are version-8 UUIDs (`2.25.`) of a hash of the content: the
//! same content gives the same bytes.

use super::slice::{PIXEL_DATA, open};
use super::{is_dicom, lengths};
use crate::affine;
use crate::file_order::{self, FileOrder};
use crate::folder::folder_of;
use crate::{PACKED_BYTES, folder, write_folder_atomic};
use conefield_core::error::ensure;
use conefield_core::geometry::{cross, dot};
use conefield_core::parts::Voxels;
use conefield_core::{Error, Result};
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject, OpenFileOptions};
use std::fs::File;
use std::io::{BufWriter, Read, Seek, Write};
use std::path::Path;
use tempfile::SpooledTempFile;

const CT_IMAGE: &str = "1.2.840.10008.5.1.4.1.1.2";
const EXPLICIT: &str = "1.2.840.10008.1.2.1";
const CLASS: Tag = Tag(0x0008, 0x0016);
const STUDY: Tag = Tag(0x0020, 0x000d);

/// The attributes of a patient and a study that a template gives; all are text.
const COPIED: [(Tag, VR); 17] = [
    (Tag(0x0008, 0x0020), VR::DA),
    (Tag(0x0008, 0x0030), VR::TM),
    (Tag(0x0008, 0x0050), VR::SH),
    (Tag(0x0008, 0x0090), VR::PN),
    (Tag(0x0008, 0x1030), VR::LO),
    (Tag(0x0010, 0x0010), VR::PN),
    (Tag(0x0010, 0x0020), VR::LO),
    (Tag(0x0010, 0x0021), VR::LO),
    (Tag(0x0010, 0x0030), VR::DA),
    (Tag(0x0010, 0x0040), VR::CS),
    (Tag(0x0010, 0x1010), VR::AS),
    (Tag(0x0010, 0x1020), VR::DS),
    (Tag(0x0010, 0x1030), VR::DS),
    (Tag(0x0010, 0x4000), VR::LT),
    (Tag(0x0012, 0x0062), VR::CS),
    (STUDY, VR::UI),
    (Tag(0x0020, 0x0010), VR::SH),
];

/// Patient and study of an existing DICOM file.
pub struct DicomTemplate(Vec<(Tag, VR, String)>);

impl DicomTemplate {
    /// Reads them from the file `path`. Refuses a file that is no DICOM file or names no study.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let place = path.display().to_string();
        ensure(is_dicom(path)?, &place, "template", "a file of another kind", "a DICOM file")?;
        let (_, end) = lengths::check(path)?;
        let object = open(path, end, OpenFileOptions::new().read_until(PIXEL_DATA.0))?;
        let text = |tag: Tag| object.get(tag)?.to_str().ok().map(|t| t.trim_end_matches(['\0', ' ']).to_owned());
        let all: Vec<_> = COPIED.iter().filter_map(|&(tag, vr)| Some((tag, vr, text(tag)?))).collect();
        let study = all.iter().find(|(tag, ..)| *tag == STUDY).map_or("", |(.., uid)| uid);
        let valid = (1..=64).contains(&study.len()) && study.bytes().all(|b| b.is_ascii_digit() || b == b'.');
        let expected = "an identifier of digits and dots";
        ensure(valid, &place, "StudyInstanceUID", format!("\"{study}\""), expected)?;
        Ok(Self(all))
    }
}

/// Refuses a slice with more rows or columns than a 16-bit number says, or more bytes than a 32-bit one, before the
/// voxels are computed.
pub(crate) fn check_shape(place: &str, [x, y, _]: [usize; 3]) -> Result<()> {
    let expected = "at most 65535 voxels along x and y, the limit of DICOM";
    ensure(x.max(y) <= 65535, place, "shape", format!("{x} x {y}"), expected)?;
    let expected = "less than 4 GiB of 16-bit voxels in a slice, the limit of DICOM";
    ensure(2 * (x as u64) * (y as u64) < u64::from(u32::MAX), place, "shape", format!("{x} x {y}"), expected)
}

/// Whether a series of this module may have a file of this name.
fn is_slice(name: &str) -> bool {
    name.strip_suffix(".dcm").is_some_and(|n| n.len() >= 4 && n.bytes().all(|b| b.is_ascii_digit()))
}

/// Writes the folder `path` with one file per slice along z; an existing folder is replaced only if it holds nothing but
/// such files. Rows run along x and columns along y; patient and study come from `template`, or are empty and new.
pub(crate) fn write(path: &Path, voxels: &mut dyn Voxels, template: Option<&DicomTemplate>) -> Result<()> {
    let place = path.display().to_string();
    check_shape(&place, voxels.grid().shape)?;
    folder::may_replace(path, "DICOM series", &is_slice, &["0001.dcm", "00001.dcm"])?;
    let mut series = Series::new(path, voxels, template, CT_IMAGE)?;
    write_folder_atomic(path, &mut |folder| series.write(folder))
}

/// A series whose values are known.
pub(super) struct Series {
    /// 32-bit floats, x fastest.
    pub values: SpooledTempFile,
    shape: [usize; 3],
    /// Unit vectors along x, y and z, LPS.
    axes: [[f64; 3]; 3],
    spacing: [f64; 3],
    /// The centre of the first voxel, LPS.
    first: [f64; 3],
    slope: f64,
    /// Attributes that all slices share.
    pub shared: InMemDicomObject,
    pub digest: Digest,
}

impl Series {
    /// Computes the values, for files of the SOP class `class`.
    pub fn new(path: &Path, voxels: &mut dyn Voxels, template: Option<&DicomTemplate>, class: &str) -> Result<Self> {
        let place = path.display().to_string();
        let (shape, hounsfield) = (voxels.grid().shape, voxels.hounsfield().map(str::to_owned));
        let (ras, _) = affine::of(voxels, &place);
        if let Some(skew) = affine::skew(&ras) {
            return Err(Error::invalid(place, "axes", skew, "axes at right angles"));
        }
        let lps = affine::flip(ras);
        let spacing = affine::spacing(&lps);
        let axes = [0, 1, 2].map(|k| affine::column(&lps, k).map(|x| x / spacing[k]));
        // The identifiers depend on the values and every value has the slope: the voxels are computed once and kept.
        let mut spool = Spool {
            file: tempfile::spooled_tempfile_in(PACKED_BYTES as usize, folder_of(path)),
            digest: Digest::new(),
            range: [f32::INFINITY, f32::NEG_INFINITY],
        };
        file_order::write(&mut spool, path, voxels, FileOrder::XFastest)?;
        let Spool { file: values, mut digest, range } = spool;
        let slope = slope(range);
        let shared = shared(class, hounsfield.as_deref(), range.map(f64::from), slope, template);
        digest.add(format!("{shape:?} {lps:?} {shared:?}").as_bytes());
        let mut series = Self { values, shape, axes, spacing, first: affine::column(&lps, 3), slope, shared, digest };
        series.identify();
        Ok(series)
    }

    /// Adds identifiers and geometry.
    fn identify(&mut self) {
        let o = &mut self.shared;
        if o.get(STUDY).is_none() {
            text(o, STUDY, VR::UI, &self.digest.uid("study"));
        }
        text(o, Tag(0x0020, 0x000e), VR::UI, &self.digest.uid("series"));
        text(o, Tag(0x0020, 0x0052), VR::UI, &self.digest.uid("frame of reference"));
        let [x, y, _] = self.axes;
        text(o, Tag(0x0020, 0x0037), VR::DS, &numbers([x, y].concat()));
        text(o, Tag(0x0028, 0x0030), VR::DS, &numbers([self.spacing[1], self.spacing[0]]));
        text(o, Tag(0x0018, 0x0050), VR::DS, &number(self.spacing[2]));
        text(o, Tag(0x0018, 0x0088), VR::DS, &number(self.spacing[2]));
        word(o, Tag(0x0028, 0x0010), self.shape[1] as u16);
        word(o, Tag(0x0028, 0x0011), self.shape[0] as u16);
    }

    fn write(&mut self, folder: &Path) -> Result<()> {
        let width = self.shape[2].to_string().len().max(4);
        self.values.rewind().map_err(|e| Error::io(folder, e))?;
        for k in 0..self.shape[2] {
            let path = folder.join(format!("{:0width$}.dcm", k + 1));
            let mut file = BufWriter::new(File::create(&path).map_err(|e| Error::io(&path, e))?);
            let head = self.head(&path, self.slice(k), &self.digest.uid(&format!("slice {k}")), 1)?;
            self.pixels(&path, &head, &mut file, 1)?;
            let file = file.into_inner().map_err(|e| Error::io(&path, e.into_error()))?;
            file.sync_all().map_err(|e| Error::io(&path, e))?;
        }
        Ok(())
    }

    /// The attributes of slice `k`.
    fn slice(&self, k: usize) -> InMemDicomObject {
        let mut o = self.shared.clone();
        let position = self.position(k);
        text(&mut o, Tag(0x0020, 0x0013), VR::IS, &(k + 1).to_string());
        text(&mut o, Tag(0x0020, 0x0032), VR::DS, &numbers(position));
        text(&mut o, Tag(0x0020, 0x1041), VR::DS, &number(dot(position, cross(self.axes[0], self.axes[1]))));
        o
    }

    /// The centre of the first voxel of slice `k`.
    pub fn position(&self, k: usize) -> [f64; 3] {
        std::array::from_fn(|i| self.first[i] + k as f64 * self.spacing[2] * self.axes[2][i])
    }

    /// The bytes of `object` with the identifier `uid`, up to the values of `slices` slices.
    pub fn head(&self, path: &Path, mut object: InMemDicomObject, uid: &str, slices: usize) -> Result<Vec<u8>> {
        text(&mut object, Tag(0x0008, 0x0018), VR::UI, uid);
        let class = object.get(CLASS).and_then(|e| e.to_str().ok()).unwrap_or_default().into_owned();
        let meta = FileMetaTableBuilder::new()
            .transfer_syntax(EXPLICIT)
            .media_storage_sop_class_uid(class)
            .media_storage_sop_instance_uid(uid);
        let failed = |e: &dyn std::fmt::Display| Error::unsupported(path.display().to_string(), e.to_string());
        let mut bytes = Vec::new();
        object.with_meta(meta).map_err(|e| failed(&e))?.write_all(&mut bytes).map_err(|e| failed(&e))?;
        // The values follow by hand, so that they need not be in memory: PixelData is the last element.
        let length = 2 * slices * self.shape[0] * self.shape[1];
        bytes.extend([0xe0, 0x7f, 0x10, 0, b'O', b'W', 0, 0]);
        bytes.extend((length as u32).to_le_bytes());
        Ok(bytes)
    }

    /// Writes `head` and the stored values of the next `slices` slices.
    pub fn pixels(&mut self, path: &Path, head: &[u8], w: &mut dyn Write, slices: usize) -> Result<()> {
        w.write_all(head).map_err(|e| Error::io(path, e))?;
        let mut raw = vec![0; 4 * self.shape[0] * self.shape[1]];
        let stored = |bytes: &[u8; 4]| (f64::from(f32::from_le_bytes(*bytes)) / self.slope).round() as i16;
        for _ in 0..slices {
            self.values.read_exact(&mut raw).map_err(|e| Error::io(path, e))?;
            let bytes: Vec<u8> = raw.as_chunks().0.iter().flat_map(|b| stored(b).to_le_bytes()).collect();
            w.write_all(&bytes).map_err(|e| Error::io(path, e))?;
        }
        Ok(())
    }
}

/// The attributes of all slices, without identifiers and geometry.
fn shared(
    class: &str,
    hu: Option<&str>,
    [low, high]: [f64; 2],
    slope: f64,
    template: Option<&DicomTemplate>,
) -> InMemDicomObject {
    let mut o = InMemDicomObject::new_empty();
    let program = concat!("conefield ", env!("CARGO_PKG_VERSION"));
    let derivation = format!(
        "{}. Rounded to 16 bits: at most {} from the exact value.",
        hu.unwrap_or("Values as computed"),
        number(0.5 * slope)
    );
    // A window of Hounsfield units shows soft tissue; one of other values shows all of them.
    let (center, width, function) = match hu {
        Some(_) => (40.0, 400.0, "LINEAR"),
        None => (0.5 * (low + high), (high - low).max(slope), "LINEAR_EXACT"),
    };
    for (tag, vr, value) in [
        (Tag(0x0008, 0x0005), VR::CS, "ISO_IR 192"),
        (Tag(0x0008, 0x0008), VR::CS, "DERIVED\\SECONDARY\\AXIAL"),
        (CLASS, VR::UI, class),
        (Tag(0x0008, 0x0020), VR::DA, ""),
        (Tag(0x0008, 0x0030), VR::TM, ""),
        (Tag(0x0008, 0x0050), VR::SH, ""),
        (Tag(0x0008, 0x0060), VR::CS, "CT"),
        (Tag(0x0008, 0x0070), VR::LO, "conefield"),
        (Tag(0x0008, 0x0090), VR::PN, ""),
        (Tag(0x0008, 0x103e), VR::LO, if hu.is_some() { "conefield, HU" } else { "conefield" }),
        (Tag(0x0008, 0x2111), VR::ST, &derivation),
        (Tag(0x0010, 0x0010), VR::PN, ""),
        (Tag(0x0010, 0x0020), VR::LO, ""),
        (Tag(0x0010, 0x0030), VR::DA, ""),
        (Tag(0x0010, 0x0040), VR::CS, ""),
        (Tag(0x0018, 0x0060), VR::DS, ""),
        (Tag(0x0018, 0x1020), VR::LO, program),
        (Tag(0x0018, 0x5100), VR::CS, ""),
        (Tag(0x0020, 0x0010), VR::SH, ""),
        (Tag(0x0020, 0x0011), VR::IS, "1"),
        (Tag(0x0020, 0x0012), VR::IS, ""),
        (Tag(0x0020, 0x1040), VR::LO, ""),
        (Tag(0x0028, 0x0004), VR::CS, "MONOCHROME2"),
        (Tag(0x0028, 0x1050), VR::DS, &number(center)),
        (Tag(0x0028, 0x1051), VR::DS, &number(width)),
        (Tag(0x0028, 0x1052), VR::DS, "0"),
        (Tag(0x0028, 0x1053), VR::DS, &number(slope)),
        (Tag(0x0028, 0x1054), VR::LO, if hu.is_some() { "HU" } else { "US" }),
        (Tag(0x0028, 0x1056), VR::CS, function),
    ] {
        text(&mut o, tag, vr, value);
    }
    for (element, value) in [(0x0002, 1), (0x0100, 16), (0x0101, 16), (0x0102, 15), (0x0103, 1)] {
        word(&mut o, Tag(0x0028, element), value);
    }
    for (tag, vr, value) in template.iter().flat_map(|t| &t.0) {
        text(&mut o, *tag, *vr, value);
    }
    o
}

pub(super) fn text(object: &mut InMemDicomObject, tag: Tag, vr: VR, value: &str) {
    let value = if value.is_empty() { PrimitiveValue::Empty } else { PrimitiveValue::from(value) };
    object.put(DataElement::new(tag, vr, value));
}

pub(super) fn word(object: &mut InMemDicomObject, tag: Tag, value: u16) {
    object.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
}

/// The least slope of six digits with which signed 16-bit integers reach both ends of `range`.
fn slope(range: [f32; 2]) -> f64 {
    let least = range.iter().fold(0.0, |most: f64, x| most.max(f64::from(x.abs()))) / f64::from(i16::MAX);
    if least == 0.0 {
        return 1.0;
    }
    let rounded = |x: f64| format!("{x:.5e}").parse().unwrap_or(x);
    let near: f64 = rounded(least);
    if near < least { rounded(least * (1.0 + 1e-5)) } else { near }
}

/// The closest number of at most 16 characters, the limit of a decimal string.
pub(super) fn number(x: f64) -> String {
    let shortest = x.to_string();
    if shortest.len() <= 16 {
        return shortest;
    }
    let forms = (0..16).flat_map(|digits| [format!("{x:.digits$}"), format!("{x:.digits$e}")]);
    let error = |form: &String| form.parse::<f64>().map_or(f64::INFINITY, |y| (y - x).abs());
    forms.filter(|form| form.len() <= 16).min_by(|a, b| error(a).total_cmp(&error(b))).unwrap_or(shortest)
}

pub(super) fn numbers(all: impl IntoIterator<Item = f64>) -> String {
    all.into_iter().map(number).collect::<Vec<_>>().join("\\")
}

/// FNV-1a of 128 bits.
#[derive(Clone)]
pub(super) struct Digest(u128);

impl Digest {
    fn new() -> Self {
        Self(0x6c62_272e_07bb_0142_62b8_2175_6295_c58d)
    }

    fn add(&mut self, bytes: &[u8]) {
        const PRIME: u128 = 0x0000_0000_0100_0000_0000_0000_0000_013b;
        self.0 = bytes.iter().fold(self.0, |hash, b| (hash ^ u128::from(*b)).wrapping_mul(PRIME));
    }

    /// An identifier for this `role`: a version-8 UUID as one number (PS3.5, B.2).
    pub fn uid(&self, role: &str) -> String {
        let mut digest = self.clone();
        digest.add(role.as_bytes());
        let uuid = digest.0 & !(0xf << 76) & !(0x3 << 62) | 0x8 << 76 | 0x2 << 62;
        format!("2.25.{uuid}")
    }
}

/// Keeps 32-bit floats, with their digest and range. Every write is a whole number of floats.
struct Spool {
    file: SpooledTempFile,
    digest: Digest,
    range: [f32; 2],
}

impl Write for Spool {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.file.write_all(bytes)?;
        self.digest.add(bytes);
        let values = bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b));
        self.range = values.fold(self.range, |[low, high], x| [low.min(x), high.max(x)]);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}
