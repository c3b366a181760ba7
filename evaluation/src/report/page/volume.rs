//! Volumes in a page: values quantized to 16 bits, on coarser voxels if there are too many.

use crate::report::MiddleSlices;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::Volume;
use conefield_core::{Error, Result};
use flate2::Compression;
use flate2::write::GzEncoder;
use ndarray::{Array3, ArrayView3, CowArray, s};
use serde::Serialize;
use std::io::Write;

/// Quantization steps from the middle of the values to either end.
const STEPS: f64 = 32767.0;
/// Represents NaN.
const NO_NUMBER: i16 = i16::MIN;

/// A volume with metadata for the viewer.
#[derive(Debug, Serialize)]
pub struct PageVolume {
    /// Its display name.
    pub name: String,
    /// Whether it is a reference.
    pub reference: bool,
    /// Voxels of the page along x, y and z.
    pub shape: [usize; 3],
    /// mm.
    spacing: [f64; 3],
    center: [f64; 3],
    /// Of its values.
    pub unit: String,
    /// The attenuation of water, as an initial guess.
    pub water: f64,
    /// A value is `stored · slope + offset`.
    slope: f64,
    offset: f64,
    low: f64,
    high: f64,
    /// The automatic grey window.
    pub window: [f32; 2],
    coarser: usize,
    note: String,
    #[serde(skip)]
    packed: String,
}

/// The coarsening factor with which volumes of these numbers of `voxels` take at most `bytes` in total, before
/// compression.
pub fn coarser(voxels: &[u64], bytes: u64) -> usize {
    let size = |factor: u64| voxels.iter().map(|n| 2 * n / factor.pow(3)).sum::<u64>();
    (1..64u64).find(|f| size(*f) <= bytes).unwrap_or(64) as usize
}

impl PageVolume {
    /// `volume` on `grid`, averaged over blocks of `coarser`³ voxels.
    pub fn new(name: &str, reference: bool, volume: &Volume, grid: &VoxelGrid, coarser: usize) -> Result<Self> {
        let (values, coarse) = coarsened(volume.data.view(), grid, coarser);
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for x in values.iter().filter(|x| x.is_finite()).map(|x| f64::from(*x)) {
            (low, high) = (low.min(x), high.max(x));
        }
        if low > high {
            (low, high) = (0.0, 0.0);
        }
        let slope = if low < high { (high - low) / (2.0 * STEPS) } else { 1.0 };
        let offset = low + (high - low) / 2.0;
        let packed = pack(values.view(), slope, offset).map_err(|e| Error::io("packing a volume", e))?;
        let size = |s: [usize; 3]| format!("{} x {} x {}", s[0], s[1], s[2]);
        let voxels = match coarser {
            1 => format!("{} voxels", size(grid.shape)),
            n => format!("means of {n} x {n} x {n} voxels, {} of {}", size(coarse.shape), size(grid.shape)),
        };
        Ok(Self {
            name: name.to_owned(),
            reference,
            shape: coarse.shape,
            spacing: coarse.spacing,
            center: coarse.center,
            unit: "of its file".into(),
            water: if high > 0.3 { 1.0 / 3.0 } else { 0.02 },
            slope,
            offset,
            low,
            high,
            window: MiddleSlices::of(volume).window(),
            coarser,
            note: format!("{voxels}, values in steps of {slope:.2e}"),
            packed,
        })
    }

    /// Whether both have the same voxels on the same grid.
    pub fn same_as(&self, other: &Self) -> bool {
        (&self.packed, self.slope, self.offset) == (&other.packed, other.slope, other.offset)
            && (self.shape, self.spacing, self.center) == (other.shape, other.spacing, other.center)
    }

    /// The stored numbers, x fastest: all high bytes, then all low bytes, gzip, base64.
    pub(super) fn packed(&self) -> &str {
        &self.packed
    }
}

