//! NAF's pickle, which could run anything in Python.

use crate::case::{Case, End, changed, cut_end, put, table};
use conefield_core::geometry::{Millimetres, Radians, View};
use conefield_tests::hostile::seeds::{SHAPE, naf, scan, volume};
use std::path::Path;

const INFO: &str = "info scan.pickle";

fn pickle(bytes: impl AsRef<[u8]> + Sync + Send) -> impl Fn(&Path) + Sync + Send {
    move |d| put(d.join("scan.pickle"), bytes.as_ref())
}

/// Renames the key `from` to one of the same length.
fn key(from: &'static str, to: &'static str) -> impl Fn(&Path) + Sync + Send {
    changed(naf, "scan.pickle", move |b| {
        let start = b.windows(from.len()).position(|w| w == from.as_bytes()).expect("a key of the seed");
        b[start..start + to.len()].copy_from_slice(to.as_bytes());
    })
}

/// Replaces every occurrence of a float.
fn float(from: f64, to: f64) -> impl Fn(&Path) + Sync + Send {
    changed(naf, "scan.pickle", move |b| {
        let start = b.windows(8).position(|w| w == from.to_be_bytes()).expect("a number of the seed");
        b[start..start + 8].copy_from_slice(&to.to_be_bytes());
    })
}

/// Replaces the first projection value.
fn projection(to: f32) -> impl Fn(&Path) + Sync + Send {
    changed(naf, "scan.pickle", move |b| {
        let raw: Vec<u8> = scan().projections.iter().flat_map(|x| x.to_le_bytes()).collect();
        let start = b.windows(raw.len()).position(|w| w == raw).expect("the projections as they are");
        b[start..start + 4].copy_from_slice(&to.to_le_bytes());
    })
}

/// Angles in degrees, labelled as radians.
fn degrees(d: &Path) {
    let (mut scan, mm) = (scan(), Millimetres);
    for (i, view) in scan.geometry.views.iter_mut().enumerate() {
        *view = View::circular(Radians(0.3 + i as f64), mm(500.0), mm(800.0), [mm(2.0), mm(1.5)], [mm(0.0); 2]);
    }
    conefield_io::write_naf(d.join("scan.pickle"), &scan, None, Some(&volume())).unwrap();
    let mut bytes = std::fs::read(d.join("scan.pickle")).unwrap();
    let angles: Vec<u8> = (0..SHAPE[0]).flat_map(|i| (0.3 + i as f64).to_le_bytes()).collect();
    let near = |w: &[u8]| {
        let value = |w: &[u8]| f64::from_le_bytes(w.try_into().unwrap());
        w.chunks(8).zip(angles.chunks(8)).all(|(a, b)| (value(a) - value(b)).abs() < 1e-9)
    };
    let start = bytes.windows(angles.len()).position(near).expect("the angles as they are");
    for (i, degree) in [17.0f64, 137.0, 257.0].iter().enumerate() {
        bytes[start + 8 * i..start + 8 * i + 8].copy_from_slice(&degree.to_le_bytes());
    }
    put(d.join("scan.pickle"), bytes);
}

pub fn cases() -> Vec<Case> {
    table! {
        "nothing but the mark", pickle(b"\x80\x04"), INFO, ["byte 2", "end of the file"];
        "cut at the end", changed(naf, "scan.pickle", cut_end(1)), INFO, ["end of the file"];
        "cut in the middle", changed(naf, "scan.pickle", |b| b.truncate(b.len() / 2)),
            "convert scan.pickle scan", ["end of the file"];
        "bytes behind the end", changed(naf, "scan.pickle", |b| b.push(0)), INFO, ["1 bytes after the end"];
        "os.system", pickle(b"\x80\x02cos\nsystem\nX\x09\0\0\0touch run\x85R."),
            "convert scan.pickle scan", ["the name os.system", "data only"];
        "builtins.eval", pickle(b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93\x8c\x021\x031\x85R."),
            INFO, ["the name builtins.eval"];
        "numpy's own loader of other pickles", pickle(b"\x80\x02cnumpy\nload\nX\x01\0\0\0a\x85R."),
            INFO, ["the name numpy.load"];
        "a call by getattr", pickle(b"\x80\x02c__builtin__\ngetattr\n)R."), INFO, ["the name __builtin__.getattr"];
        "an object made by its class", pickle(b"\x80\x02cnumpy\nndarray\n)\x81."), INFO, ["NEWOBJ"];
        "a persistent reference", pickle(b"\x80\x02X\x01\0\0\0aQ."), INFO, ["BINPERSID", "data only"];
        "protocol 0", pickle(b"(dp0\n."), "convert scan.pickle scan", ["scan.pickle"];
        "an array of objects", pickle(b"\x80\x02cnumpy\ndtype\nX\x02\0\0\0O8\x85R."), INFO, ["the object dtype \"O8\""];
        "a list that holds itself", pickle(b"\x80\x02]q\0h\0a."), INFO, ["holds itself"];
        "100 000 lists in each other",
            pickle([b"\x80\x02".to_vec(), vec![b']'; 100_000], vec![b'a'; 99_999], b".".to_vec()].concat()),
            INFO, ["nested deeper"];
        "5 million values in 5 MB",
            |d| put(d.join("scan.pickle"), [b"\x80\x02".to_vec(), vec![b']'; 5_000_000], b".".to_vec()].concat()),
            INFO, ["values", "NumPy arrays"];
        "2 million numbered values", |d| {
            let mut bytes = b"\x80\x02N".to_vec();
            (0..2_000_000u32).for_each(|i| bytes.extend([b'r'].into_iter().chain(i.to_le_bytes())));
            put(d.join("scan.pickle"), bytes);
        }, INFO, ["numbered values"];
        "a tuple of tuples of tuples (2^30 by the memo)", |d| {
            let mut bytes = b"\x80\x02)".to_vec();
            (0..40).for_each(|_| bytes.extend(b"2\x86"));
            bytes.push(b'.');
            put(d.join("scan.pickle"), bytes);
        }, INFO, ["nested deeper"];
        "a text of 4 GB", pickle(b"\x80\x02X\xff\xff\xff\xffabc."), INFO, ["4294967295 bytes"];
        "a text of 2^63 bytes", pickle(b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\x7fabc."),
            INFO, ["9223372036854775807 bytes"];
        "a text that is no UTF-8", pickle(b"\x80\x02X\x02\0\0\0\xff\xfe."), INFO, ["UTF-8"];
        "an empty stack", pickle(b"\x80\x020."), INFO, ["an empty stack"];
        "no scan but a number", pickle(b"\x80\x02K\x01."), INFO, ["a dict"];
        "a missing key", pickle(b"\x80\x02}."), INFO, ["no such key", "mode"];
        "a misspelt key", key("nDetector", "nDetectro"), INFO, ["nDetector", "but \"nDetectro\""];
        "a misspelt key that may be missing", key("offOrigin", "offOrigim"), INFO, ["offOrigim", "\"offOrigin\""];
        "a distance that is NaN", float(500.0, f64::NAN), INFO, ["DSO", "finite"];
        "a negative distance", float(800.0, -800.0), INFO, ["DSD", "-800"];
        "a beam of another kind", key("cone", "para"), INFO, ["mode", "\"para\"", "cone"];
        "a projection that is NaN", projection(f32::NAN), INFO, ["train.projections[0, 0, 0]", "NaN"];
        "a projection that is infinite", projection(f32::INFINITY),
            "convert scan.pickle scan", ["train.projections[0, 0, 0]", "inf"];
        "angles in degrees", degrees, INFO, ["train.angles", "looks like degrees"].ends(End::Warned);
    }
}
