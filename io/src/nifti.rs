//! NIfTI-1 in one file (`.nii`, `.nii.gz`).
//!
//! The `nifti` crate parses the header. This module decodes the data, to bound what a header can make the program
//! allocate, and writes the header, to write through [`crate::write_atomic`].

use crate::affine::{self, Affine};
use crate::file_order::{self, FileOrder};
use crate::input::Input;
use crate::number::{ByteOrder, Number};
use crate::packing::Packing;
use crate::text;
use conefield_core::error::ensure;
use conefield_core::geometry::VoxelGrid;
use conefield_core::parts::Voxels;
use conefield_core::scan::Volume;
use conefield_core::{Error, Result};
use nifti::{Endianness, NiftiHeader};
use std::io::Write;
use std::path::Path;

/// Size of a header in bytes.
pub(crate) const HEADER: usize = 348;

/// Where the data of a single file starts when there is no extension.
const DATA: u64 = 352;

/// Whether `head` (at least [`HEADER`] bytes) has the magic bytes of NIfTI-1 or of its header-and-image pair.
pub(crate) fn is_header(head: &[u8]) -> bool {
    head.get(344..347).is_some_and(|m| m == b"n+1" || m == b"ni1")
}

/// Whether `head` starts like NIfTI-2.
pub(crate) fn is_second_version(head: &[u8]) -> bool {
    head.get(4..7).is_some_and(|m| m == b"n+2" || m == b"ni2")
}

/// Reads the volume in `path`; the affine is RAS, in mm.
pub(crate) fn read(path: &Path) -> Result<Volume> {
    let (input, head) = &mut open(path)?;
    if head.get(344..348) == Some(b"ni1\0".as_slice()) {
        return Err(Error::unsupported(
            format!("{}: a NIfTI header whose image is in another file", input.place()),
            "convert the pair to one .nii or .nii.gz file",
        ));
    }
    let header = parse(input, head)?;
    input.ensure(header.sizeof_hdr == HEADER as i32, "sizeof_hdr", header.sizeof_hdr, HEADER.to_string())?;
    let shape = voxels(input, &header)?;
    let number = number(input, &header)?;
    let offset = offset(input, &header)?;
    let (slope, inter) = scaling(input, &header)?;
    let affine = orientation(input, &header)?;
    let grid = VoxelGrid { shape, spacing: affine::spacing(&affine), center: [0.0; 3] };
    grid.validate(&input.place())?;
    let count = grid.len().unwrap_or(0);
    let order = match header.endianness {
        Endianness::Little => ByteOrder::Little,
        Endianness::Big => ByteOrder::Big,
    };
    input.skip(offset - HEADER as u64, "vox_offset")?;
    let values = input.scaled("data", count, number, order, [slope, inter])?;
    file_order::read(&input.place(), grid, Some(affine), values)
}

fn parse(input: &Input, head: &[u8]) -> Result<NiftiHeader> {
    let found = format!("the end of the file after {} bytes", head.len());
    input.ensure(head.len() >= HEADER, "header", found, format!("a NIfTI-1 header of {HEADER} bytes"))?;
    NiftiHeader::from_reader(head)
        .map_err(|e| input.invalid("header", e, format!("a NIfTI-1 header of {HEADER} bytes")))
}

/// The file `path` and its first [`HEADER`] bytes.
fn open(path: &Path) -> Result<(Input, Vec<u8>)> {
    let mut input = Input::open(path)?;
    let head = input.take(HEADER)?;
    Ok((input, head))
}

/// Voxels along x, y and z, from the header.
pub(crate) fn shape(path: &Path) -> Result<[usize; 3]> {
    let (input, head) = open(path)?;
    voxels(&input, &parse(&input, &head)?)
}

/// Three axes of at least one voxel; later axes must have length 1.
fn voxels(input: &Input, header: &NiftiHeader) -> Result<[usize; 3]> {
    let dim = header.dim.map(|d| d as i16);
    let shown = || format!("{dim:?}");
    input.ensure((3..=7).contains(&dim[0]), "dim[0]", dim[0], "3 (a volume), up to 7 if the later axes are 1")?;
    if dim[1..4].iter().any(|d| *d < 1) {
        return Err(input.invalid("dim", shown(), "at least one voxel along x, y and z"));
    }
    if let Some(k) = (4..=dim[0] as usize).find(|&k| dim[k] != 1) {
        let expected = "1: one volume, not a series (take one out of it first)";
        return Err(input.invalid(format!("dim[{k}]"), dim[k], expected));
    }
    Ok([dim[1] as usize, dim[2] as usize, dim[3] as usize])
}

