//! Exchanges volumes with SimpleITK, pydicom and nibabel.
//!
//! `CONEFIELD_PYTHON` names the interpreter; the default is `python3`. Tests are skipped with a note if a module is
//! missing.

use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::Volume;
use conefield_io::{read_volume, write_volume};
use ndarray::Array3;
use std::path::Path;
use std::process::Command;

/// The interpreter, or `None` with a note if it lacks one of `modules`.
fn python(modules: &[&str]) -> Option<String> {
    let name = std::env::var("CONEFIELD_PYTHON").unwrap_or_else(|_| "python3".into());
    let import = format!("import {}", modules.join(", "));
    let found = Command::new(&name).args(["-c", &import]).output();
    if found.is_ok_and(|o| o.status.success()) {
        return Some(name);
    }
    eprintln!("skipped: {name} has no {}; CONEFIELD_PYTHON names one that has", modules.join(" and "));
    None
}

/// Runs `script` in `folder` and returns its output.
fn run(python: &str, folder: &Path, script: &str) -> String {
    let out = Command::new(python).args(["-c", script]).current_dir(folder).output().unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

fn numbers(text: &str) -> Vec<f64> {
    text.split_whitespace().map(|t| t.parse().unwrap()).collect()
}

/// 4×3×2 voxels, rotated about two axes, off the origin.
fn turned() -> Volume {
    let (s, c) = 0.3f64.sin_cos();
    let affine = [
        [0.5 * c, -0.75 * s * c, 2.0 * s * s, -12.5],
        [0.5 * s, 0.75 * c * c, -2.0 * s * c, 34.25],
        [0.0, 0.75 * s, 2.0 * c, 5.0],
        [0.0, 0.0, 0.0, 1.0],
    ];
    let grid = VoxelGrid { shape: [4, 3, 2], spacing: [0.5, 0.75, 2.0], center: [0.0; 3] };
    let data = Array3::from_shape_fn((4, 3, 2), |(x, y, z)| x as f32 + 10.0 * y as f32 - 100.5 * z as f32);
    Volume { data, grid, affine: Some(affine) }
}

fn assert_affine(found: &[f64], volume: &Volume, tolerance: f64, what: &str) {
    let want = volume.affine.unwrap();
    assert_eq!(found.len(), 16, "{what}: {found:?}");
    for (f, w) in found.iter().zip(want.iter().flatten()) {
        assert!((f - w).abs() <= tolerance, "{what}: {found:?}, not {want:?}");
    }
}

fn assert_same(found: &Volume, want: &Volume, tolerance: f64, what: &str) {
    assert_eq!(found.data, want.data, "{what}");
    for (f, w) in found.grid.spacing.iter().zip(want.grid.spacing) {
        assert!((f - w).abs() <= tolerance, "{what}: {:?}", found.grid.spacing);
    }
    assert_affine(&found.affine.unwrap().concat(), want, tolerance, what);
}

/// Prints the affine in RAS, then the voxels, x fastest, of an ITK image.
const SHOW: &str = "
import SimpleITK as sitk, numpy as np
def show(image):
    d = np.array(image.GetDirection()).reshape(3, 3) * np.array(image.GetSpacing())
    a = np.vstack([np.column_stack([d, image.GetOrigin()]), [0, 0, 0, 1]])
    a[:2] *= -1
    print(*[float(x) for x in a.ravel()], *[float(x) for x in sitk.GetArrayFromImage(image).ravel()])
";

/// The output of [`SHOW`] for `volume`.
fn assert_shown(text: &str, volume: &Volume, tolerance: f64, what: &str) {
    let found = numbers(text);
    assert_affine(&found[..16], volume, tolerance, what);
    let values: Vec<f64> = volume.data.t().iter().map(|x| f64::from(*x)).collect();
    assert_eq!(found[16..], values, "{what}");
}

#[test]
fn simple_itk_reads_what_is_written() {
    let Some(python) = python(&["SimpleITK", "numpy"]) else { return };
    let dir = tempfile::tempdir().unwrap();
    let v = turned();
    for (name, tolerance) in [("a.mha", 1e-12), ("a.nii.gz", 1e-5), ("a.nrrd", 1e-12)] {
        write_volume(dir.path().join(name), &v).unwrap();
        let text = run(&python, dir.path(), &format!("{SHOW}\nshow(sitk.ReadImage('{name}'))"));
        assert_shown(&text, &v, tolerance, name);
    }
}

#[test]
fn what_simple_itk_writes_is_read() {
    let Some(python) = python(&["SimpleITK", "numpy"]) else { return };
    let dir = tempfile::tempdir().unwrap();
    let v = turned();
    write_volume(dir.path().join("a.mha"), &v).unwrap();
    let script = "
import SimpleITK as sitk
a = sitk.ReadImage('a.mha')
for end in ['mha', 'mhd', 'nii', 'nii.gz', 'nrrd', 'nhdr']:
    for packed in [False, True]:
        sitk.WriteImage(a, f'{int(packed)}.{end}', packed)
for name in ['Int8', 'UInt8', 'Int16', 'UInt16', 'Int32', 'UInt32', 'Int64', 'UInt64', 'Float64']:
    b = sitk.Cast(sitk.Abs(a) / 2, getattr(sitk, 'sitk' + name))
    sitk.WriteImage(b, name + '.mha', True)
    sitk.WriteImage(b, name + '.nii')
    sitk.WriteImage(sitk.Cast(b, sitk.sitkFloat32), name + '_want.mha')
";
    run(&python, dir.path(), script);
    for packed in 0..2 {
        for end in ["mha", "mhd", "nii", "nii.gz", "nrrd", "nhdr"] {
            let name = format!("{packed}.{end}");
            assert_same(&read_volume(dir.path().join(&name)).unwrap(), &v, 1e-5, &name);
        }
    }
    for kind in ["Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Float64"] {
        let want = read_volume(dir.path().join(format!("{kind}_want.mha"))).unwrap();
        for end in ["mha", "nii"] {
            let name = format!("{kind}.{end}");
            assert_same(&read_volume(dir.path().join(&name)).unwrap(), &want, 1e-5, &name);
        }
    }
}

#[test]
fn nibabel_agrees_on_nifti() {
    let Some(python) = python(&["nibabel", "numpy"]) else { return };
    let dir = tempfile::tempdir().unwrap();
    let v = turned();
    write_volume(dir.path().join("a.nii.gz"), &v).unwrap();
    let script = "
import nibabel as nib, numpy as np
def show(n):
    print(*[float(x) for x in n.affine.ravel()], *[float(x) for x in n.get_fdata(dtype=np.float32).ravel(order='F')])
a = nib.load('a.nii.gz')
show(a)
for kind in ['u1', 'i1', 'u2', 'i2', 'u4', 'i4', 'u8', 'i8', 'f4', 'f8']:
    for order in '<>':
        for form in 'qs':
            header = nib.Nifti1Header(endianness=order)
            header.set_data_dtype(np.dtype(order + kind))
            stored = np.arange(24).reshape(4, 3, 2).astype(order + kind)
            n = nib.Nifti1Image(stored, None, header)
            n.header.set_xyzt_units('mm')
            (n.set_qform if form == 'q' else n.set_sform)(a.affine, 1)
            n.header.set_slope_inter(0.25, -3)
            # As they are: the writer must not rescale them.
            with open(f'{kind}{\"le\" if order == \"<\" else \"be\"}{form}.nii', 'wb') as f:
                n.header['magic'] = b'n+1'
                n.header['vox_offset'] = 352
                f.write(n.header.binaryblock + bytes(4) + stored.tobytes(order='F'))
            show(nib.load(f.name))
";
    let text = run(&python, dir.path(), script);
    let mut lines = text.lines();
    assert_shown(lines.next().unwrap(), &v, 1e-5, "a.nii.gz");
    for kind in ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"] {
        for order in ["le", "be"] {
            for form in ["q", "s"] {
                let name = format!("{kind}{order}{form}.nii");
                let found = read_volume(dir.path().join(&name)).unwrap();
                assert_shown(lines.next().unwrap(), &found, 1e-5, &name);
                assert_eq!(found.data[[3, 2, 1]], 23.0 * 0.25 - 3.0, "{name}");
            }
        }
    }
    assert_eq!(lines.next(), None);
}

