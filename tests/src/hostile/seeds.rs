//! Small valid inputs, one function a format, written with the project's own writers where it has one.

use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
use conefield_core::scan::{Scan, Unit, Volume};
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::{GzEncoder, ZlibEncoder};
use ndarray::Array3;
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fs::{self, File};
use std::io::{Cursor, Read, Write};
use std::path::Path;
use tiff::encoder::{Compression as TiffCompression, TiffEncoder, colortype::Gray16};

pub use super::dicom::{dicom, dicom_implicit, dicom_jpeg_2000, dicom_jpeg_ls, dicom_of_zeros, dicom_run_length};

/// Views, rows and columns of every scan here.
pub const SHAPE: [usize; 3] = [3, 4, 5];

/// A volume of 4 × 3 × 2 voxels.
pub fn volume() -> Volume {
    let data = Array3::from_shape_fn((4, 3, 2), |(x, y, z)| (x + 10 * y + 100 * z) as f32 / 200.0);
    Volume::centered(data, [0.5, 0.75, 2.0])
}

/// Three views on a circle, with an offset detector.
pub fn scan() -> Scan {
    let mm = Millimetres;
    let view = |i: usize| {
        let angle = Radians(0.3 + i as f64 * TAU / SHAPE[0] as f64);
        View::circular(angle, mm(500.0), mm(800.0), [mm(2.0), mm(1.5)], [mm(-1.0), mm(3.0)])
    };
    Scan {
        geometry: Geometry {
            detector: [SHAPE[1], SHAPE[2]],
            views: (0..SHAPE[0]).map(view).collect(),
            volume: VoxelGrid { shape: [4, 3, 2], spacing: [0.5, 0.75, 2.0], center: [0.0; 3] },
        },
        projections: Array3::from_shape_fn(SHAPE, |(a, v, u)| (a + v * u) as f32 / 20.0),
        unit: Unit::default(),
        provenance: serde_json::json!({ "from": "a test", "noise": { "photons": 10000 } }),
    }
}

fn put(path: &Path, bytes: &[u8]) {
    fs::write(path, bytes).expect("a file of the test's own folder");
}

fn written(result: conefield_core::Result<()>) {
    result.expect("a valid input is written");
}

/// The lines of a MetaImage of 4 × 3 × 2 bytes, whose last says where they are.
pub fn metaimage_lines(data: &str) -> String {
    format!(
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = False\n\
         TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = -1 0 2.5\nElementSpacing = 0.5 0.75 2\nDimSize = 4 3 2\n\
         ElementType = MET_UCHAR\nElementDataFile = {data}\n"
    )
}

/// `a.mhd` and `a.raw`.
pub fn metaimage_header(dir: &Path) {
    put(&dir.join("a.mhd"), metaimage_lines("a.raw").as_bytes());
    put(&dir.join("a.raw"), &[7; 24]);
}

/// `a.nhdr` and `a.raw`.
pub fn nrrd_header(dir: &Path) {
    let text = "NRRD0005\ntype: unsigned char\ndimension: 3\nspace: left-posterior-superior\nsizes: 4 3 2\n\
                space directions: (0.5,0,0) (0,0.75,0) (0,0,2)\nkinds: domain domain domain\n\
                space units: \"mm\" \"mm\" \"mm\"\nencoding: raw\nspace origin: (-1,0,2.5)\nline skip: 0\n\
                byte skip: -1\nnote:=a test\ndata file: a.raw\n";
    put(&dir.join("a.nhdr"), text.as_bytes());
    put(&dir.join("a.raw"), &[7; 24]);
}

/// The folder `a.zarr`: one level in two chunks, which are smaller than those of the project's own writer.
pub fn zarr(dir: &Path) {
    let folder = dir.join("a.zarr");
    written(conefield_io::write_volume(&folder, &volume()));
    let array = folder.join("0/.zarray");
    let text = fs::read_to_string(&array).expect("what was written");
    let mut value: serde_json::Value = serde_json::from_str(&text).expect("what was written");
    value["chunks"] = serde_json::json!([1, 3, 4]);
    put(&array, value.to_string().as_bytes());
    for slice in 0..2 {
        fs::create_dir_all(folder.join(format!("0/{slice}/0"))).expect("a folder of the test's own");
        put(&folder.join(format!("0/{slice}/0/0")), &zlib(&[7; 48]));
    }
}

