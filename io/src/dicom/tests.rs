//! Series written with `dicom-object` and read back, then damaged in many ways.

use super::write::{text, word};
use crate::testing::says;
use crate::{is_volume, read_volume};
use dicom_core::value::PixelFragmentSequence;
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};
use std::path::Path;

const PIXELS: Tag = Tag(0x7fe0, 0x0010);
const POSITION: Tag = Tag(0x0020, 0x0032);

pub(super) const EXPLICIT: &str = "1.2.840.10008.1.2.1";
const IMPLICIT: &str = "1.2.840.10008.1.2";
const BIG: &str = "1.2.840.10008.1.2.2";
const RUN_LENGTH: &str = "1.2.840.10008.1.2.5";

/// Slice `k`: 2 rows of 3 columns, signed 16 bits, value 100·k + index, rescaled by 2·x − 1000.
fn slice(k: usize) -> InMemDicomObject {
    let mut o = InMemDicomObject::new_empty();
    text(&mut o, Tag(0x0008, 0x0016), VR::UI, "1.2.840.10008.5.1.4.1.1.2");
    text(&mut o, Tag(0x0008, 0x0018), VR::UI, &format!("1.2.3.{k}"));
    text(&mut o, Tag(0x0008, 0x0060), VR::CS, "CT");
    text(&mut o, Tag(0x0008, 0x103e), VR::LO, "thin");
    text(&mut o, Tag(0x0020, 0x000e), VR::UI, "1.2.3");
    text(&mut o, Tag(0x0020, 0x0037), VR::DS, "1\\0\\0\\0\\0\\-1");
    text(&mut o, POSITION, VR::DS, &format!("-10\\{}\\30", 20.0 + 1.5 * k as f64));
    text(&mut o, Tag(0x0028, 0x0030), VR::DS, "0.5\\0.75 ");
    text(&mut o, Tag(0x0028, 0x1052), VR::DS, "-1000");
    text(&mut o, Tag(0x0028, 0x1053), VR::DS, "2");
    for (element, value) in [(2, 1), (0x10, 2), (0x11, 3), (0x100, 16), (0x101, 12), (0x102, 11), (0x103, 1)] {
        word(&mut o, Tag(0x0028, element), value);
    }
    let values: Vec<u16> = (0..6).map(|i| (100 * k as i16 + i - 3) as u16 & 0xfff).collect();
    o.put(DataElement::new(PIXELS, VR::OW, PrimitiveValue::U16(values.into())));
    o
}

pub(super) fn write(path: &Path, object: InMemDicomObject, syntax: &str) {
    let meta = FileMetaTableBuilder::new()
        .transfer_syntax(syntax)
        .media_storage_sop_class_uid("1.2.840.10008.5.1.4.1.1.2")
        .media_storage_sop_instance_uid("1.2.3.4");
    object.with_meta(meta).unwrap().write_to_file(path).unwrap();
}

/// A folder with the slices 0 to 4, whose names are in reverse order of position, each passed through `change`.
fn series(syntax: &str, change: impl Fn(usize, &mut InMemDicomObject)) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for k in 0..5 {
        let mut object = slice(k);
        change(k, &mut object);
        write(&dir.path().join(format!("{}.dcm", 9 - k)), object, syntax);
    }
    dir
}

fn refused(dir: &tempfile::TempDir, words: &[&str]) {
    says(read_volume(dir.path()), &[&[&dir.path().display().to_string()[..]], words].concat());
}

#[test]
fn a_series_becomes_a_volume_in_ras() {
    for syntax in [EXPLICIT, IMPLICIT, BIG] {
        let dir = series(syntax, |_, _| {});
        std::fs::write(dir.path().join("notes.txt"), "no DICOM").unwrap();
        std::fs::create_dir(dir.path().join("more")).unwrap();
        assert!(is_volume(dir.path()));
        let v = read_volume(dir.path()).unwrap();
        assert_eq!((v.grid.shape, v.grid.spacing, v.grid.center), ([3, 2, 5], [0.75, 0.5, 1.5], [0.0; 3]), "{syntax}");
        // Rows run along LPS x, columns along −z, so the normal is x × −z = +y: the slices are in order.
        let want = [[-0.75, 0.0, 0.0, 10.0], [0.0, 0.0, -1.5, -20.0], [0.0, -0.5, 0.0, 30.0], [0.0, 0.0, 0.0, 1.0]];
        assert_eq!(v.affine, Some(want));
        for ((x, y, z), value) in v.data.indexed_iter() {
            let stored = 100.0 * z as f32 + (3 * y + x) as f32 - 3.0;
            assert_eq!(*value, 2.0 * stored - 1000.0, "{syntax} [{x}, {y}, {z}]");
        }
    }
}

