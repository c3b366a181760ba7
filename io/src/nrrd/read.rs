//! NRRD reader: raw or gzip data, in the same file or in another one of its folder.

use crate::affine::{self, Affine};
use crate::file_order;
use crate::header::{Header, finite};
use crate::input::Input;
use crate::number::{ByteOrder, Number};
use crate::text::{self, shortened, without_mark};
use conefield_core::Result;
use conefield_core::error::ensure;
use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::Volume;
use std::path::Path;

/// Longest header that is read; those of 3D Slicer with long notes have some hundred KiB.
const LONGEST_HEADER: usize = 1 << 20;

/// The entry that names another file with the data.
pub(crate) const DATA_FILE: [&str; 2] = ["data file", "datafile"];

/// Whether `head`, the start of a file, has NRRD's magic bytes, of any version.
pub(crate) fn is_header(head: &[u8]) -> bool {
    without_mark(head).starts_with(b"NRRD000")
}

/// Reads up to and including the empty line before the data, or to the end of a header whose data is elsewhere.
pub(crate) fn read_header(input: &mut Input) -> Result<Header> {
    let mut header = Header::new(input, "one");
    let mut left = LONGEST_HEADER;
    for number in 1.. {
        let line = input.line(left)?;
        left -= line.len();
        if left == 0 {
            let found = format!("no empty line in {LONGEST_HEADER} bytes");
            return Err(header.invalid("header", found, "a shorter header"));
        }
        if line.is_empty() && header.first(&DATA_FILE)?.is_none() {
            let found = format!("the end of the file after {} lines", number - 1);
            return Err(header.invalid("header", found, "an empty line, then the data"));
        }
        let line = String::from_utf8_lossy(line.trim_ascii_end());
        if line.is_empty() {
            break;
        }
        if number == 1 || line.starts_with('#') {
            continue;
        }
        let Some((name, value)) = line.split_once(':') else {
            return Err(header.invalid(&format!("line {number}"), shortened(&line), "field: value"));
        };
        // What follows ":=" is a note.
        if !value.starts_with('=') {
            header.push(name.trim().to_ascii_lowercase(), value.trim().as_bytes());
        }
    }
    Ok(header)
}

/// Voxels along x, y and z.
fn voxels(header: &Header) -> Result<[usize; 3]> {
    let text = header.required("dimension")?;
    let expected = "3: one volume, one number per voxel";
    ensure(text == "3", &header.place, "dimension", shortened(text), expected)?;
    let text = header.required("sizes")?;
    let sizes: Option<Vec<usize>> = text.split_ascii_whitespace().map(|t| t.parse().ok()).collect();
    match sizes.as_deref() {
        Some(&[x, y, z]) if x.min(y).min(z) > 0 => Ok([x, y, z]),
        _ => Err(header.invalid("sizes", shortened(text), "three whole numbers above 0")),
    }
}

/// Refuses axes that are not of space: colours, vectors, lists of images.
fn must_be_spatial(header: &Header) -> Result<()> {
    let Some(text) = header.text("kinds")? else { return Ok(()) };
    match text.split_ascii_whitespace().find(|k| !["domain", "space", "???", "none"].contains(k)) {
        Some(kind) => Err(header.invalid("kinds", shortened(kind), "domain or space along every axis")),
        None => Ok(()),
    }
}

fn number(header: &Header) -> Result<Number> {
    let text = header.required("type")?;
    Ok(match text {
        "signed char" | "int8" | "int8_t" => Number::I8,
        "uchar" | "unsigned char" | "uint8" | "uint8_t" => Number::U8,
        "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => Number::I16,
        "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => Number::U16,
        "int" | "signed int" | "int32" | "int32_t" => Number::I32,
        "uint" | "unsigned int" | "uint32" | "uint32_t" => Number::U32,
        "longlong"
        | "long long"
        | "long long int"
        | "signed long long"
        | "signed long long int"
        | "int64"
        | "int64_t" => Number::I64,
        "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => Number::U64,
        "float" => Number::F32,
        "double" => Number::F64,
        _ => {
            let expected = "an integer of 8 to 64 bits (int8, uint8, ... uint64, or its name in C), float or double";
            return Err(header.invalid("type", shortened(text), expected));
        }
    })
}

