//! NumPy's `.npy`: a header in Python's notation, then the numbers.

use crate::file_order::{self, FileOrder};
use crate::input::Input;
use crate::memory;
use crate::number::{self, ByteOrder, Number};
use conefield_core::parts::Voxels;
use conefield_core::{Error, Result};
use ndarray::{Array, ArrayD, Dimension, IxDyn, ShapeBuilder};
use serde_json::{Map, Value};
use std::io::Write;
use std::path::Path;

/// The magic bytes.
pub(crate) const MAGIC: &[u8] = b"\x93NUMPY";

/// Longest header that is read; NumPy's own are below 200 bytes.
const LONGEST_HEADER: usize = 1 << 16;

/// The header's entries.
#[derive(Debug, PartialEq)]
pub(crate) struct Header {
    pub number: Number,
    pub order: ByteOrder,
    pub fortran: bool,
    pub shape: Vec<usize>,
}

/// Reads an array with the named axes as `f32` in C order; refuses values that are not finite.
pub(crate) fn read(path: &Path, axes: &[&str]) -> Result<ArrayD<f32>> {
    read_counts(&mut Input::open(path)?, &[axes]).map(|(array, _)| array)
}

/// Like [`read`], for an array with any of several sets of axes, with the type of the numbers in the file.
pub(crate) fn read_counts(input: &mut Input, sets: &[&[&str]]) -> Result<(ArrayD<f32>, Number)> {
    let header = read_header(input)?;
    array(input, &header, sets)
}

/// The array that `header` describes, of one of the sets of axes; `input` has its data and nothing after it.
pub(crate) fn array(input: &mut Input, header: &Header, sets: &[&[&str]]) -> Result<(ArrayD<f32>, Number)> {
    let expected = || {
        let each: Vec<String> = sets.iter().map(|a| format!("{} axes ({})", a.len(), a.join(", "))).collect();
        each.join(" or ")
    };
    if !sets.iter().any(|axes| header.shape.len() == axes.len()) {
        return Err(input.invalid("shape", format!("{:?}", header.shape), expected()));
    }
    if header.shape.contains(&0) {
        return Err(input.invalid("shape", format!("{:?}", header.shape), "at least one element along every axis"));
    }
    let count = header
        .shape
        .iter()
        .try_fold(1usize, |n, &s| n.checked_mul(s))
        .filter(|n| n.checked_mul(8).is_some_and(|b| b <= isize::MAX as usize))
        .ok_or_else(|| input.invalid("shape", format!("{:?}", header.shape), "a size that can be addressed"))?;
    let values = input.singles("data", count, header.number, header.order)?;
    let array = ArrayD::from_shape_vec(IxDyn(&header.shape).set_f(header.fortran), values)
        .map_err(|e| input.invalid("shape", e, expected()))?;
    let array = memory::in_order(&input.place(), "data", array)?;
    let array = memory::all_finite(&input.place(), array, &|at| format!("data{:?}", at.slice()))?;
    Ok((array, header.number))
}

/// Shape and numbers, in C order and full precision, of a small array of one or two axes.
pub(crate) fn read_exact(input: &mut Input) -> Result<(Vec<usize>, Vec<f64>)> {
    let header = read_header(input)?;
    exact(input, &header)
}

/// Like [`read_exact`], for the array that `header` describes.
pub(crate) fn exact(input: &mut Input, header: &Header) -> Result<(Vec<usize>, Vec<f64>)> {
    let count = header.shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s));
    let fits = count.filter(|n| (1..=2).contains(&header.shape.len()) && *n > 0 && *n < 1 << 32);
    let count = fits.ok_or_else(|| {
        input.invalid("shape", format!("{:?}", header.shape), "one or two axes with at least one element along each")
    })?;
    let values = input.doubles("data", count, header.number, header.order)?;
    let values = match (header.fortran, &header.shape[..]) {
        (true, &[rows, columns]) => in_c_order(&values, [rows, columns]),
        _ => values,
    };
    Ok((header.shape.clone(), values))
}

/// The numbers of an array of this shape, which are in Fortran order, in C order.
pub(crate) fn in_c_order(values: &[f64], [rows, columns]: [usize; 2]) -> Vec<f64> {
    (0..values.len()).map(|i| values[i % columns * rows + i / columns]).collect()
}

