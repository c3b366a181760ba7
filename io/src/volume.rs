//! Entry points for volumes: they recognize a file's format, and choose a format for a file name.

use crate::dicom::DicomTemplate;
use crate::folder::file_name;
use crate::folder_of;
use crate::input::{Input, start_of};
use crate::size::product;
use crate::{dicom, foreign, metaimage, nifti, npy, nrrd, pickle, scan, tiff, write_atomic, zarr};
use conefield_core::allowance;
use conefield_core::error::ensure;
use conefield_core::geometry::VoxelGrid;
use conefield_core::parts::{Part, Voxels, copy};
use conefield_core::scan::{Affine, Volume};
use conefield_core::{Error, Result};
use ndarray::{Array3, ArrayViewMut3, Ix3, s};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Reads a volume: NIfTI-1 (any real number type, gzip or not), MetaImage (`.mha`, or `.mhd` with its data file in the
/// same folder, zlib or not), NRRD (`.nrrd`, or `.nhdr` with its data file in the same folder, gzip or not), a NumPy
/// array of three axes, the pages of a TIFF file, or a folder: OME-Zarr (0.4), the DICOM files of one series, one slice
/// each (or all slices in one DICOM file), or TIFF files, one slice each in the order of the numbers in their names.
///
/// The content decides, not the name. `grid.center` is `[0, 0, 0]`: the position in the patient stays in `affine`, in
/// mm, RAS. A NumPy array has no voxel size and gets 1 mm, as do a NRRD and TIFF files that do not say it. Values are
/// converted to `f32` and scaled by NIfTI's or DICOM's slope and intercept; a value that is not finite is refused.
pub fn read_volume(path: impl AsRef<Path>) -> Result<Volume> {
    let path = path.as_ref();
    (open(path)?.read)(path)
}

/// How volumes of a format are read.
pub(crate) struct VolumeFile {
    read: fn(&Path) -> Result<Volume>,
    /// The number of voxels, from headers.
    pub voxels: fn(&Path) -> Result<u64>,
}

/// A folder of DICOM files.
const SERIES: VolumeFile = VolumeFile { read: dicom::read, voxels: dicom::voxels };
/// One DICOM file with all slices.
const ENHANCED: VolumeFile = VolumeFile { read: dicom::enhanced::read, voxels: dicom::enhanced::voxels };
/// A folder of OME-Zarr.
const ZARR: VolumeFile = VolumeFile { read: zarr::read, voxels: |path| zarr::shape(path).map(product) };
/// A folder of TIFF files.
const SLICES: VolumeFile = VolumeFile { read: tiff::read_folder, voxels: tiff::folder_voxels };
const NPY: VolumeFile =
    VolumeFile { read: read_numpy, voxels: |path| npy::shape(&mut Input::open(path)?).map(product) };
const METAIMAGE: VolumeFile = VolumeFile { read: metaimage::read, voxels: |path| metaimage::shape(path).map(product) };
const NRRD: VolumeFile = VolumeFile { read: nrrd::read, voxels: |path| nrrd::shape(path).map(product) };
const TIFF: VolumeFile = VolumeFile { read: tiff::read_volume, voxels: tiff::values };
const NIFTI: VolumeFile = VolumeFile { read: nifti::read, voxels: |path| nifti::shape(path).map(product) };

/// Recognizes the format of a volume by its content.
pub(crate) fn open(path: &Path) -> Result<VolumeFile> {
    if path.is_dir() {
        if zarr::is_zarr(path) {
            return Ok(ZARR);
        }
        if dicom::is_series(path) {
            return Ok(SERIES);
        }
        // The images in the folder of a scan are no slices.
        let expected = "a volume: a file, or a folder of DICOM or TIFF slices or of OME-Zarr";
        ensure(scan::find(path).is_err(), &path.display().to_string(), "volume", "the folder of a scan", expected)?;
        return Ok(if tiff::is_stack(path) { SLICES } else { SERIES });
    }
    let mut input = Input::open(path)?;
    let head = input.take(nifti::HEADER)?;
    if head.starts_with(npy::MAGIC) {
        return Ok(NPY);
    }
    if nifti::is_second_version(&head) {
        let what = format!("{}: a NIfTI-2 file", path.display());
        return Err(Error::unsupported(what, "convert it to NIfTI-1 (.nii or .nii.gz)"));
    }
    if dicom::is_header(&head) {
        if dicom::enhanced::has_frames(path)? {
            return Ok(ENHANCED);
        }
        let what = format!("{}: one DICOM file", path.display());
        return Err(Error::unsupported(what, "give the folder that holds the files of its series"));
    }
    let found = [
        (metaimage::is_header(&head), METAIMAGE, "a MetaImage"),
        (nrrd::is_header(&head), NRRD, "a NRRD"),
        (tiff::is_tiff(&head), TIFF, "a TIFF file"),
    ];
    if let Some((_, file, name)) = found.into_iter().find(|(is, ..)| *is) {
        if input.left().is_none() {
            let what = format!("{}: {name} inside gzip", path.display());
            return Err(Error::unsupported(what, "unpack it first; the format has a compression of its own"));
        }
        return Ok(file);
    }
    if !nifti::is_header(&head) {
        foreign::refuse(path, &head)?;
        let mark = head.get(344..348).map_or_else(
            || format!("a file of {} bytes", head.len()),
            |m| format!("{:02x?} at byte 344 and {:02x?} at the start", m, &head[..6]),
        );
        let hint = if file_name(path).to_ascii_lowercase().ends_with(".npy") {
            "a NumPy array (93 4e 55 4d 50 59 at the start); a NIfTI-1 header is read too"
        } else {
            "a NIfTI-1 header (6e 2b 31 00 at byte 344), a NumPy array (93 4e 55 4d 50 59 at the start), a MetaImage \
             header (NDims = 3), NRRD (4e 52 52 44 at the start) or TIFF (49 49 2a 00 or 4d 4d 00 2a)"
        };
        return Err(input.invalid("format", mark, hint));
    }
    Ok(NIFTI)
}

/// Whether the file, or the folder of DICOM files, TIFF files or OME-Zarr, looks like a volume; its data is not read.
/// Also true for paths that [`read_volume`] refuses with a better error: a single DICOM file, and a file named like a
/// volume that is damaged or of another format.
pub fn is_volume(path: impl AsRef<Path>) -> bool {
    let path = path.as_ref();
    if path.is_dir() {
        // The images in the folder of a scan are its views.
        return zarr::is_zarr(path) || dicom::is_series(path) || (tiff::is_stack(path) && scan::find(path).is_err());
    }
    let named = format_of(path).is_some();
    let Ok(mut input) = Input::open(path) else { return named };
    // Of the formats read here, only volumes use gzip.
    if input.left().is_none() {
        return true;
    }
    input.take(nifti::HEADER).is_ok_and(|head| {
        head.starts_with(npy::MAGIC)
            || nifti::is_header(&head)
            || metaimage::is_header(&head)
            || nrrd::is_header(&head)
            || tiff::is_tiff(&head)
            || dicom::is_header(&head)
            || (named && !pickle::is_start(&head))
    })
}

/// The other file that holds the voxels, if `path` is a header (`.mhd`, `.nhdr`) that names one which exists.
pub fn data_file(path: &Path) -> Option<PathBuf> {
    let head = start_of(path, nifti::HEADER as u64).ok()?;
    let mut input = Input::open_plain(path).ok()?;
    let header = match () {
        () if metaimage::is_header(&head) => metaimage::read_header(&mut input),
        () if nrrd::is_header(&head) => nrrd::read_header(&mut input),
        () => return None,
    };
    let (header, [one, other]) = (header.ok()?, nrrd::DATA_FILE);
    let (_, name) = header.first(&[metaimage::DATA_FILE, one, other]).ok()??;
    Some(folder_of(path).join(name)).filter(|file| file.is_file())
}

/// Whether the name is that of a volume that [`write_voxels`] can write.
pub fn is_volume_name(path: impl AsRef<Path>) -> bool {
    format_of(path.as_ref()).is_some()
}

/// Refuses a name or a number of voxels that [`write_voxels`] would refuse, before the voxels are computed.
pub fn check_shape(path: impl AsRef<Path>, shape: [usize; 3]) -> Result<()> {
    let path = path.as_ref();
    (wanted(path)?.check)(&path.display().to_string(), shape)
}

/// Writes a volume in the format of its name, in `f32`: `.nii`, `.nii.gz` (with an sform in mm), `.mha` (zlib,
/// with the same axes as directions and voxel sizes), `.mhd` (the same as a header, with uncompressed voxels in a
/// `.raw` next to it), `.nrrd` (gzip, the same axes), `.npy` (C order, without voxel sizes), `.tif` (one page per slice
/// along z, with voxel sizes), `.zarr` (a folder: OME-Zarr 0.4 with a pyramid) or, in 16 bits, `.dicom` (a folder:
/// a DICOM series) or `.dcm` (one file: an enhanced CT).
///
/// An affine is kept if its voxel sizes match the grid; without one, the grid's centre is placed at `grid.center`.
pub fn write_volume(path: impl AsRef<Path>, mut volume: &Volume) -> Result<()> {
    let path = path.as_ref();
    let (found, expected) = (volume.data.shape(), volume.grid.shape);
    let (place, field) = (path.display().to_string(), "shape of the data");
    ensure(found == expected, &place, field, format!("{found:?}"), format!("{expected:?}"))?;
    write_voxels(path, &mut volume)
}

/// Writes voxels like [`write_volume`], slab by slab. At most 16 MiB of them (or one row) are in memory at once, for
/// `.mha` also 32 MiB of compressed data, whose rest goes to an unnamed file next to it. For `.zarr` it is a chunk of
/// 1 MiB per level and a few more; for `.dicom` a slice and up to 32 MiB of 32-bit floats, whose rest goes to an unnamed file.
pub fn write_voxels(path: impl AsRef<Path>, voxels: &mut dyn Voxels) -> Result<()> {
    write_voxels_of(path, voxels, None)
}

/// Writes voxels like [`write_voxels`], with the patient and study of `template`, which only DICOM can hold.
pub fn write_voxels_of(
    path: impl AsRef<Path>,
    voxels: &mut dyn Voxels,
    template: Option<&DicomTemplate>,
) -> Result<()> {
    let path = path.as_ref();
    let format = wanted(path)?;
    let fits = template.is_none() || matches!(format.write, Writer::Dicom(_));
    let expected = "an end of .dicom or .dcm: other formats have no patient and study for the template";
    ensure(fits, &path.display().to_string(), "file name", file_name(path), expected)?;
    voxels.grid().validate(&path.display().to_string())?;
    let layers = &mut Layers::new(voxels, allowance::room());
    match format.write {
        Writer::File(write) => write_atomic(path, &mut |w| write(w, path, layers)),
        Writer::Files(write) => write(path, layers),
        Writer::Chunks(write) => write(path, layers.voxels),
        Writer::Dicom(write) => write(path, layers, template),
    }
}

/// Voxels that are read layer by layer along z. Lines of a volume run along z, so that one layer of a volume on the
/// disk touches every page of it: many layers are read at once there, and held.
struct Layers<'a> {
    voxels: &'a mut dyn Voxels,
    /// The number of layers that are read at once.
    many: usize,
    /// The first layer held.
    first: usize,
    held: Array3<f32>,
}

