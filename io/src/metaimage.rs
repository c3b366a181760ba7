//! MetaImage, ITK's own format: lines of `Name = value`, then the voxels in the same file (`.mha`) or in a second one
//! next to it (`.mhd` with `.raw` or `.zraw`).

use crate::affine::{self, Affine};
use crate::file_order::{self, FileOrder, PACKED_BYTES};
use crate::folder::{file_name, folder_of};
use crate::header::{Header, finite};
use crate::input::Input;
use crate::number::{ByteOrder, Number};
use crate::packing::Packing;
use crate::text::{self, shortened, without_mark};
use crate::{write_atomic, write_text_atomic};
use conefield_core::error::ensure;
use conefield_core::geometry::{VoxelGrid, norm};
use conefield_core::parts::Voxels;
use conefield_core::scan::Volume;
use conefield_core::{Error, Result};
use std::io::{Seek, Write};
use std::path::Path;

/// Longest header that is read; real ones, without comments, are below 1 KiB.
const LONGEST_HEADER: usize = 1 << 16;

/// The last entry of a header.
pub(crate) const DATA_FILE: &str = "ElementDataFile";

/// Whether `head`, the start of a file, contains the line with the object type or the number of axes, preceded only by
/// other lines of this form.
pub(crate) fn is_header(head: &[u8]) -> bool {
    without_mark(head)
        .split(|b| *b == b'\n')
        .filter(|line| !line.trim_ascii().is_empty())
        .map_while(entry)
        .any(|(name, _)| name == "NDims" || name == "ObjectType")
}

/// Name and value of a line.
fn entry(line: &[u8]) -> Option<(&str, &[u8])> {
    let at = line.iter().position(|b| matches!(b, b'=' | b':'))?;
    let name = std::str::from_utf8(line[..at].trim_ascii()).ok()?;
    let good = !name.is_empty() && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_');
    good.then_some((name, line[at + 1..].trim_ascii()))
}

/// Reads up to and including the line that names the data file.
pub(crate) fn read_header(input: &mut Input) -> Result<Header> {
    let mut header = Header::new(input, "one, before ElementDataFile");
    let mut left = LONGEST_HEADER;
    for number in 1.. {
        let line = input.line(left)?;
        left -= line.len();
        if left == 0 {
            let found = format!("no such line in {LONGEST_HEADER} bytes");
            return Err(header.invalid(DATA_FILE, found, "a shorter header"));
        }
        if line.is_empty() {
            let found = format!("the end of the file after {} lines", number - 1);
            return Err(header.invalid(DATA_FILE, found, "a line that says where the data is"));
        }
        let line = if number == 1 { without_mark(&line) } else { &line };
        if line.trim_ascii().is_empty() {
            continue;
        }
        let Some((name, value)) = entry(line) else {
            let start = String::from_utf8_lossy(&line[..line.len().min(40)]).into_owned();
            return Err(header.invalid(&format!("line {number}"), format!("{start:?}"), "Name = value"));
        };
        header.push(name, value);
        if name == DATA_FILE {
            break;
        }
    }
    Ok(header)
}

fn flag(header: &Header, name: &str) -> Result<Option<bool>> {
    let Some(text) = header.text(name)? else { return Ok(None) };
    match text.to_ascii_lowercase().as_str() {
        "true" | "1" => Ok(Some(true)),
        "false" | "0" => Ok(Some(false)),
        _ => Err(header.invalid(name, text, "True or False")),
    }
}

/// `count` numbers of the entry under the first of `names` that exists.
fn numbers<'a>(header: &Header, names: &[&'a str], count: usize) -> Result<Option<(&'a str, Vec<f64>)>> {
    let Some((name, text)) = header.first(names)? else { return Ok(None) };
    match finite(text.split_ascii_whitespace()) {
        Some(n) if n.len() == count => Ok(Some((name, n))),
        _ => Err(header.invalid(name, shortened(text), &format!("{count} finite numbers"))),
    }
}