/// A description of a scanner with `geometry` and counts in `file`.
pub fn scanner_toml(file: &str, geometry: &str) -> String {
    format!(
        "format = \"conefield-scanner\"\nversion = 1\n\n[files]\nprojections = \"{file}\"\n\n{geometry}\n\
         [values]\nkind = \"counts\"\ni0 = 20000.0\n\n\
         [volume]\nshape = [4, 3, 2]\nspacing = [0.5, 0.75, 2.0]\ncenter = [0.0, 0.0, 0.0]\n"
    )
}

/// The table of a circular scan.
pub const CIRCLE: &str = "[circle]\ndso = 500.0\ndsd = 800.0\npixel = { u = 2.0, v = 2.0 }\n\
    offset = { u = 0.5, v = 0.0 }\nstart_deg = 10.0\nrange_deg = 360.0\ndirection = \"counterclockwise\"\n";

/// ASTRA's vectors for three views.
pub const VECTORS: &str = "[vectors]\ncone_vec = [\n  [500, 0, 0, -300, 0, 0, 0, 2, 0, 0, 0, -2],\n  \
    [0, 500, 0, 0, -300, 0, -2, 0, 0, 0, 0, -2],\n  [-500, 0, 0, 300, 0, 0, 0, -2, 0, 0, 0, -2],\n]\n";

/// The table that names RTK's file.
pub const RTK: &str = "[rtk]\nfile = \"geometry.xml\"\npixel = { u = 2.0, v = 2.0 }\n";

/// The table that names CIL's file.
pub const CIL: &str = "[cil]\nfile = \"counts.h5\"\n";

/// `scanner.toml` with `geometry` and counts in `counts`: the name of a file, or of an array in one.
fn described(dir: &Path, counts: &str, geometry: &str) {
    put(&dir.join("scanner.toml"), scanner_toml(counts, geometry).as_bytes());
}

/// `scanner.toml` with this text, and `file` with these bytes.
fn stored(dir: &Path, file: &str, bytes: &[u8], scanner: &str) {
    put(&dir.join(file), bytes);
    put(&dir.join("scanner.toml"), scanner.as_bytes());
}

/// The same with a circle and counts in `counts`.
fn circle(dir: &Path, file: &str, bytes: &[u8], counts: &str) {
    stored(dir, file, bytes, &scanner_toml(counts, CIRCLE));
}

fn counts() -> Vec<u16> {
    (0..SHAPE.iter().product::<usize>()).map(|i| 9000 + 97 * i as u16).collect()
}

/// A `.npy` file of `descr` with the header's shape as text.
pub fn npy_bytes(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let mut header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}");
    header.push_str(&" ".repeat((header.len() + 11).next_multiple_of(64) - header.len() - 11));
    header.push('\n');
    let length = (header.len() as u16).to_le_bytes();
    [b"\x93NUMPY\x01\x00", &length[..], header.as_bytes(), data].concat()
}

fn counts_npy() -> Vec<u8> {
    let raw: Vec<u8> = counts().iter().flat_map(|x| x.to_le_bytes()).collect();
    npy_bytes("<u2", "(3, 4, 5)", &raw)
}

/// `scanner.toml` with ASTRA's vectors, `counts.npy`.
pub fn scanner_vectors(dir: &Path) {
    scanner_npy(dir);
    described(dir, "counts.npy", VECTORS);
}

/// `scanner.toml`, `geometry.xml` of RTK, `counts.npy`.
pub fn scanner_rtk(dir: &Path) {
    scanner_npy(dir);
    described(dir, "counts.npy", RTK);
    let folder = dir.join("rtk");
    conefield_io::write_rtk(&folder, &scan()).expect("a circle is written");
    fs::rename(folder.join("geometry.xml"), dir.join("geometry.xml")).expect("what was written");
    fs::remove_dir_all(folder).expect("what was written");
}

