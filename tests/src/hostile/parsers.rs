//! The readers, one entry a format: the one list that the mutation test and the fuzz targets share.

use super::seeds;
use conefield_backend_cpu::Cpu;
use conefield_core::Result;
use conefield_core::method::Context;
use conefield_core::spec::load;
use std::path::Path;

// Specs are checked against the stages that are linked.
use {conefield_encoders as _, conefield_fields as _, conefield_projectors as _, conefield_solvers as _};

/// A reader and an input that it takes.
pub struct Parser {
    /// What reports and fuzz targets call it.
    pub name: &'static str,
    /// Writes a valid input into an empty folder.
    pub seed: fn(&Path),
    /// The file of it that is damaged.
    pub file: &'static str,
    /// What the damaged bytes are packed in, so that damage is not seen at a checksum alone.
    pub pack: fn(Vec<u8>) -> Vec<u8>,
    /// What undoes `pack`.
    pub unpack: fn(Vec<u8>) -> Vec<u8>,
    /// Reads the input in the folder as the program does.
    pub read: fn(&Path) -> Result<()>,
}

const fn plain(name: &'static str, seed: fn(&Path), file: &'static str, read: fn(&Path) -> Result<()>) -> Parser {
    Parser { name, seed, file, pack: |b| b, unpack: |b| b, read }
}