#[test]
fn simple_itk_agrees_on_a_dicom_series() {
    let Some(python) = python(&["SimpleITK", "numpy"]) else { return };
    let dir = tempfile::tempdir().unwrap();
    let v = turned();
    write_volume(dir.path().join("a.mha"), &v).unwrap();
    let script = format!(
        "{SHOW}
import os
big = sitk.Resample(sitk.ReadImage('a.mha'), [40, 30, 6], sitk.Transform(), sitk.sitkLinear, sitk.ReadImage('a.mha').GetOrigin(),
                    [0.05, 0.07, 0.3], sitk.ReadImage('a.mha').GetDirection())
a = sitk.Cast(big * 7, sitk.sitkInt16)
d = a.GetDirection()
for kind in ['plain', 'JPEG']:
    os.mkdir(kind)
    w = sitk.ImageFileWriter()
    w.KeepOriginalImageUIDOn()
    if kind != 'plain':
        w.UseCompressionOn()
        w.SetCompressor(kind)
    for k in range(a.GetDepth()):
        s = a[:, :, k]
        s.SetMetaData('0008|0060', 'CT')
        s.SetMetaData('0020|000e', '1.2.3.4')
        s.SetMetaData('0028|1052', '0')
        s.SetMetaData('0028|1053', '1')
        s.SetMetaData('0008|0018', f'1.2.3.4.{{k}}')
        s.SetMetaData('0020|0037', '\\\\'.join(repr(d[i]) for i in [0, 3, 6, 1, 4, 7]))
        s.SetMetaData('0020|0032', '\\\\'.join(map(repr, a.TransformIndexToPhysicalPoint((0, 0, k)))))
        w.SetFileName(f'{{kind}}/{{9 - k}}.dcm')
        w.Execute(s)
    r = sitk.ImageSeriesReader()
    r.SetFileNames(r.GetGDCMSeriesFileNames(kind))
    show(r.Execute())
"
    );
    let text = run(&python, dir.path(), &script);
    for (kind, line) in ["plain", "JPEG"].iter().zip(text.lines()) {
        let file = std::fs::read(dir.path().join(kind).join("4.dcm")).unwrap();
        // The transfer syntax of lossless JPEG.
        assert_eq!(file.windows(22).any(|w| w == b"1.2.840.10008.1.2.4.70"), *kind == "JPEG");
        let found = read_volume(dir.path().join(kind)).unwrap();
        assert_shown(line, &found, 1e-6, kind);
        assert!(found.data.iter().any(|x| *x < 0.0) && found.data.iter().any(|x| *x > 100.0), "{kind}");
    }
}