fn number(input: &Input, header: &NiftiHeader) -> Result<Number> {
    let number = match header.datatype {
        2 => Number::U8,
        4 => Number::I16,
        8 => Number::I32,
        16 => Number::F32,
        64 => Number::F64,
        256 => Number::I8,
        512 => Number::U16,
        768 => Number::U32,
        1024 => Number::I64,
        1280 => Number::U64,
        other => {
            let name = match other {
                1 => " (bits)",
                32 | 1792 | 2048 => " (complex)",
                128 | 2304 => " (colour)",
                1536 => " (128-bit float)",
                _ => "",
            };
            let expected = "a real number of 8 to 64 bits: 2, 4, 8, 16, 64, 256, 512, 768, 1024 or 1280";
            return Err(input.invalid("datatype", format!("{other}{name}"), expected));
        }
    };
    let bits = 8 * number.bytes() as i16;
    let expected = format!("{bits}, which datatype {} takes", header.datatype);
    input.ensure(header.bitpix == bits, "bitpix", header.bitpix, expected)?;
    Ok(number)
}

fn offset(input: &Input, header: &NiftiHeader) -> Result<u64> {
    let offset = header.vox_offset;
    // Zero is common in the wild and can only mean the earliest possible offset.
    if offset == 0.0 {
        return Ok(DATA);
    }
    // Beyond 2^24 a 32-bit float no longer counts single bytes; no extension is that long.
    let fits = offset.fract() == 0.0 && (DATA as f32..16_777_216.0).contains(&offset);
    let expected = "a whole number of bytes from 352 to 16777215";
    input.ensure(fits, "vox_offset", offset, expected)?;
    Ok(offset as u64)
}

/// Slope and intercept. In the standard, a slope of 0 means "not scaled"; tools treat a slope that is not finite the
/// same way.
fn scaling(input: &Input, header: &NiftiHeader) -> Result<(f64, f64)> {
    let (slope, inter) = (header.scl_slope, header.scl_inter);
    if !slope.is_finite() {
        tracing::warn!("{}: scl_slope is {slope}: the stored values are used without scaling", input.place());
        return Ok((1.0, 0.0));
    }
    if slope == 0.0 {
        return Ok((1.0, 0.0));
    }
    input.ensure(inter.is_finite(), "scl_inter", inter, "a finite number beside a slope that is one")?;
    Ok((slope as f64, inter as f64))
}

/// Voxel index to millimetres: sform, else qform, else the voxel sizes alone.
fn orientation(input: &Input, header: &NiftiHeader) -> Result<Affine> {
    let mm = match header.xyzt_units & 7 {
        1 => 1000.0,
        0 | 2 => 1.0,
        3 => 0.001,
        other => return Err(input.invalid("xyzt_units", other, "0 (not said), 1 (m), 2 (mm) or 3 (µm)")),
    };
    let (field, rows) = if header.sform_code > 0 {
        ("sform (srow_x, srow_y, srow_z)", [header.srow_x, header.srow_y, header.srow_z].map(|r| r.map(f64::from)))
    } else if header.qform_code > 0 {
        ("qform (quatern, qoffset, pixdim)", quaternion(header))
    } else {
        let mut rows = [[0.0; 4]; 3];
        for k in 0..3 {
            rows[k][k] = f64::from(header.pixdim[k + 1]).abs();
        }
        ("pixdim", rows)
    };
    let [x, y, z] = rows.map(|r| r.map(|v| v * mm));
    let affine = [x, y, z, [0.0, 0.0, 0.0, 1.0]];
    let expected = "finite numbers and three independent voxel axes";
    input.ensure(affine::is_regular(&affine), field, format!("{rows:?}"), expected)?;
    text::warn(&input.place(), remarks(header, &affine, mm));
    Ok(affine)
}

