//! NIfTI, compressed or not.

use crate::case::{AMPLE, Case, End, at, changed, cut, cut_end, put, table};
use conefield_tests::hostile::seeds::{gzip, nifti, nifti_gz};
use std::fs::{self, File};
use std::path::Path;

const INFO: &str = "info a.nii";
const INFO_GZ: &str = "info a.nii.gz";

/// The header of the seed with three axes of `shape`.
fn header(dir: &Path, shape: [i16; 3]) -> Vec<u8> {
    nifti(dir);
    let mut bytes = fs::read(dir.join("a.nii")).unwrap();
    fs::remove_file(dir.join("a.nii")).unwrap();
    bytes.truncate(352);
    at(42, shape.map(i16::to_le_bytes).concat())(&mut bytes);
    bytes
}

/// The header of the seed, as bytes (type 2) of `shape`, followed by `zeros` of them, in gzip.
fn bomb(dir: &Path, shape: [i16; 3], zeros: usize) {
    let mut bytes = header(dir, shape);
    at(70, [2, 0, 8, 0])(&mut bytes);
    bytes.resize(352 + zeros, 0);
    put(dir.join("a.nii.gz"), gzip(bytes));
}

pub fn cases() -> Vec<Case> {
    table! {
        "empty file", |d| put(d.join("a.nii"), ""), "convert a.nii out.mha", ["a.nii"];
        "empty file, asked about", |d| put(d.join("a.nii"), ""), INFO, ["a.nii"];
        "cut within the header", changed(nifti, "a.nii", cut(347)), "convert a.nii out.mha", ["a.nii"];
        "cut just before the voxels", changed(nifti, "a.nii", cut(350)), INFO, ["vox_offset"];
        "one byte of voxels missing", changed(nifti, "a.nii", cut_end(1)), INFO, ["95 bytes", "96 bytes"];
        "one byte too many", changed(nifti, "a.nii", |b| b.push(0)), INFO, ["97 bytes", "96 bytes"];
        "no voxels along x", changed(nifti, "a.nii", at(42, [0, 0])), INFO, ["dim", "at least one voxel"];
        "a negative axis", changed(nifti, "a.nii", at(44, [255, 255])), INFO, ["dim", "-1"];
        "32767 voxels along each axis of a file of 448 bytes",
            changed(nifti, "a.nii", at(42, [255, 127, 255, 127, 255, 127])),
            INFO, ["96 bytes", "140724603846652 bytes"].memory(AMPLE);
        "a series of volumes", changed(nifti, "a.nii", at(40, [4, 0, 4, 0, 3, 0, 2, 0, 9, 0])),
            INFO, ["dim[4]", "found 9"];
        "an unknown type of numbers", changed(nifti, "a.nii", at(70, [99, 0])), INFO, ["datatype", "99"];
        "complex numbers", changed(nifti, "a.nii", at(70, [32, 0])), INFO, ["datatype", "complex"];
        "a type and a width that contradict", changed(nifti, "a.nii", at(72, [16, 0])), INFO, ["bitpix", "16", "32"];
        "voxels of size NaN", changed(nifti, "a.nii", at(280, f32::NAN.to_le_bytes())), INFO, ["sform", "NaN"];
        "parallel axes", changed(nifti, "a.nii", at(280, [0; 32])), INFO, ["sform", "independent"];
        "data far behind the end", changed(nifti, "a.nii", at(108, 1e6f32.to_le_bytes())),
            INFO, ["vox_offset", "end of the file"];
        "data at byte NaN", changed(nifti, "a.nii", at(108, f32::NAN.to_le_bytes())), INFO, ["vox_offset", "NaN"];
        "a voxel that is infinite", changed(nifti, "a.nii", at(352, f32::INFINITY.to_le_bytes())),
            INFO, ["voxel [0, 0, 0]", "inf"];
        "a voxel that is NaN", changed(nifti, "a.nii", at(444, f32::NAN.to_le_bytes())),
            "evaluate a.nii a.nii", ["voxel [3, 2, 1]", "NaN"];
        "a header without its image", changed(nifti, "a.nii", at(344, b"ni1")), INFO, ["in another file", "convert"];
        "NIfTI-2", changed(nifti, "a.nii", |b| b[..12].copy_from_slice(b"\x1c\x02\0\0n+2\0\r\n\x1a\n")),
            "convert a.nii b.mha", ["NIfTI-2"];
        "voxel sizes that differ between pixdim and sform", changed(nifti, "a.nii", at(88, 3f32.to_le_bytes())),
            INFO, ["pixdim says voxels of", "the sform", "the latter are used"].ends(End::Warned);
        "axes that are not at right angles", changed(nifti, "a.nii", at(284, 0.75f32.to_le_bytes())),
            INFO, ["x and y of the voxels are at 45.00 degrees"].ends(End::Warned);
        "Hounsfield units in place of attenuation", changed(nifti, "a.nii", at(352, (-1000f32).to_le_bytes())),
            "simulate a.nii -o scan", ["a.nii: values: found -1000 to", "Hounsfield units", "hu:0.02"];
        "a slope that is NaN", changed(nifti, "a.nii", at(112, f32::NAN.to_le_bytes())),
            INFO, ["scl_slope"].ends(End::Warned);
        "gzip, cut in the middle", changed(nifti_gz, "a.nii.gz", cut(60)), INFO_GZ, ["a.nii.gz", "gzip"];
        "gzip, cut within the checksum", changed(nifti_gz, "a.nii.gz", cut_end(3)),
            INFO_GZ, ["a.nii.gz", "gzip stream"];
        "gzip with a wrong checksum", changed(nifti_gz, "a.nii.gz", |b| {
            let n = b.len();
            b[n - 8] ^= 1;
        }), INFO_GZ, ["gzip stream"];
        "gzip of nothing but its first bytes", |d| put(d.join("a.nii.gz"), [0x1f, 0x8b]),
            "convert a.nii.gz out.nii", ["a.nii.gz"];
        "gzip that claims 140 TB in 200 bytes", |d| put(d.join("a.nii.gz"), gzip(header(d, [32767; 3]))),
            INFO_GZ, ["claims 140724603846652 bytes", "unpack to"].memory(AMPLE);
        "gzip bomb: 400 MB of zeros as the header says, in 400 kB", |d| bomb(d, [1000, 1000, 400], 400_000_000),
            INFO_GZ, ["400000000 bytes", "100 times"].memory(AMPLE);
        "gzip bomb: 300 MB behind a volume of 24 bytes", |d| bomb(d, [4, 3, 2], 300_000_000),
            INFO_GZ, ["more data", "24 bytes"];
        "gzip bomb, where the memory for it is asked first", |d| bomb(d, [1000, 1000, 400], 400_000_000),
            "convert a.nii.gz out.nii", ["memory: needs 3.0 GiB", "--memory allows 1.0 GiB"];
        "a sparse file of 1 TB that holds what its header says", |d| {
            let mut bytes = header(d, [10000; 3]);
            at(70, [2, 0, 8, 0])(&mut bytes);
            put(d.join("a.nii"), bytes);
            File::options().append(true).open(d.join("a.nii")).unwrap().set_len(352 + 1_000_000_000_000).unwrap();
        }, INFO, ["--memory"].memory(AMPLE);
        "a named pipe, which no one writes to",
            |d| assert!(std::process::Command::new("mkfifo").arg(d.join("a.nii")).status().unwrap().success()),
            INFO, ["a.nii", "a regular file"];
        "a device without end", |d| std::os::unix::fs::symlink("/dev/zero", d.join("a.nii")).unwrap(),
            "convert a.nii out.nii", ["a.nii", "a regular file"];
        "a link to itself", |d| std::os::unix::fs::symlink("a.nii", d.join("a.nii")).unwrap(),
            INFO, ["a.nii", "symbolic links"];
    }
}
