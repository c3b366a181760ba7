//! Entry points for volumes: they recognize a file's format, and choose a format for a file name.

use crate::dicom::DicomTemplate;
use crate::input::Input;
use crate::{dicom, foreign, metaimage, nifti, npy, nrrd, pickle, scan, tiff, write_atomic, zarr};
use conefield_core::allowance;
use conefield_core::geometry::VoxelGrid;
use conefield_core::parts::{Part, Voxels};
use conefield_core::scan::{Affine, Volume};
use conefield_core::{Error, Result};
use ndarray::{Array3, ArrayViewMut3, Ix3, s};
use std::io::Write;
use std::path::Path;

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
    match open(path)? {
        VolumeFile::Series => dicom::read(path),
        VolumeFile::Enhanced => dicom::enhanced::read(path),
        VolumeFile::Zarr => zarr::read(path),
        VolumeFile::Slices => tiff::read_folder(path),
        VolumeFile::Npy(mut input, head) => from_numpy(path, npy::read_from(&mut input, head, &["x", "y", "z"])?),
        VolumeFile::MetaImage => metaimage::read(path),
        VolumeFile::Nrrd => nrrd::read(path),
        VolumeFile::Tiff => tiff::read_volume(path),
        VolumeFile::Nifti(mut input, head) => nifti::read_from(&mut input, &head),
    }
}

/// A volume's format, with the open file and the bytes read to recognize it.
pub(crate) enum VolumeFile {
    /// A folder of DICOM files.
    Series,
    /// One DICOM file with all slices.
    Enhanced,
    /// A folder of OME-Zarr.
    Zarr,
    /// A folder of TIFF files.
    Slices,
    /// Eight bytes have been read.
    Npy(Input, Vec<u8>),
    /// The reader opens the file again, as do the next two.
    MetaImage,
    Nrrd,
    Tiff,
    /// The header has been read.
    Nifti(Input, Vec<u8>),
}