/// `scanner.toml`, `counts.npz`.
pub fn scanner_npz(dir: &Path) {
    let mut w = zip::ZipWriter::new(File::create(dir.join("counts.npz")).expect("a file of the test's own folder"));
    let options = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
    w.start_file("counts.npy", options).expect("an archive that can be written");
    w.write_all(&counts_npy()).expect("an archive that can be written");
    w.finish().expect("an archive that can be written");
    described(dir, "counts.npz:counts", CIRCLE);
}

/// A TIFF of the counts, a page a view.
pub fn tiff_bytes(packing: TiffCompression) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let mut w = TiffEncoder::new(&mut file).expect("memory").with_compression(packing);
    for view in counts().chunks(SHAPE[1] * SHAPE[2]) {
        w.write_image::<Gray16>(SHAPE[2] as u32, SHAPE[1] as u32, view).expect("memory");
    }
    file.into_inner()
}

/// `scanner.toml`, `counts.tif` packed by deflate: three pages of `side` rows and columns of zeros.
pub fn scanner_tiff_of_zeros(dir: &Path, side: u32) {
    let file = File::create(dir.join("counts.tif")).expect("a file of the test's own folder");
    let packing = TiffCompression::Deflate(Default::default());
    let mut w = TiffEncoder::new(file).expect("a file").with_compression(packing);
    for _ in 0..SHAPE[0] {
        w.write_image::<Gray16>(side, side, &vec![0; (side * side) as usize]).expect("a file");
    }
    described(dir, "counts.tif", CIRCLE);
}

/// A file of the reader's own fixtures, which other programs' libraries wrote.
macro_rules! fixture {
    ($name:literal) => {
        include_bytes!(concat!("../../../io/tests/fixtures/", $name))
    };
}
pub(super) use fixture;

/// A description whose counts, fields and angles are in `counts.h5`.
fn scanner_of_hdf5() -> String {
    let circle = CIRCLE.replace("range_deg = 360.0", "angles_deg = \"counts.h5\"");
    let files = "projections = \"counts.h5\"\nflat = \"counts.h5\"\ndark = \"counts.h5\"";
    scanner_toml("counts.h5", &circle).replace("projections = \"counts.h5\"", files).replace("i0 = 20000.0\n", "")
}

/// A TIFF of each view's counts.
fn images(dir: &Path, name: impl Fn(usize) -> String) {
    for (i, view) in counts().chunks(SHAPE[1] * SHAPE[2]).enumerate() {
        let file = File::create(dir.join(name(i))).expect("a file of the test's own folder");
        let mut w = TiffEncoder::new(file).expect("a file");
        w.write_image::<Gray16>(SHAPE[2] as u32, SHAPE[1] as u32, view).expect("a file");
    }
}

/// `bone.xtekct` of Nikon, with its images.
pub fn xtekct(dir: &Path) {
    images(dir, |i| format!("bone_{:04}.tif", i + 1));
    let text = "[XTekCT]\nName=bone\nVoxelsX=4\nVoxelSizeX=0.5\nVoxelsY=4\nVoxelSizeY=0.5\nVoxelsZ=3\nVoxelSizeZ=0.75\n\
                InputSeparator=_\nInputFolderName=\nInputDigits=4\nProjections=3\nWhiteLevel=50000\nDetectorPixelsX=5\n\
                DetectorPixelSizeX=2\nDetectorPixelsY=4\nDetectorPixelSizeY=1.5\nSrcToObject=500\nSrcToDetector=800\n\
                InitialAngle=30\nAngularStep=120\nObjectOffsetX=0.5\nObjectRoll=0.1\nObjectTilt=0.2\n";
    put(&dir.join("bone.xtekct"), text.as_bytes());
}

/// `bone.log` of SkyScan, with its images.
pub fn skyscan(dir: &Path) {
    images(dir, |i| format!("bone{i:08}.tif"));
    let text = "[System]\nScanner=SkyScan1172\n[Acquisition]\nFilename Prefix=bone\nNumber of Files= 3\nNumber of Rows= 4\n\
                Number of Columns= 5\nImage Pixel Size (um)=   10.5\nObject to Source (mm)=50.5\n\
                Camera to Source (mm)=200.25\nOptical Axis (line)= 1\nReference Intensity=60000\n\
                Rotation Step (deg)=120.0\nRotation Direction=CW\n[Reconstruction]\nPostalignment=1.50\n";
    put(&dir.join("bone.log"), text.as_bytes());
}

