//! HDF5 in its layouts, and Nikon's description.

use crate::case::{Case, End, changed, cut, put, replaced, table, then};
use conefield_tests::hostile::seeds::{CIL, scanner_cil, scanner_hdf5, scanner_nxtomo, scanner_toml, xtekct};
use std::path::Path;

const IMPORT: &str = "import scanner.toml -o scan";
const NIKON: &str = "import bone.xtekct -o scan";
const FILE: &str = "counts.h5";

/// The NXtomo file with the first `from` replaced by `to`: its headers have no checksums.
fn keyed<const N: usize>(from: [u8; N], to: [u8; N]) -> impl Fn(&Path) + Sync + Send {
    changed(scanner_nxtomo, FILE, move |b| {
        let at = b.windows(N).position(|w| w == from).expect("bytes of the seed");
        b[at..at + N].copy_from_slice(&to);
    })
}

/// The number of frames.
fn frames(n: u64) -> [u8; 24] {
    let mut all = [0; 24];
    for (to, x) in all.chunks_exact_mut(8).zip([n, 4, 5]) {
        to.copy_from_slice(&x.to_le_bytes());
    }
    all
}

/// The image keys.
fn keys(all: [u8; 6]) -> [u8; 24] {
    std::array::from_fn(|i| if i % 4 == 0 { all[i / 4] } else { 0 })
}

fn described(from: &'static str, to: &'static str) -> impl Fn(&Path) + Sync + Send {
    replaced(scanner_hdf5, "scanner.toml", from, to)
}

fn nikon(from: &'static str, to: &'static str) -> impl Fn(&Path) + Sync + Send {
    replaced(xtekct, "bone.xtekct", from, to)
}

pub fn cases() -> Vec<Case> {
    table! {
        "cut within its mark", changed(scanner_hdf5, FILE, cut(7)), IMPORT, [FILE, "format"];
        "cut behind its mark", changed(scanner_hdf5, FILE, cut(20)), IMPORT, [FILE, "HDF5"];
        "cut in the middle", changed(scanner_hdf5, FILE, |b| b.truncate(b.len() / 2)), IMPORT, [FILE];
        "a header with a wrong checksum", changed(scanner_hdf5, FILE, |b| b[44] ^= 1), IMPORT, [FILE];
        "a data set that is not there",
            described("projections = \"counts.h5\"", "projections = \"counts.h5:/exchange/datum\""),
            IMPORT, ["/exchange/datum", "no such thing"];
        "a data set of one axis",
            described("projections = \"counts.h5\"", "projections = \"counts.h5:/exchange/theta\""),
            IMPORT, ["theta", "[3]", "two axes"];
        "a million frames in 17 kB", keyed(frames(6), frames(1_000_000)), IMPORT, [FILE, "at most"];
        "frames past 2^64", keyed(frames(6), frames(u64::MAX)), IMPORT, [FILE, "addressed"];
        "no frames", keyed(frames(6), frames(0)), IMPORT, [FILE, "at least one"];
        "more frames than chunks", keyed(frames(6), frames(60)), IMPORT, [FILE, "one for each frame"];
        "no projection", keyed(keys([2, 1, 0, 0, 0, 1]), keys([2, 1, 1, 1, 1, 1])), IMPORT, ["image_key", "key 0"];
        "no open beam", keyed(keys([2, 1, 0, 0, 0, 1]), keys([2, 0, 0, 0, 0, 0])), IMPORT, [FILE, "image_key"];
        "CIL: another file's geometry", |d| {
            scanner_cil(d);
            scanner_nxtomo(&d.join("."));
            put(
                d.join("scanner.toml"),
                scanner_toml(FILE, CIL),
            );
        }, IMPORT, [FILE, "entry1/tomo_entry"];
        "CIL: no file of that name",
            replaced(scanner_cil, "scanner.toml", "file = \"counts.h5\"", "file = \"none.nxs\""),
            IMPORT, ["cil.file", "none.nxs"];
        "packed by a filter that is not read", changed(scanner_nxtomo, FILE, |b| {
            let at = b.windows(8).position(|w| w == b"deflate\0").expect("a filter of the seed") - 8;
            b[at..at + 2].copy_from_slice(&32_008u16.to_le_bytes());
        }), IMPORT, [FILE, "bitshuffle", "h5repack -f NONE"];
        "Nikon: measured angles that differ from even steps",
            then(xtekct, |d| put(d.join("_ctdata.txt"), "Projection\tAngle(deg)\n1\t3\n2\t110\n3\t250\n")),
            NIKON, ["_ctdata.txt", "degrees from steps of 120"].ends(End::Warned);
        "Nikon: too few measured angles",
            then(xtekct, |d| put(d.join("_ctdata.txt"), "Projection\tAngle(deg)\n1\t3\n2\t110\n")),
            NIKON, ["_ctdata.txt", "angle of projection 3"];
        "Nikon: a key that may move the volume", nikon("SrcToObject=500\n", "SrcToObject=500\nOffsetX=-4\n"),
            NIKON, ["not read", "OffsetX = -4"].ends(End::Warned);
        "Nikon: no distance", nikon("SrcToObject=500\n", ""), NIKON, ["SrcToObject", "nothing"];
        "Nikon: a distance of 0", nikon("SrcToDetector=800", "SrcToDetector=0"), NIKON, ["SrcToDetector", "above 0"];
        "Nikon: two distances", nikon("SrcToObject=500\n", "SrcToObject=500\nSrcToObject=5\n"),
            NIKON, ["SrcToObject", "one value"];
        "Nikon: 10^15 views", nikon("Projections=3", "Projections=1e15"), NIKON, ["Projections", "1000000"];
        "Nikon: more views than images", nikon("Projections=3", "Projections=4"), NIKON, ["bone_0004.tif"];
        "Nikon: another detector", nikon("DetectorPixelsY=4", "DetectorPixelsY=5"), NIKON, ["4 x 5", "5 x 5"];
        "Nikon: a folder above", nikon("InputFolderName=", "InputFolderName=.."), NIKON, ["without \"..\""];
        "Nikon: an empty file", changed(xtekct, "bone.xtekct", Vec::clear), NIKON, ["bone.xtekct", "Projections"];
    }
}
