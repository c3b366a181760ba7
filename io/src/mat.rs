//! MATLAB's `.mat` files: an array of numbers, or a field of a struct. Version 5 (`save` with `-v6` or `-v7`) is read
//! here, version 7.3 is HDF5.
//!
//! A file of version 5 is a header of 128 bytes and elements: a tag with type and length, then the data, padded to 8
//! bytes. A variable is an element of type `miMATRIX`, or `miCOMPRESSED`: a zlib stream with one. In a variable follow
//! flags, dimensions and name; then the numbers, each in the smallest type that holds all of them, or the fields of a
//! struct, which are variables. Arrays are in Fortran order. Complex, sparse and cell arrays are refused.
//!
//! Source: MathWorks, MAT-File Format (Level 5 MAT-File Format).

use crate::hdf5::{self, ScanPart};
use crate::input::{Input, start_of};
use crate::npy::{self, Header};
use crate::number::{ByteOrder, Number};
use conefield_core::error::ensure;
use conefield_core::{Error, Result, files};
use ndarray::ArrayD;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Bytes of a file's header.
const HEADER: usize = 128;
/// Most variables of a file and longest lists of names and dimensions in bytes; measured files are far below.
const MOST_VARIABLES: usize = 1 << 16;
const LONGEST_LIST: u64 = 1 << 20;

/// Types of elements.
const MATRIX: u32 = 14;
const COMPRESSED: u32 = 15;

/// Classes of variables.
const STRUCT: u8 = 2;
const NUMBERS: std::ops::RangeInclusive<u8> = 6..=15;

/// Whether the first 8 bytes are those of a `.mat` file.
pub(crate) fn is_mat(head: &[u8]) -> bool {
    head.starts_with(b"MATLAB 5") || is_hdf5(head)
}

/// Whether they are those of version 7.3, HDF5 behind a header.
fn is_hdf5(head: &[u8]) -> bool {
    head.starts_with(b"MATLAB 7")
}

/// Reads the array `name`: a variable, or with dots a field of a struct. Without a name, the file's only variable.
/// `sets` are the permitted axes, as MATLAB shows them.
pub(crate) fn read(path: &Path, name: Option<&str>, sets: &[&[&str]]) -> Result<ArrayD<f32>> {
    if let Some(data) = data_set(path, name)? {
        // HDF5 counts MATLAB's axes from the last one.
        return Ok(hdf5::read(path, Some(&data), ScanPart::Projections)?.0.reversed_axes());
    }
    let (mut input, header) = open(path, name)?;
    npy::array(&mut input, &header, sets).map(|(array, _)| array)
}

/// Shape and numbers, in C order and full precision, of the small array `name`.
pub(crate) fn read_exact(path: &Path, name: Option<&str>) -> Result<(Vec<usize>, Vec<f64>)> {
    if let Some(data) = data_set(path, name)? {
        let (mut shape, values) = hdf5::read_exact(path, Some(&data))?;
        shape.reverse();
        let [rows, columns] = shape[..] else { return Ok((shape, values)) };
        return Ok((shape, npy::in_c_order(&values, [rows, columns])));
    }
    let (mut input, header) = open(path, name)?;
    npy::exact(&mut input, &header)
}

/// The shape of the array `name`.
pub(crate) fn shape(path: &Path, name: Option<&str>) -> Result<Vec<usize>> {
    if let Some(data) = data_set(path, name)? {
        return Ok(hdf5::shape(path, Some(&data), ScanPart::Projections)?.into_iter().rev().collect());
    }
    open(path, name).map(|(_, header)| header.shape)
}

/// The data set of a version 7.3 file in which `name` is stored; `None` for version 5.
fn data_set(path: &Path, name: Option<&str>) -> Result<Option<String>> {
    if !is_hdf5(&start_of(path, 8)?) {
        return Ok(None);
    }
    let place = path.display().to_string();
    let name = name.ok_or_else(|| Error::invalid(place, "array", "no name", "FILE.mat:NAME, with the array's name"))?;
    Ok(Some(format!("/{}", name.replace('.', "/"))))
}