/// Every reader.
pub const PARSERS: &[Parser] = &[
    plain("nifti", seeds::nifti, "a.nii", |d| volume(&d.join("a.nii"))),
    Parser {
        pack: seeds::gzip,
        unpack: seeds::gunzip,
        ..plain("nifti_gz", seeds::nifti_gz, "a.nii.gz", |d| volume(&d.join("a.nii.gz")))
    },
    plain("gzip", seeds::nifti_gz, "a.nii.gz", |d| volume(&d.join("a.nii.gz"))),
    plain("metaimage", seeds::metaimage, "a.mha", |d| volume(&d.join("a.mha"))),
    plain("metaimage_header", seeds::metaimage_header, "a.mhd", |d| volume(&d.join("a.mhd"))),
    plain("nrrd", seeds::nrrd, "a.nrrd", |d| volume(&d.join("a.nrrd"))),
    plain("nrrd_header", seeds::nrrd_header, "a.nhdr", |d| volume(&d.join("a.nhdr"))),
    plain("tiff_volume", seeds::tiff_volume, "a.tif", |d| volume(&d.join("a.tif"))),
    plain("zarr", seeds::zarr, "a.zarr/.zattrs", |d| volume(&d.join("a.zarr"))),
    plain("zarr_array", seeds::zarr, "a.zarr/0/.zarray", |d| volume(&d.join("a.zarr"))),
    plain("npy", seeds::npy, "a.npy", |d| volume(&d.join("a.npy"))),
    plain("dicom", seeds::dicom, "series/0.dcm", |d| volume(&d.join("series"))),
    plain("dicom_implicit", seeds::dicom_implicit, "series/0.dcm", |d| volume(&d.join("series"))),
    plain("dicom_run_length", seeds::dicom_run_length, "series/0.dcm", |d| volume(&d.join("series"))),
    plain("dicom_jpeg_ls", seeds::dicom_jpeg_ls, "series/0.dcm", |d| volume(&d.join("series"))),
    plain("dicom_jpeg_2000", seeds::dicom_jpeg_2000, "series/0.dcm", |d| volume(&d.join("series"))),
    plain("scanner_toml", seeds::scanner_npy, "scanner.toml", scanner),
    plain("astra_vectors", seeds::scanner_vectors, "scanner.toml", scanner),
    plain("rtk", seeds::scanner_rtk, "geometry.xml", scanner),
    plain("npz", seeds::scanner_npz, "counts.npz", scanner),
    plain("mat", seeds::scanner_mat, "counts.mat", scanner),
    plain("mat_packed", seeds::scanner_mat_packed, "counts.mat", scanner),
    plain("tiff", seeds::scanner_tiff, "counts.tif", scanner),
    plain("tiff_deflate", seeds::scanner_tiff_deflate, "counts.tif", scanner),
    plain("tiff_lzw", seeds::scanner_tiff_lzw, "counts.tif", scanner),
    plain("tiff_zstd", seeds::scanner_tiff_zstd, "counts.tif", scanner),
    plain("hdf5", seeds::scanner_hdf5, "counts.h5", scanner),
    plain("nxtomo", seeds::scanner_nxtomo, "counts.h5", scanner),
    plain("cil", seeds::scanner_cil, "counts.h5", scanner),
    plain("xtekct", seeds::xtekct, "bone.xtekct", |d| scan(&d.join("bone.xtekct"))),
    plain("skyscan", seeds::skyscan, "bone.log", |d| scan(&d.join("bone.log"))),
    plain("xim", seeds::xim, "Proj_1.xim", |d| scan(&d.join("Scan.xml"))),
    plain("xim_scan", seeds::xim, "Scan.xml", |d| scan(&d.join("Scan.xml"))),
    plain("hnd", seeds::obi, "a.hnd", |d| scan(&d.join("ProjectionInfo.xml"))),
    plain("obi_scan", seeds::obi, "ProjectionInfo.xml", |d| scan(&d.join("ProjectionInfo.xml"))),
    plain("his", seeds::elekta, "00001.his", |d| scan(&d.join("_Frames.xml"))),
    plain("elekta_scan", seeds::elekta, "_Frames.xml", |d| scan(&d.join("_Frames.xml"))),
    plain("txrm", seeds::txrm, "a.txrm", |d| scan(&d.join("a.txrm"))),
    plain("naf", seeds::naf, "scan.pickle", |d| scan(&d.join("scan.pickle"))),
    plain("r2", seeds::r2, "r2/meta_data.json", |d| scan(&d.join("r2"))),
    plain("scan_toml", seeds::scan_toml, "scan/scan.toml", |d| scan(&d.join("scan"))),
    plain("scan_json", seeds::scan_json, "scan/scan.json", |d| scan(&d.join("scan"))),
    plain("weights", seeds::weights, "w.safetensors", |d| {
        conefield_io::read_weights(d.join("w.safetensors")).map(drop)
    }),
    plain("checkpoint", seeds::checkpoint, "c.safetensors", |d| {
        conefield_io::read_checkpoint(d.join("c.safetensors")).map(drop)
    }),
    plain("spec_toml", seeds::spec_toml, "spec.toml", |d| spec(&d.join("spec.toml"))),
    plain("spec_json", seeds::spec_json, "spec.json", |d| spec(&d.join("spec.json"))),
];

/// The reader called `name`.
pub fn find(name: &str) -> Option<&'static Parser> {
    PARSERS.iter().find(|p| p.name == name)
}

fn volume(path: &Path) -> Result<()> {
    // What `info` asks first.
    let _ = (conefield_io::is_volume(path), conefield_io::volume_voxels(path));
    conefield_io::read_volume(path).map(drop)
}

fn scan(path: &Path) -> Result<()> {
    let _ = conefield_io::scan_size(path);
    let truth = conefield_io::read_truth(path);
    let scan = conefield_scans::read_scan(path)?;
    conefield_scans::diagnosis::check_line_integrals(scan.projections.view());
    truth.map(drop)
}

fn scanner(folder: &Path) -> Result<()> {
    let _ = conefield_io::scan_size(folder.join("scanner.toml"));
    conefield_scans::import(folder.join("scanner.toml"), &Default::default()).map(drop)
}

fn spec(path: &Path) -> Result<()> {
    let loaded = load::load(&path.display().to_string(), &[], &[])?;
    loaded.spec.method.plan(&Context::new(&Cpu::new())).map_err(|e| loaded.locate(e)).map(drop)
}