/// `Scan.xml` of Varian, with an image and an open beam.
pub fn xim(dir: &Path) {
    let air = dir.join("Calibrations/Air-1");
    fs::create_dir_all(&air).expect("a folder of the test's own");
    put(&dir.join("Proj_1.xim"), fixture!("a.xim"));
    put(&air.join("Filter.xim"), fixture!("a.xim"));
    let text = "<?xml version=\"1.0\"?>\n<Scan Version=\"2.7\"><Acquisitions><SAD>1000</SAD><SID>1500</SID></Acquisitions></Scan>";
    put(&dir.join("Scan.xml"), text.as_bytes());
}

/// `ProjectionInfo.xml` of Varian, with an image.
pub fn obi(dir: &Path) {
    put(&dir.join("a.hnd"), fixture!("a.hnd"));
    let text = "<?xml version=\"1.0\"?>\n<Info><CalibratedSAD>1000</CalibratedSAD><CalibratedSID>1500</CalibratedSID>\
                <FanType>HalfFan</FanType><CalibratedDetectorOffsetX>1</CalibratedDetectorOffsetX>\
                <CalibratedDetectorOffsetY>2</CalibratedDetectorOffsetY><DetectorPosLat>-148</DetectorPosLat></Info>";
    put(&dir.join("ProjectionInfo.xml"), text.as_bytes());
}

/// `_Frames.xml` of Elekta, with an image.
pub fn elekta(dir: &Path) {
    put(&dir.join("00001.his"), fixture!("a.his"));
    let text = "<?xml version=\"1.0\"?>\n<ProjectionSet><Frames><Frame><GantryAngle>-90.5</GantryAngle>\
                <UCentre>115</UCentre><VCentre>-1.5</VCentre></Frame></Frames></ProjectionSet>";
    put(&dir.join("_Frames.xml"), text.as_bytes());
}

/// The folder `scan` with `scan.json`.
pub fn scan_json(dir: &Path) {
    scan_toml(dir);
    let file = dir.join("scan/scan.toml");
    let text = fs::read_to_string(&file).expect("what was written");
    let value: serde_json::Value = toml::from_str(&text).expect("what was written");
    fs::remove_file(file).expect("what was written");
    put(&dir.join("scan/scan.json"), value.to_string().as_bytes());
}

