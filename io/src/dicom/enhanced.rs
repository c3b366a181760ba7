//! Enhanced CT: all slices in one file, with the attributes of slices in functional groups.
//!
//! Source: DICOM PS3.3 (Enhanced CT Image IOD, A.38; functional groups, C.7.6.16 and C.8.15.3). Read are uncompressed
//! files, whichever of the two sequences holds a group.

use super::slice::{Attribute, Elements, FRAMES, PIXEL_DATA, Slice, open, stored};
use super::write::{DicomTemplate, Series, number, numbers, text};
use super::{assemble, check_shape, lengths, pixels};
use crate::write_atomic;
use conefield_core::error::ensure;
use conefield_core::parts::Voxels;
use conefield_core::scan::Volume;
use conefield_core::{Error, Result};
use dicom_core::header::HasLength;
use dicom_core::value::DataSetSequence;
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_object::{DefaultDicomObject, InMemDicomObject, OpenFileOptions};
use std::io::Seek;
use std::path::Path;

const ENHANCED: &str = "1.2.840.10008.5.1.4.1.1.2.1";

const SHARED: Tag = Tag(0x5200, 0x9229);
const PER_FRAME: Tag = Tag(0x5200, 0x9230);
const CONTENT: Tag = Tag(0x0020, 0x9111);
const IN_STACK: Tag = Tag(0x0020, 0x9057);
const POSITION: Tag = Tag(0x0020, 0x9113);
const ORIENTATION: Tag = Tag(0x0020, 0x9116);
const MEASURES: Tag = Tag(0x0028, 0x9110);
const TRANSFORMATION: Tag = Tag(0x0028, 0x9145);

/// The elements that a slice needs, with the groups that may hold them.
const NEEDED: [(Tag, Tag); 10] = [
    (POSITION, Tag(0x0020, 0x0032)),
    (ORIENTATION, Tag(0x0020, 0x0037)),
    (MEASURES, Tag(0x0028, 0x0030)),
    (MEASURES, Tag(0x0018, 0x0050)),
    (MEASURES, Tag(0x0018, 0x0088)),
    (TRANSFORMATION, Tag(0x0028, 0x1052)),
    (TRANSFORMATION, Tag(0x0028, 0x1053)),
    (CONTENT, Tag(0x0008, 0x0060)),
    (CONTENT, Tag(0x0008, 0x103e)),
    (CONTENT, Tag(0x0020, 0x000e)),
];

/// Longest of these elements in bytes.
const LONGEST: u32 = 1024;

/// Refuses more voxels than one file can hold.
pub(crate) fn check_one_file(place: &str, shape: [usize; 3]) -> Result<()> {
    check_shape(place, shape)?;
    let bytes = shape.iter().fold(2u64, |n, &k| n.saturating_mul(k as u64));
    let expected = "less than 4 GiB of 16-bit voxels in one file (an end of .dicom writes a file per slice)";
    ensure(bytes < u64::from(u32::MAX), place, "shape", format!("{shape:?}"), expected)
}

/// Writes the file `path` with all slices along z as frames; otherwise like a series.
pub(crate) fn write(path: &Path, voxels: &mut dyn Voxels, template: Option<&DicomTemplate>) -> Result<()> {
    let frames = voxels.grid().shape[2];
    check_one_file(&path.display().to_string(), voxels.grid().shape)?;
    let mut series = Series::new(path, voxels, template, ENHANCED)?;
    series.values.rewind().map_err(|e| Error::io(path, e))?;
    let head = series.head(path, whole(&series, frames), &series.digest.uid("image"), frames)?;
    write_atomic(path, &mut |w| series.pixels(path, &head, w, frames))
}

fn sequence(object: &mut InMemDicomObject, tag: Tag, items: Vec<InMemDicomObject>) {
    object.put(DataElement::new(tag, VR::SQ, DataSetSequence::from(items)));
}

fn item(elements: &[(Tag, VR, &str)]) -> InMemDicomObject {
    let mut o = InMemDicomObject::new_empty();
    elements.iter().for_each(|(tag, vr, value)| text(&mut o, *tag, *vr, value));
    o
}

/// An item that holds one sequence of one item, as functional groups do.
fn put_group(object: &mut InMemDicomObject, tag: Tag, elements: &[(Tag, VR, &str)]) {
    sequence(object, tag, vec![item(elements)]);
}

