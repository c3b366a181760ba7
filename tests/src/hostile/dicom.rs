//! A DICOM series of two slices, written with `dicom-object`.

use super::seeds::fixture;
use dicom_core::value::PixelFragmentSequence;
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};
use std::path::Path;

const EXPLICIT: &str = "1.2.840.10008.1.2.1";
const IMPLICIT: &str = "1.2.840.10008.1.2";
const RUN_LENGTH: &str = "1.2.840.10008.1.2.5";
const JPEG_LS: &str = "1.2.840.10008.1.2.4.80";
const JPEG_2000: &str = "1.2.840.10008.1.2.4.90";
const PIXELS: Tag = Tag(0x7fe0, 0x0010);

/// Slice `k`: 2 rows of 3 columns, unsigned 16 bits.
fn slice(k: usize) -> InMemDicomObject {
    let position = format!("-10\\20\\{}", 1.5 * k as f64);
    let texts = [
        (Tag(0x0008, 0x0060), VR::CS, "CT"),
        (Tag(0x0020, 0x000e), VR::UI, "1.2.3"),
        (Tag(0x0020, 0x0032), VR::DS, &position),
        (Tag(0x0020, 0x0037), VR::DS, "1\\0\\0\\0\\1\\0"),
        (Tag(0x0028, 0x0030), VR::DS, "0.5\\0.75"),
        (Tag(0x0028, 0x1052), VR::DS, "-1000"),
        (Tag(0x0028, 0x1053), VR::DS, "2"),
    ];
    let mut o = InMemDicomObject::new_empty();
    for (tag, vr, value) in texts {
        o.put(DataElement::new(tag, vr, PrimitiveValue::from(value)));
    }
    for (element, value) in [(2, 1u16), (0x10, 2), (0x11, 3), (0x100, 16), (0x101, 16), (0x102, 15), (0x103, 0)] {
        o.put(DataElement::new(Tag(0x0028, element), VR::US, PrimitiveValue::from(value)));
    }
    let values: Vec<u16> = (0..6).map(|i| 100 * k as u16 + i).collect();
    o.put(DataElement::new(PIXELS, VR::OW, PrimitiveValue::U16(values.into())));
    o
}

fn series(dir: &Path, syntax: &str, change: impl Fn(&mut InMemDicomObject)) {
    let folder = dir.join("series");
    std::fs::create_dir_all(&folder).expect("a folder of the test's own");
    for k in 0..2 {
        let mut object = slice(k);
        change(&mut object);
        let meta = FileMetaTableBuilder::new()
            .transfer_syntax(syntax)
            .media_storage_sop_class_uid("1.2.840.10008.5.1.4.1.1.2")
            .media_storage_sop_instance_uid("1.2.3.4");
        let file = object.with_meta(meta).expect("a whole description");
        file.write_to_file(folder.join(format!("{k}.dcm"))).expect("a file of the test's own");
    }
}

/// The folder `series`, with lengths and kinds written out.
pub fn dicom(dir: &Path) {
    series(dir, EXPLICIT, |_| {});
}

/// The folder `series`, with the kinds left out.
pub fn dicom_implicit(dir: &Path) {
    series(dir, IMPLICIT, |_| {});
}

/// The folder `series`, with run lengths that stand for nothing but zeros, `side` rows and columns of them a slice.
pub fn dicom_of_zeros(dir: &Path, side: u16) {
    series(dir, RUN_LENGTH, |o| {
        for element in [0x10, 0x11] {
            o.put(DataElement::new(Tag(0x0028, element), VR::US, PrimitiveValue::from(side)));
        }
        // Two bytes for 128 zeros.
        let runs = [129u8, 0].repeat((usize::from(side) * usize::from(side)).div_ceil(128));
        let mut bytes = [2u32, 64, 64 + runs.len() as u32].iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        bytes.resize(64, 0);
        bytes.extend(runs.repeat(2));
        o.put(DataElement::new(PIXELS, VR::OB, PixelFragmentSequence::new_fragments(vec![bytes])));
    });
}

/// The folder `series`, with run lengths.
pub fn dicom_run_length(dir: &Path) {
    series(dir, RUN_LENGTH, |o| {
        let mut bytes = [2u32, 64, 66].iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        bytes.resize(64, 0);
        // Six zeros, then 0 to 5 as they are.
        bytes.extend([251, 0, 5, 0, 1, 2, 3, 4, 5, 128]);
        o.put(DataElement::new(PIXELS, VR::OB, PixelFragmentSequence::new_fragments(vec![bytes])));
    });
}

fn packed(dir: &Path, syntax: &str, picture: &'static [u8]) {
    series(dir, syntax, |o| {
        // Pieces are of even length.
        let mut bytes = picture.to_vec();
        bytes.resize(bytes.len().next_multiple_of(2), 0);
        o.put(DataElement::new(PIXELS, VR::OB, PixelFragmentSequence::new_fragments(vec![bytes])));
    });
}

/// The folder `series`, packed by JPEG-LS.
pub fn dicom_jpeg_ls(dir: &Path) {
    packed(dir, JPEG_LS, fixture!("picture.jls"));
}

/// The folder `series`, packed by JPEG 2000.
pub fn dicom_jpeg_2000(dir: &Path) {
    packed(dir, JPEG_2000, fixture!("picture_unsigned.j2k"));
}
