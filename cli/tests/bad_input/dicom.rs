//! A folder of DICOM files.

use crate::case::{Case, changed, cut, cut_end, put, table, then};
use conefield_tests::hostile::seeds::{dicom, dicom_jpeg_2000, dicom_jpeg_ls, dicom_run_length};
use std::path::Path;

const INFO: &str = "info series";
const FILE: &str = "series/0.dcm";

/// Offset of the element `tag`.
fn find(bytes: &[u8], tag: [u8; 4]) -> usize {
    bytes.windows(4).position(|w| w == tag).expect("an element of the seed")
}

/// Replaces the value of an element, which follows a head of eight bytes.
fn value(tag: [u8; 4], value: &'static [u8]) -> impl Fn(&Path) + Sync + Send {
    changed(dicom, FILE, move |b| {
        let start = find(b, tag) + 8;
        b[start..start + value.len()].copy_from_slice(value);
    })
}

/// Inserts bytes before `BitsAllocated`.
fn inserted(bytes: Vec<u8>) -> impl Fn(&Path) + Sync + Send {
    changed(dicom, FILE, move |b| {
        let start = find(b, [0x28, 0, 0, 1]);
        b.splice(start..start, bytes.clone());
    })
}

const SEQUENCE: [u8; 20] =
    [0x20, 0, 0, 0x40, b'S', b'Q', 0, 0, 255, 255, 255, 255, 0xfe, 0xff, 0, 0xe0, 255, 255, 255, 255];

pub fn cases() -> Vec<Case> {
    table! {
        "an empty folder", |d| std::fs::create_dir(d.join("series")).unwrap(), "convert series out.nii", ["series"];
        "a file cut within its description", changed(dicom, FILE, cut(200)), INFO, ["0.dcm"];
        "a file cut within its pixels", changed(dicom, FILE, cut_end(1)), INFO, ["(7FE0,0010)", "11 bytes"];
        "a file that is only the mark", changed(dicom, FILE, cut(132)), INFO, ["0.dcm"];
        "a JPEG-LS picture of another size", changed(dicom_jpeg_ls, FILE, |b| {
            let start = find(b, [0xff, 0xf7, 0, 11]);
            b[start + 6] = 200;
        }), "convert series out.nii", ["PixelData", "200 rows"];
        "a JPEG 2000 picture of 4 billion columns", changed(dicom_jpeg_2000, FILE, |b| {
            let start = find(b, [0xff, 0x4f, 0xff, 0x51]);
            b[start + 8..start + 12].fill(255);
        }), "convert series out.nii", ["PixelData", "4294967295 columns"];
        "a JPEG 2000 picture that is damaged", changed(dicom_jpeg_2000, FILE, |b| {
            let start = find(b, [0xff, 0x52, 0, 12]);
            b[start..start + 14].fill(0);
        }), "convert series out.nii", ["PixelData", "cannot be decoded"];
        "no rows", value([0x28, 0, 0x10, 0], &[0, 0]), INFO, ["Rows", "found 0"];
        "65535 rows in 12 bytes", value([0x28, 0, 0x10, 0], &[255, 255]),
            INFO, ["PixelData", "12 bytes", "393210 bytes"];
        "numbers of 12 bits", value([0x28, 0, 0, 1], &[12, 0]), INFO, ["BitsAllocated", "12"];
        "a pixel size that is no number", value([0x28, 0, 0x30, 0], b"a"), INFO, ["PixelSpacing"];
        "a position that is NaN", value([0x20, 0, 0x32, 0], b"nan"), INFO, ["ImagePositionPatient"];
        "two slices at one place", then(dicom, |d| _ = std::fs::copy(d.join(FILE), d.join("series/2.dcm")).unwrap()),
            INFO, ["ImagePositionPatient", "0.dcm and 2.dcm"];
        "two series", value([0x20, 0, 0x0e, 0], b"9"), INFO, ["SeriesInstanceUID", "one series"];
        "an element of 2 GB", inserted(vec![0x20, 0, 0, 0x40, b'U', b'T', 0, 0, 0, 0, 0, 0x80]),
            INFO, ["(0020,4000)", "2147483648 bytes"];
        "an element of a kind that does not exist, of 1 GB",
            inserted(vec![0x20, 0, 0, 0x40, b'X', b'Y', 0, 0, 0, 0, 0, 0x40]),
            INFO, ["(0020,4000)", "1073741824 bytes"];
        "an element of half a value", inserted(vec![0x20, 0, 0, 0x40, b'U', b'L', 2, 0, 0, 0]),
            INFO, ["(0020,4000)", "a multiple of 4"];
        "100 000 sequences in each other", inserted(SEQUENCE.repeat(100_000)), INFO, ["levels"];
        "a description that claims 4 GB", changed(dicom, FILE, |b| b[140..144].fill(255)),
            INFO, ["FileMetaInformationGroupLength"];
        "a compressed picture whose piece claims 4 GB", changed(dicom_run_length, FILE, |b| {
            let at = find(b, [0xfe, 0xff, 0, 0xe0]);
            b[at + 12..at + 16].copy_from_slice(&[0xff, 0xff, 0xff, 0xfe]);
        }), INFO, ["0.dcm", "bytes"];
        "run lengths that end early", changed(dicom_run_length, FILE, |b| {
            let at = b.len() - 18;
            b[at] = 128;
        }), INFO, ["PixelData", "segment"];
        "a packing that is not known", changed(dicom, FILE, |b| {
            let at = find(b, [2, 0, 0x10, 0]) + 8;
            b[at..at + 20].copy_from_slice(b"1.2.840.10008.1.2.9\0");
        }), INFO, ["TransferSyntaxUID", "decompress"];
        "one file in place of the folder", dicom, "convert series/0.dcm out.nii", ["one DICOM file", "folder"];
        "no DICOM in the folder", |d| {
            std::fs::create_dir(d.join("series")).unwrap();
            put(d.join("series/a.txt"), "x");
        }, "evaluate series series", ["DICOM slices", "none among 1 file "];
    }
}