/// Recognizes the format of a volume by its content.
pub(crate) fn open(path: &Path) -> Result<VolumeFile> {
    if path.is_dir() {
        if zarr::is_zarr(path) {
            return Ok(VolumeFile::Zarr);
        }
        if dicom::is_series(path) {
            return Ok(VolumeFile::Series);
        }
        // The images in the folder of a scan are no slices.
        if scan::find(path).is_ok() {
            let expected = "a volume: a file, or a folder of DICOM or TIFF slices";
            return Err(Error::invalid(path.display().to_string(), "volume", "the folder of a scan", expected));
        }
        return Ok(if tiff::is_stack(path) { VolumeFile::Slices } else { VolumeFile::Series });
    }
    let mut input = Input::open(path)?;
    let mut head = input.take(8)?;
    if head.starts_with(npy::MAGIC) {
        return Ok(VolumeFile::Npy(input, head));
    }
    head.extend(input.take(nifti::HEADER - head.len())?);
    if nifti::is_second_version(&head) {
        let what = format!("{}: a NIfTI-2 file", path.display());
        return Err(Error::unsupported(what, "convert it to NIfTI-1 (.nii or .nii.gz)"));
    }
    if dicom::is_header(&head) {
        if dicom::enhanced::has_frames(path)? {
            return Ok(VolumeFile::Enhanced);
        }
        let what = format!("{}: one DICOM file", path.display());
        return Err(Error::unsupported(what, "give the folder that holds the files of its series"));
    }
    let found = [
        (metaimage::is_header(&head), VolumeFile::MetaImage, "a MetaImage"),
        (nrrd::is_header(&head), VolumeFile::Nrrd, "a NRRD"),
        (tiff::is_tiff(&head), VolumeFile::Tiff, "a TIFF file"),
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
        let hint = match format_of(path) {
            Some(VolumeFormat::Npy) => "a NumPy array (93 4e 55 4d 50 59 at the start); a NIfTI-1 header is read too",
            _ => {
                "a NIfTI-1 header (6e 2b 31 00 at byte 344), a NumPy array (93 4e 55 4d 50 59 at the start), a \
                 MetaImage header (NDims = 3), NRRD (4e 52 52 44 at the start) or TIFF (49 49 2a 00 or 4d 4d 00 2a)"
            }
        };
        return Err(input.invalid("format", mark, hint));
    }
    Ok(VolumeFile::Nifti(input, head))
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

/// Refuses a name or a number of voxels that [`write_voxels`] would refuse, before the voxels are computed.
pub fn check_shape(path: impl AsRef<Path>, shape: [usize; 3]) -> Result<()> {
    let path = path.as_ref();
    match wanted(path)? {
        VolumeFormat::Nifti | VolumeFormat::NiftiGz => nifti::check_shape(&path.display().to_string(), shape),
        VolumeFormat::Tiff => tiff::check_shape(&path.display().to_string(), shape),
        VolumeFormat::Dicom => dicom::check_shape(&path.display().to_string(), shape),
        VolumeFormat::EnhancedDicom => dicom::enhanced::check_one_file(&path.display().to_string(), shape),
        _ => Ok(()),
    }
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
    if volume.data.shape() != volume.grid.shape {
        let (found, expected) = (format!("{:?}", volume.data.shape()), format!("{:?}", volume.grid.shape));
        return Err(Error::invalid(path.display().to_string(), "shape of the data", found, expected));
    }
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
    if template.is_some() && !matches!(format, VolumeFormat::Dicom | VolumeFormat::EnhancedDicom) {
        let expected = "an end of .dicom or .dcm: other formats have no patient and study for the template";
        return Err(Error::invalid(path.display().to_string(), "file name", file_name(path), expected));
    }
    voxels.grid().validate(&path.display().to_string())?;
    let layers = &mut Layers::new(voxels, allowance::room());
    let write: fn(&mut dyn Write, &Path, &mut dyn Voxels) -> Result<()> = match format {
        // Its chunks come in an order of their own.
        VolumeFormat::Zarr => return zarr::write(path, layers.voxels),
        VolumeFormat::Dicom => return dicom::write(path, layers, template),
        VolumeFormat::EnhancedDicom => return dicom::enhanced::write(path, layers, template),
        VolumeFormat::MetaImageHeader => return metaimage::write_raw(path, layers),
        VolumeFormat::Nifti => nifti::write,
        VolumeFormat::NiftiGz => nifti::write_packed,
        VolumeFormat::Npy => npy::write_voxels,
        VolumeFormat::Nrrd => nrrd::write,
        VolumeFormat::Tiff => tiff::write,
        VolumeFormat::MetaImage => metaimage::write,
    };
    write_atomic(path, |w| write(w, path, layers))
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

    fn fill(&mut self, part: &Part, mut out: ArrayViewMut3<'_, f32>) -> Result<()> {
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
        out.assign(&self.held.slice(s![x, y, z.start - self.first..z.end - self.first]));
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
pub(crate) fn from_numpy(path: &Path, array: ndarray::ArrayD<f32>) -> Result<Volume> {
    let data: Array3<f32> = array
        .into_dimensionality::<Ix3>()
        .map_err(|e| Error::invalid(path.display().to_string(), "shape", e, "three axes (x, y, z)"))?;
    let s = data.shape();
    let grid = VoxelGrid { shape: [s[0], s[1], s[2]], spacing: [1.0; 3], center: [0.0; 3] };
    Ok(Volume { data, grid, affine: None })
}

/// The format for a file name; refuses an unknown extension.
fn wanted(path: &Path) -> Result<VolumeFormat> {
    let (place, expected) =
        (path.display().to_string(), "an end of .nii, .nii.gz, .mha, .mhd, .nrrd, .npy, .tif, .zarr, .dicom or .dcm");
    format_of(path).ok_or_else(|| Error::invalid(place, "file name", file_name(path), expected))
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum VolumeFormat {
    Nifti,
    NiftiGz,
    Npy,
    MetaImage,
    /// With the voxels in another file.
    MetaImageHeader,
    Nrrd,
    Tiff,
    Zarr,
    /// A folder.
    Dicom,
    /// One file.
    EnhancedDicom,
}

fn file_name(path: &Path) -> String {
    path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

fn format_of(path: &Path) -> Option<VolumeFormat> {
    let name = file_name(path).to_ascii_lowercase();
    let ends = [
        (".nii.gz", VolumeFormat::NiftiGz),
        (".nii", VolumeFormat::Nifti),
        (".npy", VolumeFormat::Npy),
        (".mha", VolumeFormat::MetaImage),
        (".mhd", VolumeFormat::MetaImageHeader),
        (".nrrd", VolumeFormat::Nrrd),
        (".tif", VolumeFormat::Tiff),
        (".tiff", VolumeFormat::Tiff),
        (".zarr", VolumeFormat::Zarr),
        (".dicom", VolumeFormat::Dicom),
        (".dcm", VolumeFormat::EnhancedDicom),
    ];
    ends.into_iter().find(|(end, _)| name.ends_with(end)).map(|(_, format)| format)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::number::Number;
    use crate::testing::{comes_back_to_the_bit, says};
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
        comes_back_to_the_bit("a.zarr", data((70, 5, 66)));
        for name in ["a.mha", "a.mhd", "a.nrrd", "a.tif"] {
            comes_back_to_the_bit(name, data((4, 3, 2)));
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