impl<'a> Layers<'a> {
    /// For `room` bytes that may be at work at once: layers take a half, the pages that are read meanwhile the rest.
    fn new(voxels: &'a mut dyn Voxels, room: u64) -> Self {
        let [nx, ny, _] = voxels.grid().shape;
        let many = (room / 8) as usize / (nx * ny);
        Self { voxels, many, first: 0, held: Array3::zeros([0; 3]) }
    }
}

impl Voxels for Layers<'_> {
    fn grid(&self) -> VoxelGrid {
        self.voxels.grid()
    }

    fn affine(&self) -> Option<Affine> {
        self.voxels.affine()
    }

    fn hounsfield(&self) -> Option<&str> {
        self.voxels.hounsfield()
    }

    fn fill(&mut self, part: &Part, out: ArrayViewMut3<'_, f32>) -> Result<()> {
        let [nx, ny, nz] = self.grid().shape;
        let [x, y, z] = part.clone();
        if self.many >= nz || z.len() == nz {
            return self.voxels.fill(part, out);
        }
        if z.start < self.first || self.first + self.held.dim().2 < z.end {
            self.first = z.start;
            let last = (z.start + self.many.max(z.len())).min(nz);
            // The layers of before go first: both together would be all that may be at work.
            self.held = Array3::zeros([0; 3]);
            self.held = Array3::zeros([nx, ny, last - z.start]);
            self.voxels.fill(&[0..nx, 0..ny, z.start..last], self.held.view_mut())?;
        }
        copy(out, self.held.slice(s![x, y, z.start - self.first..z.end - self.first]));
        Ok(())
    }
}