/// Attributes of a series that functional groups of all frames hold, by group.
const OF_ALL_FRAMES: [(Tag, &[(Tag, VR)]); 4] = [
    (MEASURES, &[(Tag(0x18, 0x50), VR::DS), (Tag(0x18, 0x88), VR::DS), (Tag(0x28, 0x30), VR::DS)]),
    (ORIENTATION, &[(Tag(0x20, 0x37), VR::DS)]),
    (Tag(0x28, 0x9132), &[(Tag(0x28, 0x1050), VR::DS), (Tag(0x28, 0x1051), VR::DS), (Tag(0x28, 0x1056), VR::CS)]),
    (TRANSFORMATION, &[(Tag(0x28, 0x1052), VR::DS), (Tag(0x28, 0x1053), VR::DS), (Tag(0x28, 0x1054), VR::LO)]),
];

/// Attributes of a series that belong to single slices, or to a scanner.
const OF_NO_FRAME: [Tag; 2] = [Tag(0x18, 0x60), Tag(0x20, 0x12)];

/// The kind of the images.
const KIND: &str = "DERIVED\\PRIMARY\\VOLUME\\NONE";

/// How the images are to be seen.
const LOOK: [(Tag, VR, &str); 3] = [
    (Tag(0x8, 0x9205), VR::CS, "MONOCHROME"),
    (Tag(0x8, 0x9206), VR::CS, "VOLUME"),
    (Tag(0x8, 0x9207), VR::CS, "NONE"),
];

/// The anatomy, which is required and not known.
const BODY: [(Tag, VR, &str); 3] =
    [(Tag(0x8, 0x100), VR::SH, "38266002"), (Tag(0x8, 0x102), VR::SH, "SCT"), (Tag(0x8, 0x104), VR::LO, "Entire body")];

/// Moves the attributes of a series into functional groups, and adds those that only this kind of image has.
fn whole(series: &Series, frames: usize) -> InMemDicomObject {
    let mut o = series.shared.clone();
    let shared = groups_of_all_frames(&mut o);
    sequence(&mut o, SHARED, vec![shared]);
    sequence(&mut o, PER_FRAME, (0..frames).map(|k| groups_of_frame(series, k)).collect());
    put_dimensions(&mut o, &series.digest.uid("dimensions"));
    sequence(&mut o, Tag(0x40, 0x555), vec![]);
    // The date of the content is required: that of the study, or one that is clearly none.
    let date = o.get(Tag(0x8, 0x20)).and_then(|e| e.to_str().ok()).filter(|d| !d.is_empty());
    let date = date.map_or("19700101".to_owned(), |d| d.into_owned());
    for (tag, vr, value) in [
        (Tag(0x8, 0x8), VR::CS, KIND),
        (Tag(0x8, 0x23), VR::DA, &date),
        (Tag(0x8, 0x33), VR::TM, "000000"),
        (Tag(0x8, 0x1090), VR::LO, "conefield"),
        (Tag(0x18, 0x1000), VR::LO, "0"),
        (Tag(0x18, 0x9004), VR::CS, "RESEARCH"),
        (Tag(0x20, 0x13), VR::IS, "1"),
        (Tag(0x28, 0x8), VR::IS, &number(frames as f64)),
        (Tag(0x28, 0x301), VR::CS, "NO"),
        (Tag(0x28, 0x2110), VR::CS, "00"),
        (Tag(0x2050, 0x20), VR::CS, "IDENTITY"),
    ] {
        text(&mut o, tag, vr, value);
    }
    LOOK.iter().for_each(|(tag, vr, value)| text(&mut o, *tag, *vr, value));
    o
}

/// The functional groups of all frames, with the attributes that are taken out of `series`.
fn groups_of_all_frames(series: &mut InMemDicomObject) -> InMemDicomObject {
    let mut shared = InMemDicomObject::new_empty();
    for (group, attributes) in OF_ALL_FRAMES {
        let mut item = InMemDicomObject::new_empty();
        for (tag, vr) in attributes {
            let value = series.get(*tag).and_then(|e| e.to_str().ok()).unwrap_or_default().into_owned();
            series.remove_element(*tag);
            text(&mut item, *tag, *vr, &value);
        }
        sequence(&mut shared, group, vec![item]);
    }
    for tag in OF_NO_FRAME {
        series.remove_element(tag);
    }
    put_group(&mut shared, Tag(0x18, 0x9329), &[&[(Tag(0x8, 0x9007), VR::CS, KIND)][..], &LOOK].concat());
    let mut anatomy = item(&[(Tag(0x20, 0x9072), VR::CS, "U")]);
    put_group(&mut anatomy, Tag(0x8, 0x2218), &BODY);
    sequence(&mut shared, Tag(0x20, 0x9071), vec![anatomy]);
    shared
}