/// Writes `array` as little-endian `f32` in C order.
pub(crate) fn write<D: Dimension>(w: &mut dyn Write, path: &Path, array: &Array<f32, D>) -> Result<()> {
    let io = |e| Error::io(path, e);
    w.write_all(&header(array.shape())).map_err(io)?;
    number::write(w, array.as_standard_layout().as_slice().unwrap_or(&[])).map_err(io)
}

/// Writes `voxels`, `[x, y, z]`, like [`write`].
pub(crate) fn write_voxels(w: &mut dyn Write, path: &Path, voxels: &mut dyn Voxels) -> Result<()> {
    w.write_all(&header(&voxels.grid().shape)).map_err(|e| Error::io(path, e))?;
    file_order::write(w, path, voxels, FileOrder::ZFastest)
}

/// The header of little-endian `f32` of this shape in C order: format version 1, padded to a multiple of 64 bytes.
fn header(shape: &[usize]) -> Vec<u8> {
    let axes: String = match shape {
        [one] => format!("{one},"),
        all => all.iter().map(usize::to_string).collect::<Vec<_>>().join(", "),
    };
    let mut text = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({axes})}}");
    let before = MAGIC.len() + 4;
    let whole = (before + text.len() + 1).next_multiple_of(64);
    text.push_str(&" ".repeat(whole - before - text.len() - 1));
    text.push('\n');
    [MAGIC, &[1, 0], &(text.len() as u16).to_le_bytes(), text.as_bytes()].concat()
}

/// The shape in the header.
pub(crate) fn shape(input: &mut Input) -> Result<Vec<usize>> {
    read_header(input).map(|h| h.shape)
}

fn read_header(input: &mut Input) -> Result<Header> {
    let magic = input.exactly(8, "header")?;
    let expected = "93 4e 55 4d 50 59 (\\x93NUMPY)";
    input.ensure(magic.starts_with(MAGIC), "magic", format!("{:02x?}", &magic[..6]), expected)?;
    let length = match magic[6] {
        1 => input.exactly(2, "header")?,
        2 | 3 => input.exactly(4, "header")?,
        v => return Err(input.invalid("version", v, "1, 2 or 3")),
    };
    let length = length.iter().rev().fold(0usize, |n, b| n << 8 | *b as usize);
    input.ensure(length <= LONGEST_HEADER, "header length", length, format!("at most {LONGEST_HEADER} bytes"))?;
    let raw = input.exactly(length, "header")?;
    let text = String::from_utf8_lossy(&raw);
    let bad = || {
        let shown: String = text.chars().take(200).collect();
        input.invalid("header", shown.trim(), "{'descr': '<f4', 'fortran_order': False, 'shape': (…), }")
    };
    let entries = entries(&text).filter(|all| all.keys().all(|key| KEYS.contains(&&key[..]))).ok_or_else(bad)?;
    let [descr, fortran, shape] =
        KEYS.map(|key| entries.get(key).ok_or_else(|| input.invalid(key, "nothing", "an entry in the header")));
    let descr = descr?.as_str().ok_or_else(bad)?;
    let (number, order) = element(descr).ok_or_else(|| {
        input.invalid("descr", format!("'{descr}'"), "real numbers: b1, i1 to i8, u1 to u8, f4 or f8")
    })?;
    let fortran = fortran?.as_bool().ok_or_else(bad)?;
    let length = |n: &Value| usize::try_from(n.as_u64()?).ok();
    let shape = shape?.as_array().and_then(|all| all.iter().map(length).collect()).ok_or_else(bad)?;
    Ok(Header { number, order, fortran, shape })
}

/// The entries of a header.
const KEYS: [&str; 3] = ["descr", "fortran_order", "shape"];

/// The entries of a dict in the notation that headers use: Python's, which differs from JSON in these characters.
fn entries(text: &str) -> Option<Map<String, Value>> {
    let mut json = text.split_whitespace().collect::<Vec<_>>().join(" ");
    // The last two are Python 2's suffix of long integers.
    for (python, other) in [
        ("'", "\""),
        ("(", "["),
        (")", "]"),
        (" ]", "]"),
        (" }", "}"),
        (" ,", ","),
        (",]", "]"),
        (",}", "}"),
        ("True", "true"),
        ("False", "false"),
        ("L,", ","),
        ("L]", "]"),
    ] {
        json = json.replace(python, other);
    }
    match serde_json::from_str(&json).ok()? {
        Value::Object(entries) => Some(entries),
        _ => None,
    }
}