/// Size of `voxels` as `.nii.gz` in bytes: does all the work of [`write_voxels`] except disk access, to measure it.
pub fn packed_bytes(voxels: &mut dyn Voxels) -> Result<u64> {
    let place = Path::new("packed voxels");
    voxels.grid().validate("packed voxels")?;
    let mut counted = Counting(0);
    nifti::write_packed(&mut counted, place, voxels)?;
    Ok(counted.0)
}

/// Counts bytes and discards them.
struct Counting(u64);

impl Write for Counting {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0 += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// A NumPy array as a volume of 1 mm voxels.
fn read_numpy(path: &Path) -> Result<Volume> {
    let data: Array3<f32> = npy::read(path, &["x", "y", "z"])?
        .into_dimensionality::<Ix3>()
        .map_err(|e| Error::invalid(path.display().to_string(), "shape", e, "three axes (x, y, z)"))?;
    let grid = VoxelGrid { shape: data.dim().into(), spacing: [1.0; 3], center: [0.0; 3] };
    Ok(Volume { data, grid, affine: None })
}

/// The format for a file name; refuses an unknown extension.
fn wanted(path: &Path) -> Result<&'static VolumeFormat> {
    let (place, expected) =
        (path.display().to_string(), "an end of .nii, .nii.gz, .mha, .mhd, .nrrd, .npy, .tif, .zarr, .dicom or .dcm");
    format_of(path).ok_or_else(|| Error::invalid(place, "file name", file_name(path), expected))
}

