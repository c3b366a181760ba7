//! `.npy` and `.npz`.

use crate::case::{AMPLE, Case, changed, cut, cut_end, put, table, then};
use conefield_tests::hostile::seeds::{CIRCLE, npy, npy_bytes, scanner_npz, scanner_toml};
use std::fs::File;
use std::io::Write;
use std::path::Path;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

const INFO: &str = "info a.npy";
const IMPORT: &str = "import scanner.toml -o scan";

fn array(descr: &'static str, shape: &'static str, data: &'static [u8]) -> impl Fn(&Path) + Sync + Send {
    move |d| put(d.join("a.npy"), npy_bytes(descr, shape, data))
}

/// An archive with one deflated array: its header, then `zeros` bytes.
fn archive(dir: &Path, shape: &str, zeros: usize) {
    put(dir.join("scanner.toml"), scanner_toml("counts.npz", CIRCLE));
    let mut w = ZipWriter::new(File::create(dir.join("counts.npz")).unwrap());
    w.start_file("a.npy", SimpleFileOptions::default().compression_method(CompressionMethod::Deflated)).unwrap();
    w.write_all(&npy_bytes("|u1", shape, &[])).unwrap();
    let block = vec![0; 1 << 20];
    (0..zeros >> 20).for_each(|_| w.write_all(&block).unwrap());
    w.finish().unwrap();
}

pub fn cases() -> Vec<Case> {
    table! {
        "cut within the magic number", changed(npy, "a.npy", cut(4)), INFO, ["a.npy"];
        "cut within the header", changed(npy, "a.npy", cut(40)), INFO, ["header", "end of the file"];
        "one byte of data missing", changed(npy, "a.npy", cut_end(1)), INFO, ["95 bytes", "96 bytes"];
        "version 9", changed(npy, "a.npy", |b| b[6] = 9), INFO, ["version", "found 9"];
        "a header of 4 GB", changed(npy, "a.npy", |b| {
            b.splice(6..10, [2, 0, 255, 255, 255, 255]);
        }), INFO, ["header length", "4294967295"];
        "Python that would run",
            |d| put(d.join("a.npy"), npy_bytes("<f4", "__import__('os').system('touch run')", &[0; 4])),
            INFO, ["header", "expected {'descr'"];
        "a shape with a product past 2^64", array("<f4", "(4294967296, 4294967296, 4294967296)", &[0; 4]),
            INFO, ["18446744073709551615", "no machine"];
        "a number past 2^64 in the shape", array("<f4", "(99999999999999999999, 1, 1)", &[0; 4]), INFO, ["header"];
        "an empty axis", array("<f4", "(2, 0, 2)", &[]), INFO, ["shape", "at least one"];
        "two axes", array("<f4", "(2, 2)", &[0; 16]), INFO, ["shape", "[2, 2]", "x, y, z"];
        "an array of objects", array("|O", "(1, 1, 1)", &[0; 8]), INFO, ["descr", "'|O'"];
        "complex numbers", array("<c8", "(1, 1, 1)", &[0; 8]), INFO, ["descr", "'<c8'"];
        "records", array("[('a', '<f4')]", "(1, 1, 1)", &[0; 4]), INFO, ["a.npy"];
        "a value that is NaN", array("<f4", "(1, 1, 2)", &[0, 0, 0, 0, 0, 0, 192, 127]), INFO, ["data[0, 0, 1]", "NaN"];
        "a double past the range of 32 bits", array("<f8", "(1, 1, 1)", &[0, 0, 0, 0, 0, 0, 0xe0, 0x7f]),
            INFO, ["data[0, 0, 0]", "inf"];
        "an archive cut in the middle", changed(scanner_npz, "counts.npz", |b| b.truncate(b.len() / 2)),
            IMPORT, ["counts.npz", "ZIP"];
        "an archive whose array is damaged", changed(scanner_npz, "counts.npz", |b| b[90] ^= 0x55),
            IMPORT, ["counts.npz"];
        "an array that the archive lacks",
            then(scanner_npz, |d| put(d.join("scanner.toml"), scanner_toml("counts.npz:flat", CIRCLE))),
            IMPORT, ["no \"flat\"", "counts"];
        "an archive that claims 30 GB in 200 bytes", |d| archive(d, "(3, 100000, 100000)", 0),
            IMPORT, ["30000000000 bytes"].memory(AMPLE);
        "zip bomb: 300 MB of zeros in 300 kB", |d| archive(d, "(300, 1024, 1024)", 300 << 20), IMPORT, ["100 times"];
    }
}