/// Voxels along x, y and z, and the number of axes; a fourth axis must have length 1.
fn voxels(header: &Header) -> Result<([usize; 3], usize)> {
    let text = header.required("NDims")?;
    let axes = match text.parse() {
        Ok(n @ 3..=4usize) => n,
        _ => return Err(header.invalid("NDims", text, "3, or 4 with one entry along the last axis")),
    };
    let text = header.required("DimSize")?;
    let sizes: Option<Vec<usize>> = text.split_ascii_whitespace().map(|t| t.parse().ok()).collect();
    let bad = |expected: String| header.invalid("DimSize", shortened(text), &expected);
    match sizes.as_deref() {
        Some(s) if s.len() != axes => Err(bad(format!("{axes} numbers, as NDims says"))),
        Some([x, y, z, rest @ ..]) if x.min(y).min(z) > &0 => {
            if rest.iter().any(|n| *n != 1) {
                return Err(bad("1 along the fourth axis: one volume, not a series".into()));
            }
            let fits = x.checked_mul(*y).and_then(|n| n.checked_mul(*z)).and_then(|n| n.checked_mul(8));
            fits.filter(|n| *n <= isize::MAX as usize)
                .map(|_| ([*x, *y, *z], axes))
                .ok_or_else(|| bad("a number of voxels that can be addressed".into()))
        }
        _ => Err(bad(format!("{axes} whole numbers above 0"))),
    }
}

fn number(header: &Header) -> Result<Number> {
    let text = header.required("ElementType")?;
    // LONG has four bytes in this format, whatever its size in C.
    Ok(match text {
        "MET_CHAR" => Number::I8,
        "MET_UCHAR" => Number::U8,
        "MET_SHORT" => Number::I16,
        "MET_USHORT" => Number::U16,
        "MET_INT" | "MET_LONG" => Number::I32,
        "MET_UINT" | "MET_ULONG" => Number::U32,
        "MET_LONG_LONG" => Number::I64,
        "MET_ULONG_LONG" => Number::U64,
        "MET_FLOAT" => Number::F32,
        "MET_DOUBLE" => Number::F64,
        _ => {
            let expected = "MET_ and (U)CHAR, (U)SHORT, (U)INT, (U)LONG, (U)LONG_LONG, FLOAT or DOUBLE";
            return Err(header.invalid("ElementType", shortened(text), expected));
        }
    })
}

fn order(header: &Header) -> Result<ByteOrder> {
    let names = ["BinaryDataByteOrderMSB", "ElementByteOrderMSB"];
    let big = match (flag(header, names[0])?, flag(header, names[1])?) {
        (Some(a), Some(b)) if a != b => {
            return Err(header.invalid(names[1], b, &format!("{a}, as {} says", names[0])));
        }
        (a, b) => a.or(b).unwrap_or(false),
    };
    Ok(if big { ByteOrder::Big } else { ByteOrder::Little })
}

/// Millimetres per unit of length.
fn unit(header: &Header) -> Result<f64> {
    match header.text("DistanceUnits")? {
        None | Some("mm" | "?" | "") => Ok(1.0),
        Some("um") => Ok(0.001),
        Some("cm") => Ok(10.0),
        Some(other) => Err(header.invalid("DistanceUnits", shortened(other), "um, mm, cm or ?")),
    }
}

/// Voxel sizes in mm and the affine.
fn place_of_voxels(header: &Header, axes: usize) -> Result<([f64; 3], Affine)> {
    let mm = unit(header)?;
    let spacing = match numbers(header, &["ElementSpacing", "ElementSize"], axes)? {
        Some((name, s)) if s[..3].iter().any(|x| *x <= 0.0) => {
            return Err(header.invalid(name, format!("{s:?}"), "numbers above 0"));
        }
        Some((_, s)) => [s[0] * mm, s[1] * mm, s[2] * mm],
        None => [mm; 3],
    };
    let first = numbers(header, &["Offset", "Position", "Origin"], axes)?;
    let first = first.map_or([0.0; 3], |(_, p)| [p[0] * mm, p[1] * mm, p[2] * mm]);
    let turn = numbers(header, &["TransformMatrix", "Orientation", "Rotation"], axes * axes)?;
    let (name, turn) = turn.unwrap_or_else(|| {
        ("TransformMatrix", (0..axes * axes).map(|i| f64::from(u8::from(i % (axes + 1) == 0))).collect())
    });
    let entry = |k: usize, i: usize| turn[k * axes + i];
    let apart = axes == 3 || (0..3).all(|k| entry(k, 3) == 0.0 && entry(3, k) == 0.0);
    ensure(apart, &header.place, name, format!("{turn:?}"), "a fourth axis apart from the others")?;
    // The file stores one axis after the other: its rows are the affine's columns.
    let steps: [[f64; 3]; 3] = std::array::from_fn(|k| std::array::from_fn(|i| entry(k, i) * spacing[k]));
    let lps = affine::from_columns(steps, first);
    ensure(affine::is_regular(&lps), &header.place, name, format!("{turn:?}"), "three independent voxel axes")?;
    // ITK multiplies both: an axis that is not a unit vector scales the voxels.
    let scaled = std::array::from_fn(|k| {
        let length = norm(std::array::from_fn(|i| entry(k, i)));
        if (length - 1.0).abs() <= 1e-3 { spacing[k] } else { spacing[k] * length }
    });
    let differs = affine::contradiction("ElementSpacing", spacing, &format!("with the axes of {name}"), scaled);
    text::warn(&header.place, affine::skew(&lps).into_iter().chain(differs));
    Ok((scaled, affine::flip(lps)))
}