/// How volumes of a format are written.
struct VolumeFormat {
    /// The end of file names.
    end: &'static str,
    /// Refuses a shape that the format cannot hold.
    check: fn(&str, [usize; 3]) -> Result<()>,
    write: Writer,
}

enum Writer {
    /// Writes one file, layer by layer.
    File(fn(&mut dyn Write, &Path, &mut dyn Voxels) -> Result<()>),
    /// Creates its files itself, layer by layer.
    Files(fn(&Path, &mut dyn Voxels) -> Result<()>),
    /// Creates its files itself; its chunks come in an order of their own.
    Chunks(fn(&Path, &mut dyn Voxels) -> Result<()>),
    /// Creates its files itself, layer by layer, with the patient and study of a template.
    Dicom(fn(&Path, &mut dyn Voxels, Option<&DicomTemplate>) -> Result<()>),
}

const fn format(end: &'static str, check: fn(&str, [usize; 3]) -> Result<()>, write: Writer) -> VolumeFormat {
    VolumeFormat { end, check, write }
}

fn any_shape(_: &str, _: [usize; 3]) -> Result<()> {
    Ok(())
}

const FORMATS: &[VolumeFormat] = &[
    format(".nii.gz", nifti::check_shape, Writer::File(nifti::write_packed)),
    format(".nii", nifti::check_shape, Writer::File(nifti::write)),
    format(".npy", any_shape, Writer::File(npy::write_voxels)),
    format(".mha", any_shape, Writer::File(metaimage::write)),
    format(".mhd", any_shape, Writer::Files(metaimage::write_raw)),
    format(".nrrd", any_shape, Writer::File(nrrd::write)),
    format(".tif", tiff::check_shape, Writer::File(tiff::write)),
    format(".tiff", tiff::check_shape, Writer::File(tiff::write)),
    format(".zarr", any_shape, Writer::Chunks(zarr::write)),
    format(".dicom", dicom::check_shape, Writer::Dicom(dicom::write)),
    format(".dcm", dicom::enhanced::check_one_file, Writer::Dicom(dicom::enhanced::write)),
];