/// The byte order; only numbers of one byte may leave it out.
fn order(header: &Header, number: Number) -> Result<ByteOrder> {
    match header.text("endian")? {
        Some("little") => Ok(ByteOrder::Little),
        Some("big") => Ok(ByteOrder::Big),
        None if number.bytes() == 1 => Ok(ByteOrder::Little),
        other => Err(header.invalid("endian", other.map_or("no such entry".into(), shortened), "little or big")),
    }
}

/// Whether the data is compressed by gzip.
fn packed(header: &Header) -> Result<bool> {
    match header.required("encoding")? {
        "raw" => Ok(false),
        "gzip" | "gz" => Ok(true),
        other => Err(header.invalid("encoding", shortened(other), "raw or gzip")),
    }
}

/// Three finite numbers, separated by spaces.
fn three(header: &Header, name: &str) -> Result<Option<[f64; 3]>> {
    let Some(text) = header.text(name)? else { return Ok(None) };
    match finite(text.split_ascii_whitespace()).and_then(|all| all.try_into().ok()) {
        Some(three) => Ok(Some(three)),
        None => Err(header.invalid(name, shortened(text), "three finite numbers")),
    }
}

/// `N` vectors `(x,y,z)`.
fn vectors<const N: usize>(header: &Header, name: &str) -> Result<Option<[[f64; 3]; N]>> {
    let Some(text) = header.text(name)? else { return Ok(None) };
    let one = |t: &str| finite(t.trim().strip_prefix('(')?.split(','))?.try_into().ok();
    let all: Option<Vec<[f64; 3]>> = text.trim_end().strip_suffix(')').and_then(|t| t.split(')').map(one).collect());
    match all.and_then(|v| v.try_into().ok()) {
        Some(vectors) => Ok(Some(vectors)),
        None => {
            let expected = format!("{N} times (x,y,z) of finite numbers");
            Err(header.invalid(name, shortened(text), &expected))
        }
    }
}

/// Millimetres per unit of length, which the entry `name` gives for each axis in quotes.
fn unit(header: &Header, name: &str) -> Result<f64> {
    let Some(text) = header.text(name)? else { return Ok(1.0) };
    let bad = || header.invalid(name, shortened(text), "the same for all axes: \"mm\", \"um\", \"cm\" or \"m\"");
    let mut units = text.split('"').skip(1).step_by(2);
    let first = units.next().ok_or_else(bad)?;
    if units.any(|u| u != first) {
        return Err(bad());
    }
    Ok(match first {
        "" | "mm" | "millimeter" | "millimetre" => 1.0,
        "um" | "µm" | "μm" | "micron" | "microns" => 0.001,
        "cm" => 10.0,
        "m" => 1000.0,
        _ => return Err(bad()),
    })
}

/// Voxel sizes in mm and the affine; sizes of 1 mm and no affine if the file says neither.
fn place_of_voxels(header: &Header) -> Result<([f64; 3], Option<Affine>)> {
    let (name, mm, axes) = if let Some(axes) = vectors(header, "space directions")? {
        ("space directions", unit(header, "space units")?, axes)
    } else if let Some([x, y, z]) = three(header, "spacings")? {
        ("spacings", unit(header, "units")?, [[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]])
    } else {
        return Ok(([1.0; 3], None));
    };
    let first = vectors(header, "space origin")?.map_or([0.0; 3], |[first]| first);
    let stored = affine::from_columns(axes.map(|a| a.map(|x| x * mm)), first.map(|x| x * mm));
    let text = shortened(header.required(name)?);
    ensure(affine::is_regular(&stored), &header.place, name, text, "three independent voxel axes")?;
    // Spaces that are not the patient's count as LPS, as in ITK.
    let [x, y, z, w] = affine::flip(stored);
    let affine = match header.text("space")?.map(str::to_ascii_lowercase).as_deref() {
        None | Some("left-posterior-superior" | "lps" | "scanner-xyz" | "3d-right-handed") => [x, y, z, w],
        Some("right-anterior-superior" | "ras") => stored,
        Some("left-anterior-superior" | "las") => [x, stored[1], z, w],
        Some(other) => {
            let expected = "left-posterior-superior, right-anterior-superior, left-anterior-superior, scanner-xyz \
                            or 3D-right-handed";
            return Err(header.invalid("space", shortened(other), expected));
        }
    };
    Ok((affine::spacing(&affine), Some(affine)))
}