/// What is odd about the axes: shear, and sizes in pixdim other than those of the sform. A pixdim of zeros says nothing.
fn remarks(header: &NiftiHeader, affine: &Affine, mm: f64) -> Vec<String> {
    let said: [f64; 3] = std::array::from_fn(|k| f64::from(header.pixdim[k + 1]).abs() * mm);
    let differs = affine::contradiction("pixdim", said, "the sform", affine::spacing(affine));
    let says = header.sform_code > 0 && said.iter().all(|s| *s > 0.0);
    affine::skew(affine).into_iter().chain(differs.filter(|_| says)).collect()
}

/// The standard's method 2: a rotation as a unit quaternion, voxel sizes, and the sign of the third axis in
/// `pixdim[0]`.
fn quaternion(header: &NiftiHeader) -> [[f64; 4]; 3] {
    let [mut b, mut c, mut d] = [header.quatern_b, header.quatern_c, header.quatern_d].map(f64::from);
    let squares = b * b + c * c + d * d;
    // The first component is not stored; rounding may make the number under its root slightly negative.
    let a = if squares > 1.0 {
        let n = squares.sqrt();
        (b, c, d) = (b / n, c / n, d / n);
        0.0
    } else {
        (1.0 - squares).sqrt()
    };
    let size: [f64; 3] = std::array::from_fn(|k| f64::from(header.pixdim[k + 1]).abs());
    let flip = if header.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
    let s = [size[0], size[1], size[2] * flip];
    let r = [
        [a * a + b * b - c * c - d * d, 2.0 * (b * c - a * d), 2.0 * (b * d + a * c)],
        [2.0 * (b * c + a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d - a * b)],
        [2.0 * (b * d - a * c), 2.0 * (c * d + a * b), a * a + d * d - b * b - c * c],
    ];
    let t = [header.quatern_x, header.quatern_y, header.quatern_z].map(f64::from);
    std::array::from_fn(|i| [r[i][0] * s[0], r[i][1] * s[1], r[i][2] * s[2], t[i]])
}

/// Refuses more voxels per axis than the header can express.
pub(crate) fn check_shape(place: &str, shape: [usize; 3]) -> Result<()> {
    let expected = "at most 32767 voxels per axis, the limit of NIfTI-1 (write .npy)";
    ensure(shape.iter().all(|&n| n <= i16::MAX as usize), place, "shape", format!("{shape:?}"), expected)
}

/// Writes `voxels` as `f32` with an sform: the volume's own affine, or one that puts the grid's centre at
/// `grid.center`.
pub(crate) fn write(w: &mut dyn Write, path: &Path, voxels: &mut dyn Voxels) -> Result<()> {
    let grid = voxels.grid();
    let place = path.display().to_string();
    check_shape(&place, grid.shape)?;
    // 1: the scanner's own coordinates; 2: other coordinates.
    let (affine, own) = affine::of(voxels, &place);
    let code = if own { 1i16 } else { 2 };
    let mut h = [0u8; DATA as usize];
    let mut put = |at: usize, bytes: &[u8]| h[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &(HEADER as i32).to_le_bytes());
    put(38, b"r");
    let [nx, ny, nz] = grid.shape.map(|n| n as i16);
    for (i, d) in [3, nx, ny, nz, 1, 1, 1, 1].iter().enumerate() {
        put(40 + 2 * i, &d.to_le_bytes());
    }
    put(70, &16i16.to_le_bytes());
    put(72, &32i16.to_le_bytes());
    let [sx, sy, sz] = grid.spacing.map(|s| s as f32);
    for (i, p) in [1.0, sx, sy, sz, 1.0, 1.0, 1.0, 1.0].iter().enumerate() {
        put(76 + 4 * i, &p.to_le_bytes());
    }
    put(108, &(DATA as f32).to_le_bytes());
    put(112, &1f32.to_le_bytes());
    put(123, &[2]);
    // The field has 80 bytes, the last of them 0.
    let about = voxels.hounsfield().map_or("conefield".into(), |hu| format!("conefield: {hu}"));
    put(148, &about.as_bytes()[..about.len().min(79)]);
    put(254, &code.to_le_bytes());
    for (i, x) in affine[..3].iter().flatten().enumerate() {
        put(280 + 4 * i, &(*x as f32).to_le_bytes());
    }
    put(344, b"n+1\0");
    w.write_all(&h).map_err(|e| Error::io(path, e))?;
    file_order::write(w, path, voxels, FileOrder::XFastest)
}