fn format_of(path: &Path) -> Option<&'static VolumeFormat> {
    let name = file_name(path).to_ascii_lowercase();
    FORMATS.iter().find(|format| name.ends_with(format.end))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::nifti::tests::header;
    use crate::number::Number;
    use crate::testing::{comes_back_to_the_bit, file, npy_bytes, says, zlib};
    use conefield_core::parts::Part;

    /// Two numbers of each type, with their bytes in both orders, little-endian first.
    pub(crate) fn two_of_each() -> Vec<(Number, [f64; 2], [Vec<u8>; 2])> {
        macro_rules! each {
            ($($number:ident $t:ty: $a:expr, $b:expr;)*) => {
                vec![$((
                    Number::$number,
                    [$a as f64, $b as f64],
                    [[<$t>::to_le_bytes($a), <$t>::to_le_bytes($b)].concat(), [<$t>::to_be_bytes($a), <$t>::to_be_bytes($b)].concat()],
                )),*]
            };
        }
        each! {
            I8 i8: i8::MIN, 127i8;
            U8 u8: 0u8, 255u8;
            I16 i16: i16::MIN, 258i16;
            U16 u16: 65535u16, 258u16;
            I32 i32: i32::MIN, 16909060i32;
            U32 u32: u32::MAX, 16909060u32;
            I64 i64: i64::MIN, 72623859790382856i64;
            U64 u64: u64::MAX, 72623859790382856u64;
            F32 f32: -1.5f32, 3.25e-3f32;
            F64 f64: -1.5f64, 0.1f64;
        }
    }

    #[test]
    fn the_folder_of_a_scan_is_no_volume() {
        let dir = tempfile::tempdir().unwrap();
        let volume = Volume::centered(Array3::from_elem((2, 3, 1), 0.5), [1.0; 3]);
        write_volume(dir.path().join("view.tif"), &volume).unwrap();
        assert_eq!(read_volume(dir.path()).unwrap().data, volume.data);
        std::fs::write(dir.path().join("scanner.toml"), "").unwrap();
        let e = read_volume(dir.path()).unwrap_err().to_string();
        assert!(e.contains("the folder of a scan"), "{e}");
    }

    #[test]
    fn what_is_written_comes_back_to_the_bit() {
        let data = |shape| Array3::from_shape_fn(shape, |(x, y, z)| (x + 10 * y + 100 * z) as f32 / 7.0);
        // For Zarr, more than one chunk along x and z.
        let spacing = [1.0 / 3.0, 0.7, 2.0];
        comes_back_to_the_bit("a.zarr", data((70, 5, 66)), spacing);
        for name in ["a.mha", "a.mhd", "a.nrrd", "a.tif"] {
            comes_back_to_the_bit(name, data((4, 3, 2)), spacing);
        }
        // NIfTI has 32-bit numbers.
        for name in ["a.nii", "a.nii.gz", "B.NII.GZ"] {
            comes_back_to_the_bit(name, data((4, 3, 2)), [0.5, 0.75, 2.0]);
        }
    }

    #[test]
    fn every_type_is_read_in_both_orders() {
        let all = two_of_each();
        // NIfTI's code, and the names of MetaImage, NRRD and NumPy.
        for (number, code, met, nrrd, kind) in [
            (Number::I8, 256, "CHAR", "int8", "i1"),
            (Number::U8, 2, "UCHAR", "unsigned char", "u1"),
            (Number::I16, 4, "SHORT", "short int", "i2"),
            (Number::U16, 512, "USHORT", "uint16_t", "u2"),
            (Number::I32, 8, "INT", "int", "i4"),
            (Number::U32, 768, "UINT", "unsigned int", "u4"),
            (Number::I32, 8, "LONG", "signed int", "i4"),
            (Number::U32, 768, "ULONG", "uint32", "u4"),
            (Number::I64, 1024, "LONG_LONG", "long long int", "i8"),
            (Number::U64, 1280, "ULONG_LONG", "ulonglong", "u8"),
            (Number::F32, 16, "FLOAT", "float", "f4"),
            (Number::F64, 64, "DOUBLE", "double", "f8"),
        ] {
            let (_, values, bytes) = all.iter().find(|(n, ..)| *n == number).unwrap();
            for (big, bytes) in [false, true].into_iter().zip(bytes) {
                let [order, msb, sign] = if big { ["big", "True", ">"] } else { ["little", "False", "<"] };
                let met =
                    format!("NDims = 3\nBinaryDataByteOrderMSB = {msb}\nDimSize = 1 2 1\nElementType = MET_{met}\n");
                let packed = format!("{met}CompressedData = True\nElementDataFile = LOCAL\n");
                let nrrd = format!("type: {nrrd}\ndimension: 3\nsizes: 1 2 1\nencoding: raw\nendian: {order}\n\n");
                for (head, data, [slope, intercept]) in [
                    (header(big, [code, 8 * number.bytes() as i16], [1.0; 4], [0.5, -8.0]), bytes, [0.5, -8.0]),
                    (format!("{met}ElementDataFile = LOCAL\n").into_bytes(), bytes, [1.0, 0.0]),
                    (packed.into_bytes(), &zlib(bytes), [1.0, 0.0]),
                    (format!("NRRD0004\n{nrrd}").into_bytes(), bytes, [1.0, 0.0]),
                    (npy_bytes(&format!("{sign}{kind}"), false, "(1, 2, 1)", &[]), bytes, [1.0, 0.0]),
                ] {
                    let found = read_volume(&file("a", &[&head, data]).1).unwrap().data;
                    let want = values.map(|x| (slope * x + intercept) as f32);
                    assert_eq!(
                        found.as_slice().unwrap(),
                        want,
                        "{number}, {order}: {}",
                        String::from_utf8_lossy(&head)
                    );
                }
                let list = npy_bytes(&format!("{sign}{kind}"), false, "(2,)", bytes);
                let exact = npy::read_exact(&mut Input::open(&file("a.npy", &[&list]).1).unwrap()).unwrap();
                assert_eq!(exact, (vec![2], values.to_vec()), "{number}, {order}");
            }
        }
    }

    #[test]
    fn numpy_volumes_come_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        let v = Volume::centered(Array3::from_shape_fn((2, 3, 4), |(x, y, z)| (x + 2 * y + 6 * z) as f32), [2.0; 3]);
        write_volume(&path, &v).unwrap();
        let back = read_volume(&path).unwrap();
        assert_eq!((&back.data, back.grid.spacing, back.affine), (&v.data, [1.0; 3], None));
        assert!(is_volume(&path) && !is_volume(dir.path()));
        let packed = dir.path().join("a.nii.gz");
        write_volume(&packed, &v).unwrap();
        assert_eq!(packed_bytes(&mut &v).unwrap(), packed.metadata().unwrap().len());
    }

    /// Voxels computed on demand, more than fit into a slab.
    struct RampVoxels {
        largest: usize,
        parts: usize,
    }

    fn ramp(at: [usize; 3]) -> f32 {
        (at[0] + 200 * at[1] + 40_000 * at[2]) as f32
    }

    impl Voxels for RampVoxels {
        fn grid(&self) -> VoxelGrid {
            VoxelGrid { shape: [200, 190, 180], spacing: [1.0; 3], center: [0.0; 3] }
        }
        fn affine(&self) -> Option<conefield_core::scan::Affine> {
            None
        }
        fn fill(&mut self, part: &Part, mut out: ndarray::ArrayViewMut3<'_, f32>) -> Result<()> {
            for ((x, y, z), value) in out.indexed_iter_mut() {
                *value = ramp([part[0].start + x, part[1].start + y, part[2].start + z]);
            }
            (self.largest, self.parts) = (self.largest.max(out.len()), self.parts + 1);
            Ok(())
        }
    }

    #[test]
    fn every_format_is_written_slab_by_slab_to_the_bytes_of_the_whole() {
        let dir = tempfile::tempdir().unwrap();
        let whole = Volume::collect(&mut RampVoxels { largest: 0, parts: 0 }).unwrap();
        assert_eq!(whole.data[[199, 189, 179]], ramp([199, 189, 179]));
        for end in ["nii", "nii.gz", "mha", "npy", "nrrd", "tif"] {
            let [streamed, at_once] = ["streamed", "at_once"].map(|n| dir.path().join(format!("{n}.{end}")));
            let mut voxels = RampVoxels { largest: 0, parts: 0 };
            write_voxels(&streamed, &mut voxels).unwrap();
            assert!(voxels.parts > 1 && voxels.largest <= 1 << 22, "{end}");
            assert!(read_volume(&streamed).unwrap().data == whole.data, "{end}");
            write_volume(&at_once, &whole).unwrap();
            assert!(std::fs::read(&streamed).unwrap() == std::fs::read(&at_once).unwrap(), "{end}");
        }
    }

    /// The rooms hold less than a layer, 7 layers and all of them.
    #[test]
    fn layers_are_read_once_and_many_at_a_time() {
        for (room, parts) in [(8, 180), (7 * 8 * 200 * 190, 26), (u64::MAX, 180)] {
            let mut voxels = RampVoxels { largest: 0, parts: 0 };
            let mut layers = Layers::new(&mut voxels, room);
            for z in 0..180 {
                let mut out = Array3::zeros([100, 190, 1]);
                layers.fill(&[100..200, 0..190, z..z + 1], out.view_mut()).unwrap();
                assert!(out.indexed_iter().all(|((x, y, _), v)| *v == ramp([100 + x, y, z])), "{room}, layer {z}");
            }
            assert_eq!(voxels.parts, parts, "{room}");
        }
    }

    #[test]
    fn voxels_beside_a_header_are_not_those_of_another_file() {
        let dir = tempfile::tempdir().unwrap();
        let volume = Volume::centered(Array3::from_shape_fn((4, 3, 2), |(x, y, z)| ramp([x, y, z])), [0.5, 0.75, 2.0]);
        let path = dir.path().join("a.mhd");
        write_volume(&path, &volume).unwrap();
        assert_eq!(std::fs::metadata(dir.path().join("a.raw")).unwrap().len(), 96);
        std::fs::rename(dir.path().join("a.raw"), dir.path().join("b.raw")).unwrap();
        says(write_volume(dir.path().join("b.mhd"), &volume), &["b.mhd: output", "b.raw without its header"]);
    }

    #[test]
    fn bad_names_and_values_are_refused_and_leave_the_file_whole() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.nii.gz");
        let mut v = Volume::centered(Array3::ones((2, 2, 2)), [1.0; 3]);
        write_volume(&path, &v).unwrap();
        v.data[[1, 0, 1]] = f32::INFINITY;
        says(write_volume(&path, &v), &["a.nii.gz", "voxel [1, 0, 1]"]);
        assert_eq!(read_volume(&path).unwrap().data, Array3::<f32>::ones((2, 2, 2)));
        says(write_volume(dir.path().join("a.png"), &v), &["a.png", ".nii.gz"]);
        says(read_volume(dir.path().join("none.nii")), &["none.nii"]);
        says(read_volume(dir.path()), &["DICOM"]);
    }
}
