//! NRRD. Written are 32-bit floats in gzip, in the patient's coordinates (left, posterior, superior), as 3D Slicer and
//! ITK read them.
//!
//! Source: the format definition, teem.sourceforge.net/nrrd/format.html.

mod read;

pub(crate) use read::{DATA_FILE, is_header, read, read_header, shape};

use crate::affine;
use crate::file_order::{self, FileOrder};
use crate::packing::Packing;
use conefield_core::parts::Voxels;
use conefield_core::{Error, Result};
use std::io::Write;
use std::path::Path;

pub(crate) fn write(w: &mut dyn Write, path: &Path, voxels: &mut dyn Voxels) -> Result<()> {
    let io = |e| Error::io(path, e);
    let [nx, ny, nz] = voxels.grid().shape;
    let (ras, _) = affine::of(voxels, &path.display().to_string());
    let lps = affine::flip(ras);
    let vector = |k: usize| {
        let [a, b, c] = affine::column(&lps, k);
        format!("({a},{b},{c})")
    };
    let comment = voxels.hounsfield().map_or(String::new(), |hu| format!("# {hu}\n"));
    let text = format!(
        "NRRD0004\n{comment}type: float\ndimension: 3\nspace: left-posterior-superior\nsizes: {nx} {ny} {nz}\n\
         space directions: {} {} {}\nkinds: domain domain domain\nspace units: \"mm\" \"mm\" \"mm\"\nendian: little\n\
         encoding: gzip\nspace origin: {}\n\n",
        vector(0),
        vector(1),
        vector(2),
        vector(3),
    );
    w.write_all(text.as_bytes()).map_err(io)?;
    let mut packed = Packing::gzip(w).map_err(io)?;
    file_order::write(&mut packed, path, voxels, FileOrder::XFastest)?;
    packed.finish().map_err(io)
}