const TENSORS: [conefield_io::Tensor<'static>; 2] =
    [("encoder.table", &[4], &[0.5, -1.0, 2.0, 0.0]), ("field.0.weight", &[2, 3], &[1.0, -2.0, 3.5, 0.0, 1e-38, 7.0])];

/// `w.safetensors`.
pub fn weights(dir: &Path) {
    let text = BTreeMap::from([("made by".to_owned(), "a test".to_owned())]);
    written(conefield_io::write_weights(&dir.join("w.safetensors"), &TENSORS, &text));
}

/// `c.safetensors`.
pub fn checkpoint(dir: &Path) {
    let text = BTreeMap::from([("standing".to_owned(), "{}".to_owned())]);
    written(conefield_io::write_checkpoint(&dir.join("c.safetensors"), &TENSORS, &text));
}

/// `spec.toml`: the shipped `naf`.
pub fn spec_toml(dir: &Path) {
    let naf = include_str!("../../../conefield/specs/naf.toml");
    put(&dir.join("spec.toml"), naf.as_bytes());
}

/// `spec.json`: the same.
pub fn spec_json(dir: &Path) {
    let value: serde_json::Value =
        toml::from_str(include_str!("../../../conefield/specs/naf.toml")).expect("a shipped spec");
    put(&dir.join("spec.json"), value.to_string().as_bytes());
}

/// Defines seeds that take one call.
macro_rules! seeds {
    ($($(#[$about:meta])* $name:ident: |$dir:ident| $work:expr;)*) => {
        $(
            $(#[$about])*
            pub fn $name($dir: &Path) {
                $work;
            }
        )*
    };
}

seeds! {
    /// `a.nii`.
    nifti: |dir| written(conefield_io::write_volume(dir.join("a.nii"), &volume()));
    /// `a.nii.gz`.
    nifti_gz: |dir| written(conefield_io::write_volume(dir.join("a.nii.gz"), &volume()));
    /// `a.npy`, a volume.
    npy: |dir| written(conefield_io::write_volume(dir.join("a.npy"), &volume()));
    /// `a.mha`, packed.
    metaimage: |dir| written(conefield_io::write_volume(dir.join("a.mha"), &volume()));
    /// `a.nrrd`, packed.
    nrrd: |dir| written(conefield_io::write_volume(dir.join("a.nrrd"), &volume()));
    /// `a.tif`, a volume.
    tiff_volume: |dir| written(conefield_io::write_volume(dir.join("a.tif"), &volume()));
    /// `scanner.toml` with a circle, `counts.npy`.
    scanner_npy: |dir| circle(dir, "counts.npy", &counts_npy(), "counts.npy");
    /// `scanner.toml`, `counts.tif`.
    scanner_tiff: |dir| circle(dir, "counts.tif", &tiff_bytes(TiffCompression::Uncompressed), "counts.tif");
    /// `scanner.toml`, `counts.tif` packed by deflate.
    scanner_tiff_deflate: |dir|
        circle(dir, "counts.tif", &tiff_bytes(TiffCompression::Deflate(Default::default())), "counts.tif");
    /// `scanner.toml`, `counts.tif` packed by LZW.
    scanner_tiff_lzw: |dir| circle(dir, "counts.tif", &tiff_bytes(TiffCompression::Lzw), "counts.tif");
    /// `scanner.toml`, `counts.mat` with a variable.
    scanner_mat: |dir| circle(dir, "counts.mat", fixture!("counts_plain.mat"), "counts.mat:counts");
    /// `scanner.toml`, `counts.mat` with a field of a packed struct.
    scanner_mat_packed: |dir| circle(dir, "counts.mat", fixture!("counts.mat"), "counts.mat:scan.counts");
    /// `scanner.toml`, `counts.tif` packed by Zstandard.
    scanner_tiff_zstd: |dir| circle(dir, "counts.tif", fixture!("zstd.tif"), "counts.tif");
    /// `scanner.toml`, `counts.h5` in the layout of DXchange.
    scanner_hdf5: |dir| stored(dir, "counts.h5", fixture!("dxchange.h5"), &scanner_of_hdf5());
    /// `scanner.toml`, `counts.h5` in the layout of NXtomo, as HDF5 wrote it at first.
    scanner_nxtomo: |dir| stored(dir, "counts.h5", fixture!("nxtomo.nxs"), &scanner_of_hdf5());
    /// `scanner.toml`, `counts.h5` with geometry, as CIL writes it.
    scanner_cil: |dir| stored(dir, "counts.h5", fixture!("cil.nxs"), &scanner_toml("counts.h5", CIL));
    /// `a.txrm` of Zeiss.
    txrm: |dir| put(&dir.join("a.txrm"), fixture!("a.txrm"));
    /// `scan.pickle`, with the volume.
    naf: |dir| written(conefield_io::write_naf(dir.join("scan.pickle"), &scan(), None, Some(&volume())));
    /// The folder `r2`, with the volume.
    r2: |dir| written(conefield_io::write_r2(dir.join("r2"), &scan(), None, Some(&volume())));
    /// The folder `scan` with `scan.toml`, `projections.npy` and `truth.nii.gz`.
    scan_toml: |dir| written(conefield_io::write_scan(dir.join("scan"), &scan(), Some(&volume())));
}

/// In gzip.
pub fn gzip(bytes: Vec<u8>) -> Vec<u8> {
    let mut w = GzEncoder::new(Vec::new(), Compression::fast());
    w.write_all(&bytes).and_then(|()| w.finish()).expect("memory")
}

/// Out of gzip.
pub fn gunzip(bytes: Vec<u8>) -> Vec<u8> {
    let mut out = Vec::new();
    GzDecoder::new(&bytes[..]).read_to_end(&mut out).expect("what was packed here");
    out
}

/// As a zlib stream.
pub fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut w = ZlibEncoder::new(Vec::new(), Compression::best());
    w.write_all(bytes).and_then(|()| w.finish()).expect("memory")
}