#[test]
fn run_lengths_and_icons_are_read() {
    let dir = series(RUN_LENGTH, |k, o| {
        let values = [-3i16, -2, -1, 0, 1, 2].map(|i| ((100 * k as i16 + i) as u16 & 0xfff).to_be_bytes());
        let mut bytes = [2u32, 64, 71].iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        bytes.resize(64, 0);
        for byte in 0..2 {
            bytes.push(5);
            bytes.extend(values.map(|v| v[byte]));
        }
        o.put(DataElement::new(PIXELS, VR::OB, PixelFragmentSequence::new_fragments(vec![bytes])));
        // A nested image: its pixels are not the slice's.
        let mut icon = InMemDicomObject::new_empty();
        icon.put(DataElement::new(PIXELS, VR::OB, PrimitiveValue::from(vec![1u8, 2])));
        o.put(DataElement::new(Tag(0x0088, 0x0200), VR::SQ, dicom_core::value::DataSetSequence::from(vec![icon])));
    });
    let plain = series(EXPLICIT, |_, _| {});
    assert_eq!(read_volume(dir.path()).unwrap().data, read_volume(plain.path()).unwrap().data);
}

#[test]
fn one_slice_and_other_depths_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let mut o = slice(0);
    for (element, value) in [(0x100, 8), (0x101, 8), (0x102, 7), (0x103, 0)] {
        word(&mut o, Tag(0x0028, element), value);
    }
    o.put(DataElement::new(PIXELS, VR::OB, PrimitiveValue::from(vec![0u8, 1, 2, 3, 4, 255])));
    o.remove_element(Tag(0x0028, 0x1052));
    o.remove_element(Tag(0x0028, 0x1053));
    write(&dir.path().join("a"), o.clone(), EXPLICIT);
    refused(&dir, &["SliceThickness", "single slice"]);
    text(&mut o, Tag(0x0018, 0x0050), VR::DS, "2.5");
    write(&dir.path().join("a"), o, IMPLICIT);
    let v = read_volume(dir.path()).unwrap();
    assert_eq!((v.grid.shape, v.grid.spacing[2]), ([3, 2, 1], 2.5));
    assert_eq!([v.data[[0, 0, 0]], v.data[[1, 0, 0]], v.data[[2, 1, 0]]], [0.0, 1.0, 255.0]);
}

#[test]
fn series_that_are_no_volume_are_refused() {
    let put = |tag, vr, k: usize, value: &'static str| {
        series(EXPLICIT, move |i, o| {
            if i == k {
                text(o, tag, vr, value);
            }
        })
    };
    refused(&put(POSITION, VR::DS, 2, "-10\\23.4\\30"), &["distance of slices", "1.9", "expected 1.5"]);
    refused(&put(POSITION, VR::DS, 4, "-10\\29\\30"), &["slices missing: 2 between 6.dcm and 5.dcm", "1.5000 mm"]);
    refused(&put(POSITION, VR::DS, 4, "-10\\26"), &["5.dcm", "ImagePositionPatient", "2 numbers"]);
    refused(&put(POSITION, VR::DS, 4, "a\\b\\c"), &["5.dcm", "ImagePositionPatient"]);
    let words = ["SeriesInstanceUID", "1.2.3 (CT, thin, 4 files)", "1.2.4 (CT, thin, 1 file)"];
    refused(&put(Tag(0x0020, 0x000e), VR::UI, 3, "1.2.4"), &words);
    let e = "ImageOrientationPatient";
    refused(&put(Tag(0x0020, 0x0037), VR::DS, 3, "1\\0\\0\\0\\1\\0"), &["6.dcm", e, "as in"]);
    refused(&put(Tag(0x0020, 0x0037), VR::DS, 3, "1\\0\\0\\1\\0\\0"), &["6.dcm", e, "orthogonal"]);
    refused(&put(Tag(0x0028, 0x0030), VR::DS, 3, "0.5\\0.7"), &["6.dcm", "PixelSpacing", "0.7", "as in"]);
    refused(&put(Tag(0x0028, 0x0030), VR::DS, 3, "0\\0.7"), &["6.dcm", "PixelSpacing", "above 0"]);
    refused(&put(Tag(0x0028, 0x1053), VR::DS, 3, "1e300"), &["6.dcm", "RescaleSlope"]);
    refused(&put(Tag(0x0028, 0x1053), VR::DS, 3, "nan"), &["6.dcm", "RescaleSlope"]);
    refused(&put(Tag(0x0028, 0x0008), VR::IS, 3, "7"), &["6.dcm", "NumberOfFrames", "found 7"]);
    let shape = series(EXPLICIT, |k, o| {
        if k == 3 {
            word(o, Tag(0x0028, 0x0010), 3);
            word(o, Tag(0x0028, 0x0011), 2);
        }
    });
    refused(&shape, &["Rows", "as in"]);
    let tilted = series(EXPLICIT, |k, o| {
        text(o, POSITION, VR::DS, &format!("{}\\{}\\30", -10.0 + 0.2 * k as f64, 20.0 + 1.5 * k as f64));
    });
    refused(&tilted, &["tilted gantry", "0.800 mm"]);
    for tag in [Tag(0x0028, 0x0030), POSITION, Tag(0x0020, 0x0037), Tag(0x0028, 0x0100), Tag(0x0020, 0x000e)] {
        let missing = series(EXPLICIT, |_, o| {
            o.remove_element(tag);
        });
        refused(&missing, &[".dcm", "no such element"]);
    }
    for (element, value, word_) in [
        (0x101, 17, "BitsStored"),
        (0x101, 0, "BitsStored"),
        (0x102, 16, "HighBit"),
        (0x103, 2, "PixelRepresentation"),
        (0x002, 3, "SamplesPerPixel"),
    ] {
        refused(&series(EXPLICIT, |_, o| word(o, Tag(0x0028, element), value)), &[word_, &format!("found {value}")]);
    }
    let none = series(EXPLICIT, |_, o| {
        o.remove_element(PIXELS);
    });
    refused(&none, &["DICOM slices", "none"]);
    let empty = tempfile::tempdir().unwrap();
    assert!(!is_volume(empty.path()));
    refused(&empty, &["DICOM slices", "none among 0 files"]);
    // One file of a series is refused with a better error than that of a scan.
    let dir = series(EXPLICIT, |_, _| {});
    assert!(is_volume(dir.path().join("5.dcm")));
}