/// A volume of more than one chunk of OME-Zarr along x.
fn long() -> Volume {
    let data = Array3::from_shape_fn((70, 5, 3), |(x, y, z)| x as f32 + 100.0 * y as f32 - 0.5 * z as f32);
    Volume::centered(data, [0.5, 0.75, 2.0])
}

/// Writes [`long`] as `name`, and compares the output of `script`: the sizes along z, y and x, then the values, x
/// fastest.
fn assert_read_by(modules: &[&str], name: &str, script: &str) {
    let Some(python) = python(modules) else { return };
    let dir = tempfile::tempdir().unwrap();
    let volume = long();
    write_volume(dir.path().join(name), &volume).unwrap();
    let found = numbers(&run(&python, dir.path(), script));
    assert_eq!(found[..3], [2.0, 0.75, 0.5], "{name}");
    assert_eq!(found[3..], volume.data.t().iter().map(|x| f64::from(*x)).collect::<Vec<_>>(), "{name}");
}

#[test]
fn stacks_nrrd_and_ome_zarr_are_read_by_tifffile_pynrrd_and_zarr() {
    let tiff = "
import tifffile
with tifffile.TiffFile('a.tif') as t:
    size = [b / a for a, b in (t.pages[0].tags[k].value for k in ('YResolution', 'XResolution'))]
    assert t.series[0].axes == 'ZYX', t.series[0].axes
    print(t.imagej_metadata['spacing'], *size, *t.asarray().ravel().tolist())
";
    assert_read_by(&["tifffile"], "a.tif", tiff);
    let nrrd = "
import nrrd, numpy as np
a, h = nrrd.read('a.nrrd')
print(*np.abs(np.diag(h['space directions']))[::-1].tolist(), *a.T.ravel().tolist())
";
    assert_read_by(&["nrrd"], "a.nrrd", nrrd);
    let zarr = "
import zarr
g = zarr.open('a.zarr', mode='r')
m = g.attrs['multiscales'][0]
assert [d['path'] for d in m['datasets']] == ['0', '1'] and g['1'].shape == (2, 3, 35)
assert g['1'][0, 0, 0] == g['0'][:2, :2, :2].mean()
print(*m['datasets'][0]['coordinateTransformations'][0]['scale'], *g['0'][:].ravel().tolist())
";
    assert_read_by(&["zarr"], "a.zarr", zarr);
}