/// The functional groups of frame `k`: its place in the stack.
fn groups_of_frame(series: &Series, k: usize) -> InMemDicomObject {
    let index = PrimitiveValue::from(k as u32 + 1);
    let mut content = item(&[(Tag(0x20, 0x9056), VR::SH, "1")]);
    content.put(DataElement::new(IN_STACK, VR::UL, index.clone()));
    content.put(DataElement::new(Tag(0x20, 0x9157), VR::UL, index));
    let mut frame = InMemDicomObject::new_empty();
    sequence(&mut frame, CONTENT, vec![content]);
    put_group(&mut frame, POSITION, &[(Tag(0x20, 0x32), VR::DS, &numbers(series.position(k)))]);
    frame
}

/// Says by which attribute frames are ordered.
fn put_dimensions(o: &mut InMemDicomObject, organization: &str) {
    let organization = (Tag(0x20, 0x9164), VR::UI, organization);
    put_group(o, Tag(0x20, 0x9221), &[organization]);
    let mut index = item(&[organization]);
    for (tag, pointed) in [(Tag(0x20, 0x9165), IN_STACK), (Tag(0x20, 0x9167), CONTENT)] {
        index.put(DataElement::new(tag, VR::AT, PrimitiveValue::from(pointed)));
    }
    sequence(o, Tag(0x20, 0x9222), vec![index]);
}

/// An enhanced file without its values.
struct Head {
    object: DefaultDicomObject,
    end: u64,
    storage: lengths::PixelStorage,
}

impl Head {
    fn read(path: &Path) -> Result<Self> {
        let (storage, end) = lengths::check(path)?;
        let object = open(path, end, OpenFileOptions::new().read_until(PIXEL_DATA.0))?;
        Ok(Self { object, end, storage })
    }

    /// The number of frames, one per item of the sequence with their positions.
    fn frames(&self, e: &Elements<'_>) -> Result<usize> {
        let frames = e.within(FRAMES, None, |n| n > 0, "a number above 0")?;
        let items = self.object.get(PER_FRAME).and_then(|e| e.items()).map_or(0, <[_]>::len);
        let name: Attribute = (PER_FRAME, "PerFrameFunctionalGroupsSequence");
        let expected = format!("{frames}, as NumberOfFrames says");
        e.ensure(frames as usize == items, name, format!("{items} items"), &expected)?;
        Ok(items)
    }

    /// The elements of frame `k` that a slice needs.
    fn frame(&self, k: usize) -> InMemDicomObject {
        let mut o = InMemDicomObject::new_empty();
        for (group, tag) in NEEDED {
            let own = self.item(PER_FRAME, k, group).and_then(|i| i.get(tag));
            let element = own.or_else(|| self.item(SHARED, 0, group)?.get(tag)).or_else(|| self.object.get(tag));
            // None of them is long; a file may claim otherwise, for every frame again.
            if let Some(element) = element.filter(|e| e.length().0 <= LONGEST) {
                o.put(element.clone());
            }
        }
        o
    }

    /// The first item of `group` in item `k` of the sequence `groups`.
    fn item(&self, groups: Tag, k: usize, group: Tag) -> Option<&InMemDicomObject> {
        self.object.get(groups)?.items()?.get(k)?.get(group)?.items()?.first()
    }
}

/// Whether the DICOM file `path` has functional groups of frames: only those are volumes.
pub(crate) fn has_frames(path: &Path) -> Result<bool> {
    Ok(Head::read(path)?.object.get(PER_FRAME).is_some())
}

/// Number of voxels that [`read`] returns.
pub(crate) fn voxels(path: &Path) -> Result<u64> {
    let head = Head::read(path)?;
    let place = path.display().to_string();
    let e = Elements { place: &place, object: &head.object };
    Ok(e.format()?.count() as u64 * head.frames(&e)? as u64)
}

/// Reads the frames of the file `path` as a volume, like the slices of a series.
pub(crate) fn read(path: &Path) -> Result<Volume> {
    let head = Head::read(path)?;
    let place = path.display().to_string();
    let e = Elements { place: &place, object: &head.object };
    let (format, frames) = (e.format()?, head.frames(&e)?);
    let all = pixels::PixelFormat { rows: format.rows * frames, ..format };
    if pixels::packing(&place, head.object.meta().transfer_syntax())? != pixels::Packing::Plain {
        let what = format!("{place}: compressed frames");
        return Err(Error::unsupported(what, "decompress the file first (gdcmconv --raw)"));
    }
    head.storage.must_hold(&place, all.count() as u64, all.bytes as u64)?;
    let slices: Vec<Slice> = (0..frames)
        .map(|k| {
            let o = head.frame(k);
            Slice::of(path, head.end, k, &Elements { place: &place, object: &o }, format)
        })
        .collect::<Result<_>>()?;
    let values = stored(path, head.end, &all)?;
    assemble(&place, slices, &|slice| {
        let frame = values.chunks_exact(format.count()).nth(slice.frame).unwrap_or_default();
        slice.rescaled(frame.iter().copied())
    })
}