/// Voxels along x, y and z, from the header.
pub(crate) fn shape(path: &Path) -> Result<[usize; 3]> {
    voxels(&read_header(&mut Input::open_plain(path)?)?).map(|(shape, _)| shape)
}

/// Reads a MetaImage with one number per voxel; the affine is RAS, in mm, and `grid.center` is `[0, 0, 0]`.
pub(crate) fn read(path: &Path) -> Result<Volume> {
    let mut input = Input::open_plain(path)?;
    let header = read_header(&mut input)?;
    if let Some(kind) = header.text("ObjectType")?.filter(|k| *k != "Image") {
        return Err(header.invalid("ObjectType", shortened(kind), "Image"));
    }
    let (shape, axes) = voxels(&header)?;
    let number = number(&header)?;
    let order = order(&header)?;
    if let Some(n) = header.text("ElementNumberOfChannels")?.filter(|n| *n != "1") {
        return Err(header.invalid("ElementNumberOfChannels", shortened(n), "1: one number per voxel"));
    }
    if flag(&header, "BinaryData")? == Some(false) {
        return Err(header.invalid("BinaryData", "False (numbers as text)", "True"));
    }
    let compressed = flag(&header, "CompressedData")?.unwrap_or(false);
    let (spacing, affine) = place_of_voxels(&header, axes)?;
    let grid = VoxelGrid { shape, spacing, center: [0.0; 3] };
    grid.validate(&header.place)?;
    let count = grid.len().unwrap_or(0);

    let mut data = open_data(&header, path, input)?;
    if let Some(text) = header.text("HeaderSize")? {
        let last = (!compressed).then_some(count as u64 * number.bytes() as u64);
        let left = data.left().unwrap_or(0);
        let expected = format!("a number of bytes up to {left}, or -1 if the data is not compressed");
        header.skip(&mut data, ("HeaderSize", text), last, &expected)?;
    }
    if compressed {
        let left = data.left().unwrap_or(0);
        let said = header.text("CompressedDataSize")?;
        // Without a size, or with size 0, the stream extends to the end of the file.
        if let Some(said) = said.filter(|s| *s != "0" && s.parse() != Ok(left)) {
            let expected = format!("{left}, the bytes that {} has for them", data.place());
            return Err(header.invalid("CompressedDataSize", shortened(said), &expected));
        }
        data = data.inflate();
    }
    let values = data.singles("data", count, number, order)?;
    file_order::read(&data.place(), grid, Some(affine), values)
}

/// The file with the voxels: `header_file` itself, just past the header, or another one in its folder.
fn open_data(header: &Header, path: &Path, header_file: Input) -> Result<Input> {
    let name = header.required(DATA_FILE)?;
    if name.eq_ignore_ascii_case("local") {
        return Ok(header_file);
    }
    header.data_file(path, DATA_FILE, name, "LOCAL or one file (write the volume into one file first)")
}

/// Writes `voxels` as `f32`, compressed, in one file.
pub(crate) fn write(w: &mut dyn Write, path: &Path, voxels: &mut dyn Voxels) -> Result<()> {
    let io = |e| Error::io(path, e);
    // The compressed size precedes the data, so the data is compressed to a buffer first: in memory while it is small.
    let mut packed = tempfile::spooled_tempfile_in(PACKED_BYTES as usize, folder_of(path));
    let mut encoder = Packing::zlib(&mut packed).map_err(io)?;
    file_order::write(&mut encoder, path, voxels, FileOrder::XFastest)?;
    encoder.finish().map_err(io)?;
    let size = packed.stream_position().map_err(io)?;
    packed.rewind().map_err(io)?;
    let packing = format!("CompressedData = True\nCompressedDataSize = {size}");
    let text = lines(path, voxels, &packing, "LOCAL");
    w.write_all(text.as_bytes()).map_err(io)?;
    std::io::copy(&mut packed, w).map_err(io)?;
    Ok(())
}