/// Lets `script` write [`long`] from `a.npy` to `names`, and reads them.
fn assert_written_by(modules: &[&str], names: &[&str], script: &str) {
    let Some(python) = python(modules) else { return };
    let dir = tempfile::tempdir().unwrap();
    let want = long();
    write_volume(dir.path().join("a.npy"), &want).unwrap();
    run(&python, dir.path(), script);
    for name in names {
        let found = read_volume(dir.path().join(name)).unwrap();
        assert_eq!(found.data, want.data, "{name}");
        let sizes = found.grid.spacing.iter().zip(want.grid.spacing);
        assert!(sizes.into_iter().all(|(f, w)| (f - w).abs() < 1e-6), "{name}: {:?}", found.grid.spacing);
    }
}

#[test]
fn what_tifffile_pynrrd_and_zarr_write_is_read() {
    let tiff = "
import numpy as np, os, tifffile
a = np.load('a.npy').T
about = dict(imagej=True, resolution=(2, 4 / 3))
tifffile.imwrite('a.tif', a, metadata={'spacing': 2, 'unit': 'mm', 'axes': 'ZYX'}, **about)
about = dict(imagej=True, resolution=(2e-3, 4e-3 / 3))
tifffile.imwrite('um.tif', a, metadata={'spacing': 2000, 'unit': 'um', 'axes': 'ZYX'}, **about)
os.mkdir('slices')
for i, s in enumerate(a):
    tifffile.imwrite(f'slices/{i + 9}.tif', s, metadata={'spacing': 2, 'unit': 'mm'}, imagej=True, resolution=(2, 4 / 3))
";
    assert_written_by(&["tifffile", "numpy"], &["a.tif", "um.tif", "slices"], tiff);
    let nrrd = "
import nrrd, numpy as np
a = np.load('a.npy')
about = {'space': 'RAS', 'space directions': np.diag([0.5, 0.75, 2]), 'kinds': ['domain'] * 3}
for name, kind, encoding in [('gzip', '<f4', 'gzip'), ('raw', '<f4', 'raw'), ('big', '>f8', 'raw')]:
    nrrd.write(f'{name}.nrrd', a.astype(kind), {**about, 'encoding': encoding})
    nrrd.write(f'{name}.nhdr', a.astype(kind), {**about, 'encoding': encoding}, detached_header=True)
";
    let names = ["gzip.nrrd", "raw.nrrd", "big.nrrd", "gzip.nhdr", "raw.nhdr", "big.nhdr"];
    assert_written_by(&["nrrd", "numpy"], &names, nrrd);
    let zarr = "
import numpy as np, zarr, numcodecs
a = np.load('a.npy').T
axes = [{'name': n, 'type': 'space', 'unit': 'micrometer'} for n in 'zyx']
level = {'path': '0', 'coordinateTransformations': [{'type': 'scale', 'scale': [2000, 750, 500]}]}
for name, codec in [('zlib', numcodecs.Zlib()), ('gzip', numcodecs.GZip()), ('none', None)]:
    for separator in './':
        g = zarr.open_group(f'{name}{ord(separator)}.zarr', mode='w')
        g.attrs['multiscales'] = [{'version': '0.4', 'axes': axes, 'datasets': [level]}]
        g.create_dataset('0', data=a, chunks=(2, 3, 33), compressor=codec, dimension_separator=separator, write_empty_chunks=True)
";
    let names = ["zlib46.zarr", "zlib47.zarr", "gzip46.zarr", "gzip47.zarr", "none46.zarr", "none47.zarr"];
    assert_written_by(&["zarr", "numcodecs", "numpy"], &names, zarr);
}