/// A file of version 5.
struct File<'a> {
    path: &'a Path,
    order: ByteOrder,
}

/// A variable of a file, or a field of a struct.
struct Variable {
    class: u8,
    complex: bool,
    shape: Vec<usize>,
    name: String,
}

/// The tag of an element.
struct Tag {
    kind: u32,
    bytes: u64,
    /// The same with the padding behind the data.
    padded: u64,
}

/// The data of the array `name` as an input that ends with it, and what it holds.
fn open(path: &Path, name: Option<&str>) -> Result<(Input, Header)> {
    let mut whole = Input::open_plain(path)?;
    let head = whole.exactly(HEADER, "header")?;
    let order = match &head[126..] {
        b"IM" => ByteOrder::Little,
        b"MI" => ByteOrder::Big,
        other => return Err(whole.invalid("byte order", format!("{other:02x?}"), "49 4d (IM) or 4d 49 (MI)")),
    };
    let file = File { path, order };
    let all = file.variables(&mut whole)?;
    let known = || format!("one of its variables: {}", all.iter().map(|v| &v.0[..]).collect::<Vec<_>>().join(", "));
    let mut names = name.into_iter().flat_map(|name| name.split('.'));
    let found = match (names.next(), &all[..]) {
        (Some(name), _) => all
            .iter()
            .find(|v| v.0 == name)
            .ok_or_else(|| whole.invalid("array", format!("no variable \"{name}\""), known()))?,
        (None, [only]) => only,
        (None, _) => {
            let found = format!("{} variables and no name", all.len());
            return Err(whole.invalid("array", found, format!("FILE.mat:NAME with {}", known())));
        }
    };
    let (input, variable) = file.variable(&found.1)?;
    file.array(input, variable, &mut names)
}

/// Where a variable is in the file: its element's type, first byte of data, and bytes.
struct Place {
    kind: u32,
    at: u64,
    bytes: u64,
}