/// Number type and byte order of NumPy's name for a real type, e.g. `<f4`; `None` for any other.
pub(crate) fn element(descr: &str) -> Option<(Number, ByteOrder)> {
    let (order, kind) = match descr.chars().next()? {
        '<' | '|' => (ByteOrder::Little, &descr[1..]),
        '>' => (ByteOrder::Big, &descr[1..]),
        '=' => (if cfg!(target_endian = "big") { ByteOrder::Big } else { ByteOrder::Little }, &descr[1..]),
        _ => (ByteOrder::Little, descr),
    };
    let (kind, bytes) = kind.split_at_checked(1)?;
    let bytes = ["1", "2", "4", "8"].iter().position(|n| *n == bytes)?;
    let number = Number::of(kind.chars().next()?, 1 << bytes)?;
    Some((number, order))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{file, npy_bytes, says};
    use ndarray::{Array3, array};
    use ndarray_npy::WriteNpyExt;

    fn read_bytes(bytes: &[u8], axes: &[&str]) -> Result<ArrayD<f32>> {
        read(&file("a.npy", &[bytes]).1, axes)
    }

    fn refused(bytes: &[u8], words: &[&str]) {
        says(read_bytes(bytes, &["x", "y", "z"]), &[&["a.npy"], words].concat());
    }

    #[test]
    fn what_is_written_comes_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        let a = Array3::from_shape_fn((3, 4, 5), |(x, y, z)| (x * 100 + y * 10 + z) as f32 - 7.5);
        crate::write_atomic(&path, &mut |w| write(w, &path, &a)).unwrap();
        assert_eq!(read(&path, &["x", "y", "z"]).unwrap(), a.clone().into_dyn());
        // Byte for byte what a library writes, also with fewer axes; an array in another order is converted to C order.
        let bytes = |write: &dyn Fn(&mut Vec<u8>)| {
            let mut out = vec![];
            write(&mut out);
            out
        };
        let turned = a.reversed_axes();
        let c_order = turned.as_standard_layout();
        assert!(bytes(&|w| write(w, &path, &turned).unwrap()) == bytes(&|w| c_order.write_npy(w).unwrap()));
        let line = array![1.0f32, 2.0];
        assert!(bytes(&|w| write(w, &path, &line).unwrap()) == bytes(&|w| line.write_npy(w).unwrap()));
    }

    #[test]
    fn orders_and_types_are_read() {
        let want = array![[0.0f32, 1.0, 2.0], [3.0, 4.0, 5.0]].into_dyn();
        let c: Vec<u8> = (0..6u16).flat_map(|x| x.to_be_bytes()).collect();
        assert_eq!(read_bytes(&npy_bytes(">u2", false, "(2, 3)", &c), &["r", "c"]).unwrap(), want);
        let f: Vec<u8> = [0.0f64, 3.0, 1.0, 4.0, 2.0, 5.0].iter().flat_map(|x| x.to_le_bytes()).collect();
        assert_eq!(read_bytes(&npy_bytes("<f8", true, "(2L, 3L)", &f), &["r", "c"]).unwrap(), want);
        assert_eq!(
            read_bytes(&npy_bytes("|b1", false, "(3,)", &[0, 1, 1]), &["i"]).unwrap(),
            array![0.0f32, 1.0, 1.0].into_dyn()
        );
    }

    #[test]
    fn hostile_headers_are_refused_in_words() {
        let ok = npy_bytes("<f4", false, "(1, 1, 2)", &[0; 8]);
        assert!(read_bytes(&ok, &["x", "y", "z"]).is_ok());
        refused(&[ok.as_slice(), &[0]].concat(), &["data", "9 bytes"]);
        refused(&[], &["header"]);
        refused(b"not an array at all", &["magic"]);
        refused(&npy_bytes("<f4", false, "(4294967296, 4294967296, 4294967296)", &[]), &["shape", "addressed"]);
        refused(&npy_bytes("<f4", false, "(100000, 100000, 10)", &[0; 8]), &["data", "8 bytes", "400000000000"]);
        refused(&npy_bytes("<f4", false, "(-1, 1, 1)", &[0; 8]), &["header"]);
        refused(&npy_bytes("<f4", false, "(1 2, 1, 1)", &[0; 48]), &["header"]);
        refused(&npy_bytes("<f 4", false, "(1, 1, 1)", &[0; 4]), &["descr"]);
        refused(&npy_bytes("é", false, "(1, 1, 1)", &[0; 8]), &["descr"]);
    }
}