/// Writes `voxels` like [`write`], in gzip.
pub(crate) fn write_packed(w: &mut dyn Write, path: &Path, voxels: &mut dyn Voxels) -> Result<()> {
    let mut packed = Packing::gzip(w).map_err(|e| Error::io(path, e))?;
    write(&mut packed, path, voxels)?;
    packed.finish().map_err(|e| Error::io(path, e))
}

#[cfg(test)]
pub(crate) mod tests {
    use crate::testing::{data, file, gzip, says};
    use crate::{read_volume, write_volume};
    use conefield_core::scan::Volume;
    use ndarray::Array3;

    fn volume() -> Volume {
        let data = Array3::from_shape_fn((4, 3, 2), |(x, y, z)| x as f32 + 10.0 * y as f32 + 100.0 * z as f32);
        Volume::centered(data, [0.5, 0.75, 2.0])
    }

    /// The bytes of [`volume`] as `.nii`.
    fn bytes() -> Vec<u8> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.nii");
        write_volume(&path, &volume()).unwrap();
        std::fs::read(&path).unwrap()
    }

    fn refused(bytes: &[u8], words: &[&str]) {
        for (name, bytes) in [("bad.nii", bytes.to_vec()), ("bad.nii.gz", gzip(bytes))] {
            says(read_volume(&file(name, &[&bytes]).1), &[&[name], words].concat());
        }
    }

    fn with(at: usize, bytes_at: &[u8]) -> Vec<u8> {
        let mut b = bytes();
        b[at..at + bytes_at.len()].copy_from_slice(bytes_at);
        b
    }

    #[test]
    fn an_affine_of_other_voxels_is_replaced() {
        let copy = file("a.nii", &[]);
        let mut v = volume();
        v.affine = Some([[0.0, 0.75, 0.0, 5.0], [-0.9, 0.0, 0.0, 6.0], [0.0, 0.0, 2.0, -7.0], [0.0, 0.0, 0.0, 1.0]]);
        // It would make the file contradict itself.
        write_volume(&copy.1, &v).unwrap();
        assert_eq!(read_volume(&copy.1).unwrap().grid, v.grid);
    }

    #[test]
    fn a_clinical_file_keeps_its_place_and_comes_back() {
        let Some(path) = data("clinical/abdomen_ct_hu.nii.gz") else { return };
        let v = read_volume(&path).unwrap();
        assert_eq!((v.grid.shape, v.grid.center), ([122, 101, 112], [0.0; 3]));
        assert!(v.grid.spacing.iter().all(|s| (s - 3.0).abs() < 1e-6), "{:?}", v.grid.spacing);
        let [low, high] = conefield_core::finite::range(&v.data);
        assert!((-3100.0..=-900.0).contains(&low) && high > 300.0, "{low} to {high} are no Hounsfield units");
        assert!(v.affine.unwrap()[..3].iter().any(|row| row[3] != 0.0), "the file has an offset");
        let copy = file("copy.nii.gz", &[]);
        write_volume(&copy.1, &v).unwrap();
        let back = read_volume(&copy.1).unwrap();
        assert!((back.data, back.grid, back.affine) == (v.data, v.grid, v.affine));
    }

    #[test]
    fn content_decides_over_the_name() {
        let f = file("packed.nii", &[&gzip(&bytes())]);
        assert_eq!(read_volume(&f.1).unwrap().data, volume().data);
        let f = file("plain.npy", &[&bytes()]);
        assert_eq!(read_volume(&f.1).unwrap().data, volume().data);
    }

    /// The header of 2×1×1 voxels without an orientation: type and bits of a number, `pixdim`, slope and intercept.
    pub(crate) fn header(big_endian: bool, [code, bits]: [i16; 2], pixdim: [f32; 4], scaling: [f32; 2]) -> Vec<u8> {
        let mut b = vec![0u8; 352];
        let mut put = |at: usize, little: &[u8]| {
            let field = &mut b[at..at + little.len()];
            field.copy_from_slice(little);
            if big_endian {
                field.reverse();
            }
        };
        put(0, &348i32.to_le_bytes());
        for (i, x) in [4i16, 2, 1, 1, 1].into_iter().enumerate() {
            put(40 + 2 * i, &x.to_le_bytes());
        }
        put(70, &code.to_le_bytes());
        put(72, &bits.to_le_bytes());
        pixdim.into_iter().enumerate().for_each(|(i, x)| put(76 + 4 * i, &x.to_le_bytes()));
        scaling.into_iter().enumerate().for_each(|(i, x)| put(112 + 4 * i, &x.to_le_bytes()));
        b[344..348].copy_from_slice(b"n+1\0");
        b
    }

    #[test]
    fn integers_scale_and_swap() {
        let mut b = header(true, [4, 16], [1.0, 2.0, -3.0, 4.0], [0.5, -1.0]);
        b[123] = 3;
        b.extend([(-4i16).to_be_bytes(), 6i16.to_be_bytes()].concat());
        let v = read_volume(&file("a.nii", &[&b]).1).unwrap();
        assert_eq!(v.data.as_slice().unwrap(), [-3.0, 2.0]);
        // Micrometres, no orientation: the voxel sizes alone.
        assert_eq!(v.grid.spacing, [0.002, 0.003, 0.004]);
        // With a slope of 0 or NaN the values are as stored.
        for slope in [0.0f32, f32::NAN] {
            b[112..116].copy_from_slice(&slope.to_be_bytes());
            assert_eq!(read_volume(&file("a.nii", &[&b]).1).unwrap().data.as_slice().unwrap(), [-4.0, 6.0]);
        }
        // A quarter turn about z, as method 2 stores it.
        let mut put = |at: usize, x: &[u8]| b[at..at + x.len()].copy_from_slice(x);
        put(252, &1i16.to_be_bytes());
        put(264, &std::f32::consts::FRAC_1_SQRT_2.to_be_bytes());
        put(268, &10f32.to_be_bytes());
        put(76, &(-1f32).to_be_bytes());
        put(123, &[2]);
        let a = read_volume(&file("a.nii", &[&b]).1).unwrap().affine.unwrap();
        let want = [[0.0, -3.0, 0.0, 10.0], [2.0, 0.0, 0.0, 0.0], [0.0, 0.0, -4.0, 0.0]];
        for (a, w) in a.iter().flatten().zip(want.iter().flatten()) {
            assert!((a - w).abs() < 1e-6, "{a} {w}");
        }
    }

    #[test]
    fn hostile_headers_are_refused_in_words() {
        let b = bytes();
        refused(&b[..100], &["NIfTI"]);
        refused(b"a text that is no volume", &["NIfTI", "NumPy"]);
        refused(&with(0, &1i32.to_le_bytes()), &["sizeof_hdr"]);
        refused(&with(40, &2i16.to_le_bytes()), &["dim[0]", "found 2"]);
        refused(&with(116, &f32::INFINITY.to_le_bytes()), &["scl_inter", "inf"]);
        refused(&with(123, &[5]), &["xyzt_units", "5"]);
    }

    #[test]
    fn shear_and_sizes_that_contradict_are_said() {
        let said = |bytes: &[u8]| {
            let header = nifti::NiftiHeader::from_reader(&bytes[..super::HEADER]).unwrap();
            let affine = read_volume(&file("a.nii", &[bytes]).1).unwrap().affine.unwrap();
            super::remarks(&header, &affine, 1.0).join("; ")
        };
        assert_eq!(said(&bytes()), "");
        let other = said(&with(88, &3f32.to_le_bytes()));
        assert!(other.contains("pixdim says voxels of [0.5, 0.75, 3.0] mm, the sform [0.5, 0.75, 2.0]"), "{other}");
        // The sform's second column gets a part along x.
        let sheared = said(&with(284, &0.75f32.to_le_bytes()));
        assert!(sheared.contains("x and y of the voxels are at 45.00 degrees"), "{sheared}");
    }
}