impl File<'_> {
    /// The names of all variables, and where they are; `whole` is behind the header.
    fn variables(&self, whole: &mut Input) -> Result<Vec<(String, Place)>> {
        let mut all = vec![];
        let end = HEADER as u64 + whole.left().unwrap_or(0);
        while whole.left().is_some_and(|left| left > 0) {
            let Tag { kind, bytes, padded } = self.tag(whole, "element")?;
            let place = Place { kind, at: end - whole.left().unwrap_or(0), bytes };
            if [MATRIX, COMPRESSED].contains(&kind) && bytes > 0 {
                let expected = format!("at most {MOST_VARIABLES}");
                ensure(all.len() < MOST_VARIABLES, &whole.place(), "variables", "more", expected)?;
                all.push((self.variable(&place)?.1.name, place));
            }
            whole.skip(padded, "element")?;
        }
        Ok(all)
    }

    /// The variable at `place`, and an input behind its name.
    fn variable(&self, place: &Place) -> Result<(Input, Variable)> {
        let mut file = files::open(self.path)?.0;
        file.seek(SeekFrom::Start(place.at)).map_err(|e| Error::io(self.path, e))?;
        let mut input = Input::within(self.path.to_path_buf(), file.take(place.bytes), place.bytes);
        if place.kind == COMPRESSED {
            input = input.inflate();
            let kind = self.tag(&mut input, "element")?.kind;
            ensure(kind == MATRIX, &input.place(), "element", format!("type {kind}"), "type 14, a variable")?;
        }
        let variable = self.head(&mut input)?;
        Ok((input, variable))
    }

    /// Reads a tag: type and length, or both in its first half if up to 4 bytes of data are in the other.
    fn tag(&self, input: &mut Input, field: &str) -> Result<Tag> {
        let kind = self.number(&input.exactly(4, field)?);
        if kind >> 16 > 0 {
            return Ok(Tag { kind: kind & 0xffff, bytes: (kind >> 16).min(4).into(), padded: 4 });
        }
        let bytes = self.number(&input.exactly(4, field)?).into();
        // A stream is not padded.
        Ok(Tag { kind, bytes, padded: if kind == COMPRESSED { bytes } else { bytes.next_multiple_of(8) } })
    }

    /// The 32-bit number in `raw`.
    fn number(&self, raw: &[u8]) -> u32 {
        let digit = |n: u32, b: &u8| n << 8 | u32::from(*b);
        match self.order {
            ByteOrder::Little => raw.iter().rev().fold(0, digit),
            ByteOrder::Big => raw.iter().fold(0, digit),
        }
    }

    /// Reads a short element of `field`, with its padding.
    fn short(&self, input: &mut Input, field: &str) -> Result<Vec<u8>> {
        let Tag { bytes, padded, .. } = self.tag(input, field)?;
        let expected = format!("at most {LONGEST_LIST}");
        ensure(bytes <= LONGEST_LIST, &input.place(), field, format!("{bytes} bytes"), expected)?;
        let data = input.exactly(bytes as usize, field)?;
        input.skip(padded - bytes, field)?;
        Ok(data)
    }

    /// Reads flags, dimensions and name of a variable.
    fn head(&self, input: &mut Input) -> Result<Variable> {
        let flags = self.short(input, "flags")?;
        ensure(flags.len() == 8, &input.place(), "flags", format!("{} bytes", flags.len()), "8 bytes")?;
        let word = self.number(&flags[..4]);
        let shape = self.short(input, "dimensions")?;
        let shape = shape.as_chunks::<4>().0.iter().map(|n| self.number(n) as usize).collect();
        let name = String::from_utf8_lossy(&self.short(input, "name")?).into_owned();
        Ok(Variable { class: word as u8, complex: word & 0x800 != 0, shape, name })
    }

    /// The array in `variable`: itself, or the field of the next of `names`. `input` is behind the variable's name.
    fn array(
        &self,
        mut input: Input,
        variable: Variable,
        names: &mut dyn Iterator<Item = &str>,
    ) -> Result<(Input, Header)> {
        let Variable { class, complex, shape, name } = variable;
        if class == STRUCT {
            let one = shape.iter().all(|n| *n == 1);
            ensure(one, &input.place(), &name, format!("structs of shape {shape:?}"), "one struct")?;
            let variable = self.field(&mut input, &name, names.next())?;
            return self.array(input, variable, names);
        }
        if !NUMBERS.contains(&class) || complex {
            let found = match class {
                1 => "cells",
                3 => "an object",
                4 => "text",
                5 => "a sparse array",
                _ if complex => "complex numbers",
                _ => "another class",
            };
            return Err(input.invalid(name, found, "an array of real numbers"));
        }
        if let Some(more) = names.next() {
            return Err(input.invalid(name, format!("numbers, no field \"{more}\""), "a struct"));
        }
        self.numbers(input, shape, &name)
    }

    /// Goes to the field `wanted` of the struct `name`, behind whose name `input` is.
    fn field(&self, input: &mut Input, name: &str, wanted: Option<&str>) -> Result<Variable> {
        let length = self.short(input, "length of names")?;
        let length = if length.len() == 4 { self.number(&length) as usize } else { 0 };
        let names = self.short(input, "names of fields")?;
        let text = |raw: &[u8]| String::from_utf8_lossy(raw.split(|b| *b == 0).next().unwrap_or_default()).into_owned();
        let names: Vec<String> = if length > 0 { names.chunks(length).map(text).collect() } else { vec![] };
        let Some(at) = names.iter().position(|n| Some(&n[..]) == wanted) else {
            let found = wanted.map_or("a struct".into(), |wanted| format!("no field \"{wanted}\""));
            let expected = format!("one of its fields, as {name}.FIELD: {}", names.join(", "));
            return Err(input.invalid(name, found, expected));
        };
        for name in &names[..at] {
            let Tag { padded, .. } = self.tag(input, name)?;
            input.skip(padded, name)?;
        }
        let Tag { kind, bytes, .. } = self.tag(input, &names[at])?;
        let (fits, found) = (kind == MATRIX && bytes > 0, format!("type {kind} of {bytes} bytes"));
        ensure(fits, &input.place(), &names[at], found, "type 14, a variable that is not empty")?;
        // Fields have no names of their own.
        Ok(Variable { name: format!("{name}.{}", names[at]), ..self.head(input)? })
    }

    /// The data of an array, and what it holds.
    fn numbers(&self, mut input: Input, shape: Vec<usize>, name: &str) -> Result<(Input, Header)> {
        let Tag { kind, bytes, .. } = self.tag(&mut input, name)?;
        let number =
            stored(kind).ok_or_else(|| input.invalid(name, format!("type {kind}"), "a type of numbers, 1 to 13"))?;
        let want = shape.iter().try_fold(number.bytes() as u64, |n, s| n.checked_mul(*s as u64));
        let expected = format!("as many {number} as the shape {shape:?} has");
        ensure(want == Some(bytes), &input.place(), name, format!("{bytes} bytes"), expected)?;
        Ok((input.part(bytes), Header { number, order: self.order, fortran: true, shape }))
    }
}