#[test]
fn compressions_that_are_not_read_are_named() {
    for (syntax, name) in
        [("1.2.840.10008.1.2.4.51", "JPEG with 12 bits"), ("1.2.840.10008.1.2.4.201", "HTJ2K"), ("1.9", "1.9")]
    {
        let dir = series(EXPLICIT, |_, o| {
            o.put(DataElement::new(PIXELS, VR::OB, PixelFragmentSequence::new_fragments(vec![vec![1u8; 16]])));
        });
        for entry in dir.path().read_dir().unwrap() {
            let path = entry.unwrap().path();
            let bytes = std::fs::read(&path).unwrap();
            std::fs::write(path, with_syntax(&bytes, syntax)).unwrap();
        }
        refused(&dir, &["TransferSyntaxUID", name, "decompress"]);
    }
}

/// The file with another transfer syntax in its meta group (whose length `dicom-object` does not check).
fn with_syntax(bytes: &[u8], syntax: &str) -> Vec<u8> {
    let mark = [2, 0, 0x10, 0, b'U', b'I'];
    let at = bytes.windows(6).position(|w| w == mark).unwrap();
    let old = 8 + usize::from(u16::from_le_bytes([bytes[at + 6], bytes[at + 7]]));
    let mut uid = syntax.as_bytes().to_vec();
    uid.resize(uid.len().next_multiple_of(2), 0);
    let new = [&mark[..], &(uid.len() as u16).to_le_bytes(), &uid].concat();
    let mut out = [&bytes[..at], &new, &bytes[at + old..]].concat();
    // The group's length is first, at byte 140.
    let group = u32::from_le_bytes([out[140], out[141], out[142], out[143]]) + new.len() as u32 - old as u32;
    out[140..144].copy_from_slice(&group.to_le_bytes());
    out
}

/// One slice as a file, changed by `change`, in a folder of its own.
fn damaged(syntax: &str, change: impl Fn(&mut Vec<u8>)) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.dcm");
    let mut o = slice(0);
    text(&mut o, Tag(0x0018, 0x0050), VR::DS, "2");
    write(&path, o, syntax);
    let mut bytes = std::fs::read(&path).unwrap();
    change(&mut bytes);
    std::fs::write(path, bytes).unwrap();
    dir
}

#[test]
fn hostile_files_are_refused_in_words() {
    assert!(read_volume(damaged(EXPLICIT, |_| {}).path()).is_ok());
    let kind = |b: &mut Vec<u8>| {
        let at = b.windows(6).position(|w| w == [0x28, 0, 0x02, 0, b'U', b'S']).unwrap();
        b[at + 4] = 0xe9;
    };
    refused(&damaged(EXPLICIT, kind), &["a.dcm", "(0028,0002)", "two letters"]);
    refused(&damaged(EXPLICIT, |b| *b = with_syntax(b, "1.2.840.10008.1.2.1.99")), &["deflated"]);
}

proptest::proptest! {
    #[test]
    fn no_bytes_make_it_panic(changes in proptest::collection::vec((132usize..700, 0u8..), 1..8), syntax in 0usize..3) {
        let dir = damaged([EXPLICIT, IMPLICIT, BIG][syntax], |b| {
            for &(at, x) in &changes {
                if let Some(b) = b.get_mut(at) {
                    *b = x;
                }
            }
        });
        let _ = read_volume(dir.path());
    }
}