/// Writes the header `path` and, next to it, the uncompressed voxels: 32-bit floats, little-endian, x fastest, in a
/// file of the same name with the extension `.raw`. An existing `.raw` without its header belongs to something else and
/// is not overwritten.
pub(crate) fn write_raw(path: &Path, voxels: &mut dyn Voxels) -> Result<()> {
    let raw = path.with_extension("raw");
    let name = file_name(&raw);
    let found = format!("{name} without its header");
    let expected = "a name of which nothing is there";
    ensure(!raw.exists() || path.exists(), &path.display().to_string(), "output", found, expected)?;
    write_atomic(&raw, &mut |w| file_order::write(w, &raw, voxels, FileOrder::XFastest))?;
    let text = lines(path, voxels, "CompressedData = False", &name);
    write_text_atomic(path, &text)
}

/// The header's lines.
fn lines(path: &Path, voxels: &dyn Voxels, packing: &str, data: &str) -> String {
    let grid = voxels.grid();
    let (ras, _) = affine::of(voxels, &path.display().to_string());
    // The grid's spacing and the lengths of the affine's columns may differ in the last bits: write the former.
    let lengths = affine::spacing(&ras);
    let spacing: [f64; 3] = std::array::from_fn(|k| {
        let s = grid.spacing[k];
        if (lengths[k] - s).abs() <= 1e-12 * s { s } else { lengths[k] }
    });
    let lps = affine::flip(ras);
    let turn = (0..3).flat_map(|k| affine::column(&lps, k).map(|x| x / spacing[k]));
    let [nx, ny, nz] = grid.shape;
    let comment = voxels.hounsfield().map_or(String::new(), |hu| format!("Comment = {hu}\n"));
    format!(
        "ObjectType = Image\nNDims = 3\n{comment}BinaryData = True\nBinaryDataByteOrderMSB = False\n{packing}\n\
         TransformMatrix = {}\nOffset = {}\nCenterOfRotation = 0 0 0\n\
         ElementSpacing = {}\nDimSize = {nx} {ny} {nz}\nElementType = MET_FLOAT\nElementDataFile = {data}\n",
        list(turn),
        list(affine::column(&lps, 3)),
        list(spacing),
    )
}

