//! MetaImage: one file or two.

use crate::case::{AMPLE, Case, changed, cut, cut_end, put, replaced, table, then};
use conefield_tests::hostile::seeds::{metaimage, metaimage_header, metaimage_lines, zlib};
use std::path::Path;

const INFO: &str = "info a.mhd";

/// A header with zlib data of `size` zeros in a second file.
fn packed(dir: &Path, shape: &str, size: usize) {
    let text =
        metaimage_lines("a.zraw").replace("4 3 2\n", shape).replace("CompressedData = False", "CompressedData = True");
    put(dir.join("a.mhd"), text);
    put(dir.join("a.zraw"), zlib(&vec![0; size]));
}

fn lines(from: &'static str, to: &'static str) -> impl Fn(&Path) + Sync + Send {
    replaced(metaimage_header, "a.mhd", from, to)
}

pub fn cases() -> Vec<Case> {
    table! {
        "cut within the lines", changed(metaimage, "a.mha", cut(90)), "info a.mha", ["line 5", "Name = value"];
        "cut within the packed voxels", changed(metaimage, "a.mha", cut_end(5)), "info a.mha", ["CompressedDataSize"];
        "no entry DimSize", lines("DimSize = 4 3 2\n", ""), INFO, ["DimSize", "no such entry"];
        "a misspelt entry", lines("DimSize", "DimSise"), INFO, ["DimSize", "no such entry"];
        "an axis without voxels", lines("4 3 2\n", "4 0 2\n"), INFO, ["DimSize", "4 0 2", "above 0"];
        "a negative axis", lines("4 3 2\n", "4 -3 2\n"), INFO, ["DimSize", "above 0"];
        "a product past 2^64", lines("4 3 2\n", "4294967296 4294967296 4294967296\n"), INFO, ["DimSize", "addressed"];
        "three numbers for two axes", lines("NDims = 3", "NDims = 2"), INFO, ["NDims", "found 2"];
        "a size of NaN", lines("0.5 0.75 2", "nan 0.75 2"), INFO, ["ElementSpacing", "finite"];
        "an axis of length zero", lines("1 0 0 0 1", "0 0 0 0 1"), INFO, ["TransformMatrix", "independent"];
        "a text that is no UTF-8",
            then(metaimage_header, |d| put(d.join("a.mhd"), b"ObjectType = Image\nNDims = \xff\xfe\n")),
            INFO, ["a.mhd"];
        "an entry twice", lines("NDims = 3\n", "NDims = 3\nNDims = 3\n"), INFO, ["NDims", "two entries"];
        "data in /etc/passwd", lines("a.raw", "/etc/passwd"), INFO, ["ElementDataFile", "inside the folder"];
        "data in the folder above", lines("a.raw", "../a.raw"), INFO, ["ElementDataFile", "without \"..\""];
        "data behind a link that leads out", |d| {
            metaimage_header(d);
            std::fs::remove_file(d.join("a.raw")).unwrap();
            std::os::unix::fs::symlink("/etc/hostname", d.join("a.raw")).unwrap();
        }, INFO, ["ElementDataFile", "link out of the folder"];
        "data in a list of files", lines("a.raw", "LIST"), INFO, ["ElementDataFile", "one file"];
        "a number of bytes to pass over that is past the end",
            lines("ObjectType", "HeaderSize = 99999999999\nObjectType"), INFO, ["HeaderSize", "up to 24"];
        "zlib that claims 64 TB", |d| packed(d, "40000 40000 40000\n", 24),
            INFO, ["claims 64000000000000 bytes"].memory(AMPLE);
        "zlib bomb: 300 MB of zeros in 300 kB", |d| packed(d, "1000 1000 300\n", 300_000_000),
            INFO, ["100 times"].memory(AMPLE);
        "zlib with less than it says", |d| packed(d, "4 3 2\n", 23), INFO, ["end of the file after 23 bytes"];
        "lines without an end, 1 MB",
            |d| put(d.join("a.mhd"), [b"NDims = 3\n".as_slice(), &vec![b'x'; 1 << 20]].concat()),
            INFO, ["ElementDataFile", "65536 bytes"];
    }
}