/// What is odd about the axes: shear, and sizes in spacings other than those of the space directions.
fn remarks(header: &Header, spacing: [f64; 3], affine: &Affine) -> Result<Vec<String>> {
    let said = three(header, "spacings")?.map(|s| s.map(|x| x.abs()));
    let differs = said.and_then(|s| affine::contradiction("spacings", s, "space directions", spacing));
    let both = header.text("space directions")?.is_some();
    Ok(affine::skew(affine).into_iter().chain(differs.filter(|_| both)).collect())
}

/// Voxels along x, y and z, from the header.
pub(crate) fn shape(path: &Path) -> Result<[usize; 3]> {
    voxels(&read_header(&mut Input::open_plain(path)?)?)
}

/// Reads a NRRD of three axes of space; the affine is RAS, in mm, and `grid.center` is `[0, 0, 0]`. Without voxel sizes
/// they are 1 mm, and the affine is `None`.
pub(crate) fn read(path: &Path) -> Result<Volume> {
    let mut input = Input::open_plain(path)?;
    let header = read_header(&mut input)?;
    let shape = voxels(&header)?;
    must_be_spatial(&header)?;
    let number = number(&header)?;
    let order = order(&header, number)?;
    let packed = packed(&header)?;
    let (spacing, affine) = place_of_voxels(&header)?;
    if let Some(affine) = &affine {
        text::warn(&header.place, remarks(&header, spacing, affine)?);
    }
    let grid = VoxelGrid { shape, spacing, center: [0.0; 3] };
    grid.validate(&header.place)?;
    let count = grid.len().unwrap_or(0);

    let mut data = open_data(&header, path, input)?;
    skip_lines(&header, &mut data)?;
    if packed {
        data = data.gunzip();
    }
    if let Some(entry) = header.first(&["byte skip", "byteskip"])? {
        let last = count as u64 * number.bytes() as u64;
        header.skip(&mut data, entry, Some(last), "a number of bytes within the file, or -1 if the data is raw")?;
    }
    let values = data.singles("data", count, number, order)?;
    file_order::read(&data.place(), grid, affine, values)
}

/// The file with the voxels: `header_file` itself, just past the header, or another one in its folder.
fn open_data(header: &Header, path: &Path, header_file: Input) -> Result<Input> {
    let Some((field, name)) = header.first(&DATA_FILE)? else { return Ok(header_file) };
    header.data_file(path, field, name, "one file (write the volume into one file first)")
}