#[test]
fn simple_itk_and_pydicom_read_a_written_series_and_one_file() {
    let Some(python) = python(&["SimpleITK", "numpy", "pydicom"]) else { return };
    let dir = tempfile::tempdir().unwrap();
    let v = turned();
    for name in ["a.dicom", "a.dcm"] {
        write_volume(dir.path().join(name), &v).unwrap();
    }
    let back = read_volume(dir.path().join("a.dicom")).unwrap();
    let values: Vec<f64> = back.data.t().iter().map(|x| f64::from(*x)).collect();
    let near = |found: &[f64], what: &str| {
        assert_eq!(found.len(), values.len(), "{what}");
        assert!(found.iter().zip(&values).all(|(f, w)| (f - w).abs() <= 1e-5), "{what}: {found:?}");
    };
    let script = "
reader = sitk.ImageSeriesReader()
reader.SetFileNames(reader.GetGDCMSeriesFileNames('a.dicom'))
show(reader.Execute())
show(sitk.ReadImage('a.dcm'))
";
    let text = run(&python, dir.path(), &format!("{SHOW}\n{script}"));
    for (line, name) in text.lines().zip(["a.dicom", "a.dcm"]) {
        let found = numbers(line);
        assert_affine(&found[..16], &v, 1e-9, name);
        near(&found[16..], name);
    }
    // The attributes that the CT Image IOD requires (PS3.3, A.3), and the values without ITK.
    let script = "
import pydicom, glob, numpy as np
need = '''PatientName PatientID PatientBirthDate PatientSex StudyInstanceUID StudyDate StudyTime ReferringPhysicianName StudyID
AccessionNumber Modality SeriesInstanceUID SeriesNumber PatientPosition FrameOfReferenceUID PositionReferenceIndicator
Manufacturer InstanceNumber PixelSpacing ImageOrientationPatient ImagePositionPatient SliceThickness SamplesPerPixel
PhotometricInterpretation Rows Columns BitsAllocated BitsStored HighBit PixelRepresentation PixelData ImageType
RescaleIntercept RescaleSlope RescaleType KVP AcquisitionNumber SOPClassUID SOPInstanceUID SpecificCharacterSet'''.split()
slices = [pydicom.dcmread(f) for f in sorted(glob.glob('a.dicom/*.dcm'))]
for d in slices:
    assert not [n for n in need if n not in d]
    assert d.file_meta.MediaStorageSOPInstanceUID == d.SOPInstanceUID and d.SOPInstanceUID.is_valid
for d in slices:
    print(*(d.pixel_array * float(d.RescaleSlope) + float(d.RescaleIntercept)).ravel())
d = pydicom.dcmread('a.dcm')
slope = float(d.SharedFunctionalGroupsSequence[0].PixelValueTransformationSequence[0].RescaleSlope)
print(*(d.pixel_array * slope).ravel())
";
    let found = numbers(&run(&python, dir.path(), script));
    let (series, one) = found.split_at(values.len());
    near(series, "pydicom, series");
    near(one, "pydicom, one file");
}
