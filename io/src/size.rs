//! Sizes of scans and volumes, read from their headers before memory is allocated.

use crate::scan::{self, ScanFile};
use crate::{r2, scan_folder, scanner, volume};
use conefield_core::error::ensure;
use conefield_core::scan::ScanHeader;
use conefield_core::{Error, Result};
use std::path::Path;

/// The size of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ScanSize {
    /// Measured values of all views; for a pickle an upper bound.
    pub pixels: u64,
    /// Voxels to reconstruct; for a pickle an upper bound.
    pub voxels: u64,
    /// Measured values of test views, which only [`read_data_set`](crate::read_data_set) reads. For a pickle, `pixels`
    /// includes them.
    pub test_pixels: u64,
    /// Bytes that reading takes besides the projections.
    pub reading: u64,
    /// Number of views; 1 if the file does not state it before it is read.
    pub views: usize,
}

impl ScanSize {
    /// A header for at least as many values, in square views and a cube: not every file states more before it is read.
    pub fn header(&self) -> ScanHeader {
        let views = self.views.max(1);
        let rows = (self.pixels as f64 / views as f64).sqrt().ceil().max(1.0) as usize;
        let columns = (self.pixels as usize).div_ceil(views).div_ceil(rows).max(1);
        let side = (self.voxels as f64).cbrt().ceil().max(1.0) as usize;
        let layers = (self.voxels as usize).div_ceil(side.saturating_mul(side)).max(1);
        ScanHeader { views, detector: [rows, columns], volume: [side, side, layers] }
    }
}

/// The size of a scan, from its description; projections are not read. A pickle (NAF) shows its sizes only when it is
/// read: the whole file counts as 32-bit projections, and as voxels too. For a scanner's images the headers are read.
pub fn scan_size(path: impl AsRef<Path>) -> Result<ScanSize> {
    let path = path.as_ref();
    let size = match scan::find(path)? {
        ScanFile::Own(file) => scan_folder::size(&file)?,
        ScanFile::R2(folder) => r2::size(&folder)?,
        ScanFile::Naf(file) => {
            let bytes = file_bytes(&file)?;
            ScanSize { pixels: bytes / 4, voxels: bytes / 4, test_pixels: 0, reading: bytes, views: 1 }
        }
        ScanFile::Scanner(file) => scanner::size(&file)?,
    };
    checked(path, size)
}

/// The size of the scan that a scanner's description gives.
pub fn scanner_size(path: impl AsRef<Path>) -> Result<ScanSize> {
    checked(path.as_ref(), scanner::size(path.as_ref())?)
}

/// Refuses a size that no machine holds.
fn checked(path: &Path, size: ScanSize) -> Result<ScanSize> {
    must_exist(path, "pixels of all views", size.pixels)?;
    must_exist(path, "pixels of test views", size.test_pixels)?;
    must_exist(path, "voxels", size.voxels)?;
    Ok(size)
}

/// Number of voxels of a volume, from its header, or for a DICOM series and TIFF files from the headers of the slices.
pub fn volume_voxels(path: impl AsRef<Path>) -> Result<u64> {
    let path = path.as_ref();
    let voxels = (volume::open(path)?.voxels)(path)?;
    must_exist(path, "voxels", voxels)?;
    Ok(voxels)
}

/// Number of values of an array of this shape, at most `u64::MAX`.
pub(crate) fn product(shape: impl AsRef<[usize]>) -> u64 {
    shape.as_ref().iter().fold(1, |n: u64, &s| n.saturating_mul(s as u64))
}

/// More values than any machine holds. Below this, sums of bytes stay far from overflow.
const MOST: u64 = 1 << 48;

fn must_exist(path: &Path, field: &str, n: u64) -> Result<()> {
    let expected = format!("at most {MOST}, past which no machine holds them");
    ensure(n <= MOST, &path.display().to_string(), field, n, expected)
}

pub(crate) fn file_bytes(path: &Path) -> Result<u64> {
    path.metadata().map(|m| m.len()).map_err(|e| Error::io(path, e))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::scan;
    use conefield_core::scan::Volume;
    use ndarray::Array3;

    #[test]
    fn sizes_are_read_without_the_data() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let v = Volume::centered(Array3::ones((5, 6, 7)), [1.0; 3]);
        for name in ["a.nii", "a.nii.gz", "a.mha", "a.npy", "a.nrrd", "a.tif", "a.zarr"] {
            crate::write_volume(at(name), &v).unwrap();
            assert_eq!(volume_voxels(at(name)).unwrap(), 210, "{name}");
        }
        // Only the header is read: a file truncated after it has the same size.
        let whole = std::fs::read(at("a.npy")).unwrap();
        std::fs::write(at("cut.npy"), &whole[..128]).unwrap();
        assert_eq!(volume_voxels(at("cut.npy")).unwrap(), 210);
        assert!(volume_voxels(at("none.npy")).is_err());

        let s = scan();
        let (pixels, voxels) = (s.projections.len() as u64, s.geometry.volume.len().unwrap() as u64);
        crate::write_scan(at("own"), &s, None).unwrap();
        assert_eq!(scan_size(at("own")).unwrap(), ScanSize { pixels, voxels, test_pixels: 0, reading: 0, views: 7 });
        crate::write_r2(at("r2"), &s, Some(&s), None).unwrap();
        let want = ScanSize { pixels, voxels, test_pixels: pixels, reading: 4 * pixels, views: 7 };
        assert_eq!(scan_size(at("r2")).unwrap(), want);
        crate::write_rtk(at("rtk"), &s).unwrap();
        assert_eq!(scan_size(at("rtk")).unwrap(), ScanSize { test_pixels: 0, reading: 8 * pixels, views: 1, ..want });
        crate::write_naf(at("naf.pickle"), &s, None, None).unwrap();
        let naf = scan_size(at("naf.pickle")).unwrap();
        assert!(naf.pixels >= pixels && naf.reading >= 4 * pixels, "{naf:?}");
    }
}