/// Skips lines before the data, also before compressed data.
fn skip_lines(header: &Header, data: &mut Input) -> Result<()> {
    let Some((field, text)) = header.first(&["line skip", "lineskip"])? else { return Ok(()) };
    let count: u64 = text.parse().map_err(|_| header.invalid(field, shortened(text), "a number of lines"))?;
    for done in 0..count {
        let line = data.line(LONGEST_HEADER)?;
        if !line.ends_with(b"\n") {
            let found = format!("line {} of {count} ends with the file or not in {LONGEST_HEADER} bytes", done + 1);
            return Err(header.invalid(field, found, "lines before the data"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use crate::read_volume;
    use crate::testing::{gzip, says};
    use std::path::{Path, PathBuf};

    fn write(dir: &Path, name: &str, parts: &[&[u8]]) -> PathBuf {
        let path = dir.join(name);
        std::fs::write(&path, parts.concat()).unwrap();
        path
    }

    const HEAD: &str =
        "NRRD0004\n# a comment\ntype: short\ndimension: 3\nsizes: 2 1 2\nencoding: raw\nendian: big\nnote:=a: b\n";
    const DATA: [u8; 8] = [0, 1, 0xff, 0xfe, 0, 3, 1, 0];

    #[test]
    fn both_encodings_orders_and_places_of_the_data_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let values = |path: &Path| {
            let v = read_volume(path).unwrap();
            assert_eq!((v.grid.spacing, v.affine), ([1.0; 3], None));
            [v.data[[0, 0, 0]], v.data[[1, 0, 0]], v.data[[0, 0, 1]], v.data[[1, 0, 1]]]
        };
        let want = [1.0, -2.0, 3.0, 256.0];
        let d = dir.path();
        assert_eq!(values(&write(d, "a.nrrd", &[HEAD.as_bytes(), b"\n", &DATA])), want);
        let marked = write(d, "m.nrrd", &[b"\xef\xbb\xbf", HEAD.as_bytes(), b"\n", &DATA]);
        assert_eq!(values(&marked), want);
        let dos = HEAD.replace('\n', "\r\n");
        assert_eq!(values(&write(d, "b.nrrd", &[dos.as_bytes(), b"\r\n", &DATA])), want);
        let packed = HEAD.replace("raw", "gz");
        assert_eq!(values(&write(d, "c.nrrd", &[packed.as_bytes(), b"\n", &gzip(&DATA)])), want);
        let little = HEAD.replace("big", "little");
        let swapped: Vec<u8> = DATA.chunks(2).flat_map(|b| [b[1], b[0]]).collect();
        assert_eq!(values(&write(d, "d.nrrd", &[little.as_bytes(), b"\n", &swapped])), want);
        // A header of its own needs no empty line.
        for (name, skip, bytes) in [
            ("e.raw", "", DATA.to_vec()),
            ("f.raw", "line skip: 1\nbyte skip: 2\n", [b"one\nxx", &DATA[..]].concat()),
            ("g.raw", "byteskip: -1\n", [b"any", &DATA[..]].concat()),
        ] {
            write(d, name, &[&bytes]);
            let head = format!("{HEAD}{skip}data file: {name}\n");
            assert_eq!(values(&write(d, "e.nhdr", &[head.as_bytes()])), want, "{name}");
        }
        write(d, "h.gz", &[b"one\n", &gzip(&[b"xx", &DATA[..]].concat())]);
        let head = format!("{packed}line skip: 1\nbyte skip: 2\ndatafile: h.gz\n");
        assert_eq!(values(&write(d, "h.nhdr", &[head.as_bytes()])), want);
    }

    #[test]
    fn spaces_and_units_are_converted() {
        let dir = tempfile::tempdir().unwrap();
        let read = |lines: &str| {
            let path = write(dir.path(), "a.nrrd", &[HEAD.as_bytes(), lines.as_bytes(), b"\n", &DATA]);
            let v = read_volume(path).unwrap();
            (v.grid.spacing, v.affine.unwrap())
        };
        let axes = "space directions: (0,2,0) (3,0,0) (0,0,4)\nspace origin: (5, 6, 7)\n";
        let want = |x: f64, y: f64| [[0.0, 3.0 * x, 0.0, 5.0 * x], [2.0 * y, 0.0, 0.0, 6.0 * y], [0.0, 0.0, 4.0, 7.0]];
        for (space, x, y) in [
            ("left-posterior-superior", -1.0, -1.0),
            ("LPS", -1.0, -1.0),
            ("right-anterior-superior", 1.0, 1.0),
            ("left-anterior-superior", -1.0, 1.0),
        ] {
            let (spacing, affine) = read(&format!("space: {space}\n{axes}"));
            assert_eq!((spacing, &affine[..3]), ([2.0, 3.0, 4.0], &want(x, y)[..]), "{space}");
        }
        let (spacing, _) = read(&format!("space: LPS\nspace units: \"um\" \"um\" \"um\"\n{axes}"));
        assert_eq!(spacing, [0.002, 0.003, 0.004]);
        assert_eq!(read("spacings: 0.5 0.25 2\nunits: \"cm\" \"cm\" \"cm\"\n").0, [5.0, 2.5, 20.0]);
    }

    #[test]
    fn shear_and_sizes_that_contradict_are_said() {
        let dir = tempfile::tempdir().unwrap();
        let said = |lines: &str| {
            let path = write(dir.path(), "a.nrrd", &[HEAD.as_bytes(), lines.as_bytes(), b"\n", &DATA]);
            let header = super::read_header(&mut crate::input::Input::open_plain(&path).unwrap()).unwrap();
            let (spacing, affine) = super::place_of_voxels(&header).unwrap();
            super::remarks(&header, spacing, &affine.unwrap()).unwrap().join("; ")
        };
        assert_eq!(said("space: LPS\nspace directions: (0,2,0) (3,0,0) (0,0,4)\n"), "");
        assert_eq!(said("spacings: 1 2 3\n"), "");
        assert!(said("space: LPS\nspace directions: (1,0,0) (1,1,0) (0,0,1)\n").contains("x and y of the voxels"));
        let both = said("space: LPS\nspace directions: (1,0,0) (0,1,0) (0,0,2)\nspacings: 1 1 3\n");
        assert!(both.contains("spacings says voxels of [1.0, 1.0, 3.0] mm"), "{both}");
    }

    #[test]
    fn what_is_no_volume_is_refused_with_its_field() {
        let dir = tempfile::tempdir().unwrap();
        let d = dir.path();
        let outside = tempfile::NamedTempFile::new().unwrap();
        let refused = |head: &str, data: &[u8], words: &[&str]| {
            let path = write(d, "bad.nrrd", &[head.as_bytes(), data]);
            says(read_volume(path), &[&["bad.nrrd"], words].concat());
        };
        let data = [b"\n", &DATA[..]].concat();
        for (from, to, words) in [
            ("short", "block", &["type", "block"][..]),
            ("raw", "bzip2", &["encoding", "bzip2", "gzip"]),
            ("big", "middle", &["endian", "middle"]),
            ("endian: big\n", "", &["endian", "no such entry"]),
            ("dimension: 3", "dimension: 4", &["dimension", "\"4\""]),
            ("dimension: 3\n", "", &["dimension", "no such entry"]),
            ("2 1 2", "2 1", &["sizes", "2 1"]),
            ("2 1 2", "2 0 2", &["sizes", "2 0 2"]),
            ("2 1 2", "4294967296 4294967296 4294967296", &["shape", "addressed"]),
            ("2 1 2", "20000 20000 20000", &["data", "8 bytes", "16000000000000 bytes"]),
            ("2 1 2", "2 1 1", &["data", "8 bytes", "4 bytes"]),
            ("encoding", "type: float\nencoding", &["type", "two entries"]),
            ("encoding", "no colon here\nencoding", &["line 6", "no colon here"]),
            ("encoding", "kinds: RGB-color domain domain\nencoding", &["kinds", "RGB-color"]),
            ("encoding", "spacings: 1 nan 1\nencoding", &["spacings", "nan"]),
            ("encoding", "spacings: 1 0 1\nencoding", &["spacings", "independent"]),
            ("encoding", "space directions: (1,0,0) none (0,0,1)\nencoding", &["space directions", "none"]),
            ("encoding", "space directions: (1,0,0) (1,0,0) (0,0,1)\nencoding", &["space directions", "independent"]),
            ("encoding", "space: up\nspacings: 1 1 1\nencoding", &["space", "up"]),
            ("encoding", "units: \"kg\" \"kg\" \"kg\"\nspacings: 1 1 1\nencoding", &["units", "kg"]),
            ("encoding", "byte skip: 9\nencoding", &["byte skip", "\"9\""]),
            ("encoding", "line skip: 3\nencoding", &["line skip", "line 1 of 3"]),
            ("encoding", "data file: LIST\nencoding", &["data file", "LIST"]),
            ("encoding", "data file: ../x.raw\nencoding", &["data file", "inside the folder"]),
            ("encoding", "data file: none.raw\nencoding", &["data file", "none.raw"]),
            ("encoding: raw", "encoding: gzip", &["gzip"]),
        ] {
            refused(&HEAD.replace(from, to), &data, words);
        }
        let absolute = format!("{HEAD}data file: {}\n", outside.path().display());
        refused(&absolute, &data, &["data file", "inside the folder"]);
        refused(HEAD, b"", &["header", "end of the file"]);
        refused(&format!("{HEAD}# {}", "x".repeat(1 << 20)), &data, &["header", "shorter"]);
        // Gzip: a claim beyond the capacity of a stream, damage, trailing data.
        let packed = HEAD.replace("raw", "gzip");
        let stream = gzip(&DATA);
        refused(
            &packed.replace("2 1 2", "9000 9000 9000"),
            &[b"\n", &stream[..]].concat(),
            &["data", "gzip", "at most"],
        );
        refused(&packed, &[b"\n", &stream[..stream.len() - 4]].concat(), &["gzip"]);
        refused(&packed, &[b"\n", &gzip(&[&DATA[..], b"x"].concat())[..]].concat(), &["data", "more data"]);
        let nan = [&f32::NAN.to_be_bytes()[..], &[0; 12]].concat();
        refused(&HEAD.replace("short", "float"), &[b"\n", &nan[..]].concat(), &["voxel [0, 0, 0]", "NaN"]);
    }
}