/// The storage type of numbers.
fn stored(kind: u32) -> Option<Number> {
    Some(match kind {
        1 => Number::I8,
        2 => Number::U8,
        3 => Number::I16,
        4 => Number::U16,
        5 => Number::I32,
        6 => Number::U32,
        7 => Number::F32,
        9 => Number::F64,
        12 => Number::I64,
        13 => Number::U64,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::says;
    use flate2::write::ZlibEncoder;
    use std::io::Write;

    const SETS: &[&[&str]] = &[&["view", "row", "column"], &["view", "column"]];

    fn padded(mut data: Vec<u8>) -> Vec<u8> {
        data.resize(data.len().next_multiple_of(8), 0);
        data
    }

    fn element(kind: u32, data: &[u8]) -> Vec<u8> {
        [&kind.to_le_bytes()[..], &(data.len() as u32).to_le_bytes(), &padded(data.to_vec())].concat()
    }

    fn variable(class: u32, shape: &[u32], name: &str, content: &[u8]) -> Vec<u8> {
        let flags = [class.to_le_bytes(), [0; 4]].concat();
        let shape: Vec<u8> = shape.iter().flat_map(|n| n.to_le_bytes()).collect();
        element(MATRIX, &[&element(6, &flags)[..], &element(5, &shape), &element(1, name.as_bytes()), content].concat())
    }

    /// Views and columns of 16-bit integers: view v, column c is 10·v + c.
    fn sinogram(name: &str) -> Vec<u8> {
        let numbers: Vec<u8> = (0..12u16).flat_map(|i| (10 * (i % 3) + i / 3).to_le_bytes()).collect();
        variable(6, &[3, 4], name, &element(4, &numbers))
    }

    /// A struct with angles, in a short element, and a sinogram; and a struct with that.
    fn scan(name: &str) -> Vec<u8> {
        let short = [&(2u32 | 3 << 16).to_le_bytes()[..], &[0, 30, 60, 0]].concat();
        let angles = variable(6, &[1, 3], "", &short);
        let fields = |names: &[&str]| -> Vec<u8> {
            let names: Vec<u8> = names.iter().flat_map(|n| [n.as_bytes(), &vec![0; 32 - n.len()]].concat()).collect();
            [&(5u32 | 4 << 16).to_le_bytes()[..], &32u32.to_le_bytes(), &element(1, &names)].concat()
        };
        let inner =
            variable(2, &[1, 1], "", &[fields(&["text", "angles"]), variable(4, &[1, 1], "", &[]), angles].concat());
        variable(2, &[1, 1], name, &[fields(&["parameters", "sinogram"]), inner, sinogram("")].concat())
    }

    fn file(elements: &[Vec<u8>]) -> Vec<u8> {
        let mut head = b"MATLAB 5.0 MAT-file".to_vec();
        head.resize(124, b' ');
        [&head[..], &0x0100u16.to_le_bytes(), b"IM", &elements.concat()].concat()
    }

    fn packed(variable: &[u8]) -> Vec<u8> {
        let mut zlib = ZlibEncoder::new(vec![], flate2::Compression::default());
        zlib.write_all(variable).unwrap();
        let data = zlib.finish().unwrap();
        [&COMPRESSED.to_le_bytes()[..], &(data.len() as u32).to_le_bytes(), &data].concat()
    }

    #[test]
    fn variables_and_fields_are_read_packed_or_not() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scan.mat");
        for elements in [vec![sinogram("a"), scan("s")], vec![packed(&scan("s")), packed(&sinogram("a"))]] {
            std::fs::write(&path, file(&elements)).unwrap();
            for name in ["a", "s.sinogram"] {
                let found = read(&path, Some(name), SETS).unwrap();
                assert_eq!(found.shape(), [3, 4]);
                assert!(found.indexed_iter().all(|(at, x)| *x == (10 * at[0] + at[1]) as f32), "{found}");
                assert_eq!(shape(&path, Some(name)).unwrap(), [3, 4]);
            }
            let angles = read_exact(&path, Some("s.parameters.angles")).unwrap();
            assert_eq!(angles, (vec![1, 3], vec![0.0, 30.0, 60.0]));
            says(read(&path, Some("a.b"), SETS), &["scan.mat: a", "no field \"b\"", "a struct"]);
        }
        std::fs::write(&path, file(&[sinogram("a")])).unwrap();
        assert_eq!(read(&path, None, SETS).unwrap()[[2, 3]], 23.0);
    }

    #[test]
    fn damage_is_an_error_and_sizes_are_not_believed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scan.mat");
        for whole in [file(&[scan("s")]), file(&[packed(&scan("s"))])] {
            for cut in 0..whole.len() {
                std::fs::write(&path, &whole[..cut]).unwrap();
                assert!(read(&path, Some("s.sinogram"), SETS).is_err(), "cut at {cut}");
            }
            // A changed byte is an error or changes numbers; nothing panics.
            for at in 0..whole.len() {
                for flip in [0x01, 0x40, 0xff] {
                    let mut bytes = whole.clone();
                    bytes[at] ^= flip;
                    std::fs::write(&path, &bytes).unwrap();
                    let _ = read(&path, Some("s.sinogram"), SETS);
                    let _ = read_exact(&path, Some("s.parameters.angles"));
                }
            }
        }
        let huge = variable(6, &[1 << 30, 1 << 30, 1 << 30], "a", &element(4, &[0; 8]));
        for (element, words) in [
            (variable(6, &[3, 1 << 20], "a", &element(4, &[0; 8])), ["8 bytes", "as many 16-bit"]),
            (huge, ["8 bytes", "as many 16-bit"]),
            (variable(0x806, &[1, 1], "a", &element(9, &[0; 8])), ["complex numbers", "real numbers"]),
            (variable(1, &[1, 1], "a", &[]), ["cells", "real numbers"]),
            (variable(2, &[1, 2], "a", &[]), ["structs of shape [1, 2]", "one struct"]),
            (variable(6, &[1, 1], "a", &element(16, &[0; 8])), ["type 16", "a type of numbers"]),
        ] {
            for element in [packed(&element), element] {
                std::fs::write(&path, file(&[element])).unwrap();
                says(read(&path, Some("a"), SETS), &["scan.mat", words[0], words[1]]);
            }
        }
    }

    #[test]
    fn version_7_3_needs_a_name() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scan.mat");
        std::fs::write(&path, b"MATLAB 7.3 MAT-file").unwrap();
        says(read(&path, None, SETS), &["scan.mat: array", "no name", "FILE.mat:NAME"]);
        says(read(&path, Some("a"), SETS), &["scan.mat: HDF5"]);
    }
}