/// Formats numbers so that they are read back to the same bits.
fn list(numbers: impl IntoIterator<Item = f64>) -> String {
    numbers.into_iter().map(|x| format!("{x:?}")).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{file, gzip, says, zlib};
    use crate::{is_volume, read_volume, write_volume};
    use ndarray::Array3;
    use std::io::Read;

    fn refused(parts: &[&[u8]], words: &[&str]) {
        says(read_volume(&file("bad.mha", parts).1), &[&["bad.mha"], words].concat());
    }

    /// 2×3×1 voxels of one byte, 0 to 5, with further lines.
    fn small(lines: &str) -> Vec<u8> {
        let head = "ObjectType = Image\nNDims = 3\nDimSize = 2 3 1\nElementType = MET_UCHAR\n";
        [format!("{head}{lines}ElementDataFile = LOCAL\n").as_bytes(), &[0, 1, 2, 3, 4, 5]].concat()
    }

    fn read_bytes(bytes: &[u8]) -> Volume {
        let f = file("a.mha", &[bytes]);
        assert!(is_volume(&f.1));
        read_volume(&f.1).unwrap()
    }

    #[test]
    fn a_header_by_hand_is_read() {
        let lines = "ElementSpacing = 0.5 2 3e0\nOffset = 10 -20 30\nTransformMatrix = 0 1 0 -1 0 0 0 0 1\n\
                     CenterOfRotation = 0 0 0\nAnatomicalOrientation = RAI\nComment = a = b: c\n";
        let v = read_bytes(&small(lines));
        assert_eq!((v.grid.shape, v.grid.spacing, v.grid.center), ([2, 3, 1], [0.5, 2.0, 3.0], [0.0; 3]));
        // x fastest.
        assert_eq!([v.data[[1, 0, 0]], v.data[[0, 1, 0]], v.data[[1, 2, 0]]], [1.0, 2.0, 5.0]);
        assert!(v.data.is_standard_layout());
        // The first axis runs along LPS (0, 1, 0), so along RAS (0, −1, 0); the second along −(−1, 0, 0).
        let want = [[0.0, 2.0, 0.0, -10.0], [-0.5, 0.0, 0.0, 20.0], [0.0, 0.0, 3.0, 30.0], [0.0, 0.0, 0.0, 1.0]];
        assert_eq!(v.affine, Some(want));
        // Alternative names, line endings, separators and a fourth axis.
        let other = "ObjectType: Image\r\nNDims = 4\r\n\r\nDimSize = 2 3 1 1\r\nElementType = MET_UCHAR\r\n\
                     ElementSize = 0.5 2 3 1\r\nPosition = 10 -20 30 7\r\n\
                     Rotation = 0 1 0 0 -1 0 0 0 0 0 1 0 0 0 0 1\r\nElementDataFile = Local\r\n";
        let u = read_bytes(&[other.as_bytes(), &[0, 1, 2, 3, 4, 5]].concat());
        assert_eq!((u.affine, u.grid, u.data), (v.affine, v.grid, v.data));
        // Defaults: 1 mm along LPS. Units are converted.
        let v = read_bytes(&small(""));
        assert_eq!(v.affine.unwrap()[0], [-1.0, 0.0, 0.0, 0.0]);
        assert_eq!(read_bytes(&small("DistanceUnits = cm\nElementSpacing = 1 2 3\n")).grid.spacing, [10.0, 20.0, 30.0]);
        let marked = [b"\xef\xbb\xbf".as_slice(), &small("")].concat();
        assert_eq!(read_bytes(&marked).grid.shape, [2, 3, 1]);
        // A comment may be in any encoding.
        let latin = [b"Comment = caf\xe9\n".as_slice(), &small("")].concat();
        assert_eq!(read_bytes(&latin).grid.shape, [2, 3, 1]);
    }

    #[test]
    fn a_file_beside_the_header_is_read_but_none_elsewhere() {
        let dir = tempfile::tempdir().unwrap();
        let inner = dir.path().join("in");
        std::fs::create_dir(&inner).unwrap();
        let head = |lines: &str, name: &str| {
            let start = "NDims = 3\nDimSize = 2 3 1\nElementType = MET_UCHAR\n";
            std::fs::write(inner.join("a.mhd"), format!("{start}{lines}ElementDataFile = {name}\n")).unwrap();
            read_volume(inner.join("a.mhd"))
        };
        let voxels = [0x1f, 0x8b, 2, 3, 4, 5];
        // These bytes happen to be gzip's magic number: raw files are not checked for compression.
        std::fs::write(inner.join("a.raw"), voxels).unwrap();
        std::fs::write(inner.join("b.zraw"), zlib(&voxels)).unwrap();
        std::fs::write(inner.join("c.raw"), [&[9; 7], voxels.as_slice()].concat()).unwrap();
        std::fs::write(dir.path().join("out.raw"), voxels).unwrap();
        let want = voxels.map(f32::from);
        let size = zlib(&voxels).len();
        for (lines, name) in [
            ("".to_owned(), "a.raw"),
            ("CompressedData = True\n".into(), "b.zraw"),
            (format!("CompressedData = True\nCompressedDataSize = {size}\n"), "b.zraw"),
            ("HeaderSize = 7\n".into(), "c.raw"),
            ("HeaderSize = -1\n".into(), "./c.raw"),
        ] {
            let v = head(&lines, name).unwrap();
            let found: Vec<f32> = v.data.t().iter().copied().collect();
            assert_eq!(found, want, "{lines}{name}");
        }
        for (name, word) in [
            ("sub/../../out.raw", "inside the folder"),
            ("none.raw", "none.raw"),
            ("slice%03d.raw 1 2 1", "LOCAL or one file"),
            ("", "inside the folder"),
        ] {
            says(head("", name), &["a.mhd", DATA_FILE, word]);
        }
    }

    #[test]
    fn hostile_files_are_refused_in_words() {
        refused(&[], &["MetaImage", "0 bytes"]);
        let whole = small("");
        refused(&[&whole[..whole.len() - 1]], &["data", "5 bytes", "6 bytes"]);
        refused(&[&whole, &[0]], &["data", "7 bytes", "6 bytes"]);
        refused(&[&whole[..40]], &[DATA_FILE, "end of the file after 3 lines"]);
        let with = |from: &str, to: &str| String::from_utf8(small("")).unwrap().replace(from, to).into_bytes();
        for (n, bad) in [("NDims", "2"), ("NDims", "0"), ("NDims", "5"), ("NDims", "-3"), ("NDims", "x")] {
            refused(&[&with("NDims = 3", &format!("NDims = {bad}"))], &[n, bad, "3, or 4"]);
        }
        refused(&[&with("NDims = 3", "NDims = 4")], &["DimSize", "2 3 1", "4 numbers"]);
        refused(&[&with("2 3 1", "99999999999999999999 1 1")], &["DimSize", "whole numbers"]);
        refused(&[&with("2 3 1", "100000 100000 10000")], &["data", "6 bytes", "100000000000000 bytes"]);
        let four = "NDims = 4\nDimSize = 1 1 1 9\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n";
        refused(&[four.as_bytes(), &[0; 9]], &["DimSize", "series"]);
        for bad in ["MET_STRING", "MET_OTHER", "MET_FLOAT_MATRIX", "float"] {
            refused(&[&with("MET_UCHAR", bad)], &["ElementType", bad]);
        }
        refused(&[&small("ElementNumberOfChannels = 3\n")], &["ElementNumberOfChannels", "\"3\""]);
        refused(&[&small("BinaryData = False\n")], &["BinaryData", "text"]);
        refused(&[&small("CompressedData = maybe\n")], &["CompressedData", "maybe"]);
        refused(&[&small("ElementByteOrderMSB = True\nBinaryDataByteOrderMSB = False\n")], &["ElementByteOrderMSB"]);
        refused(&[&small("ElementSpacing = 1 0 1\n")], &["ElementSpacing", "above 0"]);
        refused(&[&small("Offset = 1 2\n")], &["Offset", "3 finite numbers"]);
        refused(&[&small("DistanceUnits = ell\n")], &["DistanceUnits", "ell"]);
        refused(&[&with("ObjectType = Image", "ObjectType = Tube")], &["ObjectType", "Tube"]);
        refused(&[&small("no value here\n")], &["line 5", "Name = value"]);
        // Invalid UTF-8 in a name and in an entry in use.
        refused(&[b"NDims = 3\nCaf\xe9 = 1\n", &small("")], &["line 2", "Name = value"]);
        refused(&[b"NDims = 3\nDimSize = \xff\xfe 1 1\nElementDataFile = LOCAL\n"], &["DimSize", "UTF-8"]);
        let nan = "NDims = 3\nDimSize = 1 1 2\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n";
        refused(&[nan.as_bytes(), &[0; 4], &f32::NAN.to_le_bytes()], &["voxel [0, 0, 1]", "NaN"]);
        says(read_volume(&file("a.mha.gz", &[&gzip(&whole)]).1), &["MetaImage inside gzip"]);
    }

    #[test]
    fn hostile_streams_are_refused_in_words() {
        let head = |size: &str, dims: &str| {
            format!(
                "NDims = 3\nDimSize = {dims}\nElementType = MET_UCHAR\nCompressedData = True\n\
                 CompressedDataSize = {size}\nElementDataFile = LOCAL\n"
            )
            .into_bytes()
        };
        let six = zlib(&[7; 6]);
        let n = six.len();
        assert_eq!(read_bytes(&[head(&n.to_string(), "2 3 1"), six.clone()].concat()).data.sum(), 42.0);
        // The size is too small, too large or invalid.
        for bad in [(n - 1).to_string(), (n + 1).to_string(), "-1".into(), u64::MAX.to_string(), "x".into()] {
            refused(&[&head(&bad, "2 3 1"), &six], &["CompressedDataSize", &bad, &format!("expected {n}")]);
        }
        // A decompression bomb is not decompressed further than the header claims.
        let bomb = zlib(&vec![0; 64 << 20]);
        refused(&[&head("0", "2 3 1"), &bomb], &["data", "more data", "6 bytes"]);
        // Damaged data, a missing end, trailing data, another kind of stream.
        let mut bad = six.clone();
        bad[n - 1] ^= 1;
        refused(&[&head("0", "2 3 1"), &bad], &["zlib stream"]);
        refused(&[&head("0", "2 3 1"), &six[..n - 6]], &["zlib stream", "incomplete"]);
        refused(&[&head("0", "2 3 1"), &six, &[0]], &["zlib stream", "after the end"]);
        refused(&[&head("0", "2 3 1"), &[0x1f, 0x8b, 8, 0]], &["zlib stream"]);
        refused(&[&head("0", "2 3 1")], &["data"]);
    }

    #[test]
    fn nifti_and_back_keeps_spacing_orientation_and_values_to_the_bit() {
        let dir = tempfile::tempdir().unwrap();
        let (s, c) = 0.3f64.sin_cos();
        let round = |x: f64| f64::from(x as f32);
        // Rotated about two axes, with NIfTI's precision.
        let turned = [
            [round(0.7 * c), round(-1.3 * s), 0.0, round(-12.34)],
            [round(0.7 * s), round(1.3 * c * c), round(-2.1 * s), round(56.78)],
            [0.0, round(1.3 * c * s), round(2.1 * c), round(0.1)],
            [0.0, 0.0, 0.0, 1.0],
        ];
        let straight = [[-0.75, 0.0, 0.0, 5.5], [0.0, 0.0, 2.0, -6.0], [0.0, 0.125, 0.0, 7.25], [0.0, 0.0, 0.0, 1.0]];
        let data = Array3::from_shape_fn((4, 3, 2), |(x, y, z)| ((x + 7 * y) as f32).sin() * 1e-3 + z as f32);
        for (name, affine) in [("turned", turned), ("straight", straight)] {
            let spacing = affine::spacing(&affine);
            let grid = VoxelGrid { shape: [4, 3, 2], spacing, center: [0.0; 3] };
            let v = Volume { data: data.clone(), grid, affine: Some(affine) };
            let at = |end: &str| dir.path().join(format!("{name}{end}"));
            write_volume(at(".nii"), &v).unwrap();
            let first = read_volume(at(".nii")).unwrap();
            write_volume(at(".mha"), &first).unwrap();
            let second = read_volume(at(".mha")).unwrap();
            write_volume(at("2.nii"), &second).unwrap();
            write_volume(at("2.mha"), &read_volume(at("2.nii")).unwrap()).unwrap();
            assert_eq!((second.grid, &second.data), (first.grid, &first.data), "{name}");
            let bytes = |end: &str| std::fs::read(at(end)).unwrap();
            assert!(bytes(".nii") == bytes("2.nii"), "{name}: the NIfTI files differ");
            assert!(bytes(".mha") == bytes("2.mha"), "{name}: the MetaImage files differ");
            if name == "straight" {
                assert_eq!(second.affine, first.affine);
            }
        }
        // Without an affine both place the grid's centre at the same point.
        let mut v = Volume::centered(data, [0.5, 0.75, 2.0]);
        v.grid.center = [1.0, 2.0, 3.0];
        for end in ["c.mha", "c.nii"] {
            write_volume(dir.path().join(end), &v).unwrap();
            let a = read_volume(dir.path().join(end)).unwrap().affine.unwrap();
            assert_eq!(a, [[0.5, 0.0, 0.0, 0.25], [0.0, 0.75, 0.0, 1.25], [0.0, 0.0, 2.0, 2.0], [0.0, 0.0, 0.0, 1.0]]);
        }
    }

    #[test]
    fn the_written_header_is_this_one() {
        let f = file("a.mha", &[]);
        write_volume(&f.1, &Volume::centered(Array3::zeros((2, 1, 1)), [0.1, 2.0, 3.0])).unwrap();
        let bytes = std::fs::read(&f.1).unwrap();
        let packed = 17;
        let text = format!(
            "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n\
             CompressedData = True\nCompressedDataSize = {packed}\nTransformMatrix = -1.0 0.0 0.0 0.0 -1.0 0.0 0.0 0.0 1.0\n\
             Offset = 0.05 0.0 0.0\nCenterOfRotation = 0 0 0\nElementSpacing = 0.1 2.0 3.0\nDimSize = 2 1 1\n\
             ElementType = MET_FLOAT\nElementDataFile = LOCAL\n"
        );
        assert_eq!(String::from_utf8_lossy(&bytes[..text.len()]), text);
        let stream = &bytes[text.len()..];
        assert_eq!(stream.len(), packed);
        let mut voxels = vec![];
        flate2::read::ZlibDecoder::new(stream).read_to_end(&mut voxels).unwrap();
        assert_eq!(voxels, [0; 8]);
        assert!(f.0.path().read_dir().unwrap().count() == 1, "something is left beside the file");
    }
}