/// Means of blocks, with their grid. Blocks at the end may be smaller.
fn coarsened<'a>(
    values: ArrayView3<'a, f32>,
    grid: &VoxelGrid,
    by: usize,
) -> (CowArray<'a, f32, ndarray::Ix3>, VoxelGrid) {
    if by == 1 {
        return (values.into(), *grid);
    }
    let shape = grid.shape.map(|n| n.div_ceil(by));
    let block = |i: usize, k: usize| i * by..((i + 1) * by).min(grid.shape[k]);
    let means = Array3::from_shape_fn(shape, |(x, y, z)| {
        let part = values.slice(s![block(x, 0), block(y, 1), block(z, 2)]);
        (part.iter().map(|v| f64::from(*v)).sum::<f64>() / part.len() as f64) as f32
    });
    let spacing = grid.spacing.map(|mm| mm * by as f64);
    let corner = grid.bounds()[0];
    let center = std::array::from_fn(|k| corner[k] + shape[k] as f64 * spacing[k] / 2.0);
    (means.into(), VoxelGrid { shape, spacing, center })
}

fn pack(values: ArrayView3<'_, f32>, slope: f64, offset: f64) -> std::io::Result<String> {
    let stored = |x: &f32| match f64::from(*x) {
        x if x.is_finite() => ((x - offset) / slope).round().clamp(-STEPS, STEPS) as i16,
        _ => NO_NUMBER,
    };
    // The high bytes change slowly and compress well on their own.
    let (high, low): (Vec<u8>, Vec<u8>) =
        values.reversed_axes().iter().map(|x| stored(x).to_be_bytes()).map(|[high, low]| (high, low)).unzip();
    let mut zipped = GzEncoder::new(Vec::new(), Compression::default());
    zipped.write_all(&high)?;
    zipped.write_all(&low)?;
    Ok(STANDARD.encode(zipped.finish()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;

    fn volume(shape: [usize; 3]) -> Volume {
        let data = Array3::from_shape_fn(shape, |(x, y, z)| x as f32 + 10.0 * y as f32 + 100.0 * z as f32 - 7.0);
        let grid = VoxelGrid { shape, spacing: [1.0, 2.0, 3.0], center: [5.0, 0.0, 0.0] };
        Volume { data, grid, affine: None }
    }

    fn unpacked(page: &PageVolume) -> Vec<f64> {
        let zipped = STANDARD.decode(page.packed()).unwrap();
        let mut raw = vec![];
        flate2::read::GzDecoder::new(&zipped[..]).read_to_end(&mut raw).unwrap();
        let n = raw.len() / 2;
        (0..n).map(|i| f64::from(i16::from_be_bytes([raw[i], raw[n + i]])) * page.slope + page.offset).collect()
    }

    #[test]
    fn values_come_back_within_half_a_step() {
        let v = volume([3, 4, 5]);
        let page = PageVolume::new("v", false, &v, &v.grid, 1).unwrap();
        let back = unpacked(&page);
        for ((x, y, z), want) in v.data.indexed_iter() {
            let found = back[x + 3 * (y + 4 * z)];
            assert!((found - f64::from(*want)).abs() <= 0.51 * page.slope, "{found} {want}");
        }
        assert_eq!((page.low, page.high), (-7.0, 425.0));
    }

    #[test]
    fn odd_values_have_their_own_ways() {
        let mut v = volume([2, 2, 2]);
        v.data.fill(3.0);
        let page = PageVolume::new("constant", false, &v, &v.grid, 1).unwrap();
        assert!(unpacked(&page).iter().all(|x| *x == 3.0));
        v.data.fill(f32::NAN);
        let page = PageVolume::new("nothing", false, &v, &v.grid, 1).unwrap();
        assert!(unpacked(&page).iter().all(|x| *x == f64::from(NO_NUMBER)));
    }

    #[test]
    fn coarser_voxels_are_means_at_the_same_place() {
        let v = volume([4, 4, 5]);
        let page = PageVolume::new("v", false, &v, &v.grid, 2).unwrap();
        assert_eq!((page.shape, page.spacing), ([2, 2, 3], [2.0, 4.0, 6.0]));
        // The box starts at the same position, and its last block is half full.
        assert_eq!(page.center, [5.0, 0.0, 1.5]);
        let back = unpacked(&page);
        let near = |a: f64, b: f64| (a - b).abs() <= page.slope;
        assert!(near(back[0], 0.5 + 5.0 + 50.0 - 7.0) && near(back[2 * 4], 0.5 + 5.0 + 400.0 - 7.0), "{back:?}");
        assert_eq!((coarser(&[1000], 2000), coarser(&[1000], 1999), coarser(&[8000; 2], 500)), (1, 2, 4));
    }
}
