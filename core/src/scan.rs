//! Scans (projections with geometry) and volumes (voxels with grid).

use crate::allowance;
use crate::error::{Error, Result, ensure};
use crate::finite::{first_not, stray};
use crate::geometry::{Geometry, Vec3, View, VoxelGrid};
use crate::parallel;
use ndarray::{Array3, ArrayView2, ArrayView3, s};
use serde::{Deserialize, Serialize};

/// About a million values of `projections` (`[view, row, column]`), which suffice for quantiles. They are of all columns: a
/// step with a factor of the columns would leave out some of them in every row.
pub fn sample(projections: ArrayView3<'_, f32>) -> Vec<f32> {
    let divisor = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let least = (projections.len() / 1_000_000).max(1);
    let step = (least..).find(|step| divisor(*step, projections.dim().2) <= 1).unwrap_or(1);
    let values = projections.iter().copied().step_by(step).enumerate();
    // A value of an array on the disk brings in the pages around it.
    let looking = values.inspect(|(i, _)| {
        if i.is_multiple_of(1 << 10) {
            allowance::trim()
        }
    });
    looking.map(|(_, value)| value).collect()
}

/// The 99.5th percentile of [`sample`], hardly moved by single hot pixels.
pub fn high(projections: ArrayView3<'_, f32>) -> f32 {
    highest(&mut sample(projections))
}

/// The 99.5th percentile of `all`, which it reorders; 0 for none.
pub(crate) fn highest(all: &mut [f32]) -> f32 {
    let Some(last) = all.len().checked_sub(1) else { return 0.0 };
    let k = ((all.len() as f64 * 0.995) as usize).min(last);
    *all.select_nth_unstable_by(k, f32::total_cmp).1
}

/// The length unit of the scan's data set. The program uses mm and 1/mm; volumes are written in `1/unit`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Unit {
    /// Its name in the data set, e.g. `mm`, `m`, `cube half side`.
    pub name: String,
    /// Millimetres per unit.
    pub mm: f64,
}

/// Names of lengths; other units, such as half the side of a cube, are relative to an object.
const LENGTHS: [&str; 8] = ["nm", "um", "µm", "mm", "cm", "dm", "m", "inch"];

impl Unit {
    /// Whether it is a length, so that values per unit are physical attenuation.
    pub fn is_length(&self) -> bool {
        LENGTHS.contains(&self.name.as_str())
    }
}

impl Default for Unit {
    fn default() -> Self {
        Self { name: "mm".into(), mm: 1.0 }
    }
}

/// The size of a scan, known from its files before large data is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct ScanHeader {
    /// Views.
    pub views: usize,
    /// Rows and columns of the detector.
    pub detector: [usize; 2],
    /// Voxels along x, y and z of the volume to reconstruct.
    pub volume: [usize; 3],
}

impl ScanHeader {
    /// Number of measured values.
    pub fn pixels(&self) -> u64 {
        [self.views, self.detector[0], self.detector[1]].iter().fold(1, |n, &k| n.saturating_mul(k as u64))
    }

    /// Number of voxels.
    pub fn voxels(&self) -> u64 {
        self.volume.iter().fold(1, |n, &k| n.saturating_mul(k as u64))
    }

    /// The header after binning by `size` ([`Scan::binned`]).
    pub fn binned(&self, size: usize) -> Self {
        let block = block(self.detector, size);
        Self { detector: [0, 1].map(|k| self.detector[k] / block[k]), ..*self }
    }

    /// Number of samples along the rays of all pixels at a distance of one voxel of the longest side.
    pub fn samples(&self) -> f64 {
        let longest = self.volume.into_iter().max().unwrap_or(0);
        self.pixels() as f64 * longest as f64
    }
}

/// Rows and columns of a block of `size`: no more than the detector has, so that one of few rows is binned along its
/// columns, and at least one.
fn block(detector: [usize; 2], size: usize) -> [usize; 2] {
    detector.map(|n| size.min(n).max(1))
}

/// Measured line integrals `A = -ln(I/I0)` with their geometry.
#[derive(Debug, Clone)]
pub struct Scan {
    /// Source, detector and volume, in mm.
    pub geometry: Geometry,
    /// Line integrals, `[view, row, column]`, dimensionless.
    pub projections: Array3<f32>,
    /// The length unit of the data set.
    pub unit: Unit,
    /// Origin of the scan (simulation source and noise, or the file read).
    pub provenance: serde_json::Value,
}

/// Largest line integral: sums of squares over a scan stay far below the single-precision maximum.
const MOST: f32 = 1e15;

impl Scan {
    /// Its size.
    pub fn header(&self) -> ScanHeader {
        let g = &self.geometry;
        ScanHeader { views: g.views.len(), detector: g.detector, volume: g.volume.shape }
    }

    /// One view, `[row, column]`.
    pub fn view(&self, view: usize) -> ArrayView2<'_, f32> {
        self.projections.index_axis(ndarray::Axis(0), view)
    }

    /// Refuses a scan with inconsistent parts or non-finite values.
    pub fn validate(&self, place: &str) -> Result<()> {
        self.geometry.validate(place)?;
        let g = &self.geometry;
        let want = [g.views.len(), g.detector[0], g.detector[1]];
        let found = self.projections.shape();
        let expected = format!("{want:?} (views, rows, columns)");
        ensure(found == want, place, "projections.shape", format!("{found:?}"), expected)?;
        let mm = self.unit.mm;
        ensure(mm.is_finite() && mm > 0.0, place, "unit.mm", mm, "a positive finite number of millimetres")?;
        let refuse = |at: (usize, usize, usize), found: String, expected: String| {
            Err(Error::invalid(place, format!("projections[{}, {}, {}]", at.0, at.1, at.2), found, expected))
        };
        if let Some((at, x)) = stray(&self.projections) {
            return refuse(at, x.to_string(), "a finite line integral".into());
        }
        if let Some((at, x)) = first_not(&self.projections, |x| x.abs() <= MOST) {
            let expected = format!("a line integral of at most {MOST:e}, past which single precision overflows");
            return refuse(at, format!("{x:e}"), expected);
        }
        Ok(())
    }

    /// Splits off the views in `held_out`: the scan without them, and a scan of them only. Refuses indices past the
    /// last view.
    pub fn split(&self, held_out: &[usize]) -> Result<(Scan, Scan)> {
        let n = self.geometry.views.len();
        for &v in held_out {
            ensure(v < n, "held-out views", "view", v, format!("an index below {n}"))?;
        }
        let (out, keep): (Vec<usize>, Vec<usize>) = (0..n).partition(|v| held_out.contains(v));
        ensure(!keep.is_empty(), "held-out views", "views", "all of them", "at least one view left to train on")?;
        Ok((self.select(&keep), self.select(&out)))
    }

    /// The scan averaged over blocks of `size` × `size` pixels, or as many as the detector has along an axis; rows and
    /// columns at the end that fill no block are dropped. `size` is at least 1.
    pub fn binned(&self, size: usize) -> Scan {
        let g = &self.geometry;
        let [tall, wide] = block(g.detector, size);
        let detector = self.header().binned(size).detector;
        let larger = |a: Vec3, by: usize| a.map(|x| x * by as f64);
        let binned = |w: &View| {
            let row = (detector[0] * tall) as f64 / 2.0 - 0.5;
            let column = (detector[1] * wide) as f64 / 2.0 - 0.5;
            let middle = w.pixel(g.detector, row, column);
            View { source: w.source, detector: middle, u: larger(w.u, wide), v: larger(w.v, tall) }
        };
        let views: Vec<View> = g.views.iter().map(binned).collect();
        let mut projections = Array3::zeros((views.len(), detector[0], detector[1]));
        parallel::over(projections.outer_iter_mut(), |view, mut image| {
            for ((row, column), mean) in image.indexed_iter_mut() {
                let (row, column) = (row * tall, column * wide);
                let block = self.projections.slice(s![view, row..row + tall, column..column + wide]);
                *mean = block.sum() / (tall * wide) as f32;
            }
        });
        self.with(Geometry { detector, views, volume: g.volume }, projections)
    }

    /// A scan of only these views, in this order. Each is an index below the number of views.
    pub fn select(&self, views: &[usize]) -> Scan {
        let geometry =
            Geometry { views: views.iter().map(|&v| self.geometry.views[v]).collect(), ..self.geometry.clone() };
        self.with(geometry, self.projections.select(ndarray::Axis(0), views))
    }

    /// A scan of the same origin.
    fn with(&self, geometry: Geometry, projections: Array3<f32>) -> Scan {
        Scan { geometry, projections, unit: self.unit.clone(), provenance: self.provenance.clone() }
    }
}

/// Matrix rows, voxel index → millimetres; the last row is `[0, 0, 0, 1]`.
pub type Affine = [[f64; 4]; 4];

/// Voxels of attenuation (or another quantity) with their grid.
#[derive(Debug, Clone)]
pub struct Volume {
    /// Values, `[x, y, z]`.
    pub data: Array3<f32>,
    /// Position of the voxels, in mm.
    pub grid: VoxelGrid,
    /// Voxel indices to the patient's or file's own coordinates in mm (NIfTI's affine, RAS), row-major, if known.
    pub affine: Option<Affine>,
}

impl Volume {
    /// A volume centred on the rotation axis.
    pub fn centered(data: Array3<f32>, spacing: [f64; 3]) -> Self {
        let s = data.shape();
        let grid = VoxelGrid { shape: [s[0], s[1], s[2]], spacing, center: [0.0; 3] };
        Self { data, grid, affine: None }
    }

    /// Applies `f` to every value.
    pub fn mapped(mut self, f: impl Fn(f32) -> f32 + Sync + Send) -> Self {
        parallel::change_all(&mut self.data, f);
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Millimetres, Radians};

    /// Blocks of 2 × 2 in 7 × 9 pixels drop the last row and column; the rest keeps its position.
    #[test]
    fn blocks_stand_where_their_pixels_stood() {
        let mm = Millimetres;
        let geometry = Geometry {
            detector: [7, 9],
            views: vec![View::circular(Radians(0.3), mm(100.0), mm(150.0), [mm(2.0), mm(1.0)], [mm(3.0), mm(-1.0)])],
            volume: VoxelGrid { shape: [4; 3], spacing: [1.0; 3], center: [0.0; 3] },
        };
        let projections = Array3::from_shape_fn((1, 7, 9), |(_, r, c)| (10 * r + c) as f32);
        let scan = Scan { geometry, projections, unit: Unit::default(), provenance: serde_json::Value::Null };
        let binned = scan.binned(2);
        assert_eq!(binned.geometry.detector, [3, 4]);
        assert_eq!(binned.projections[[0, 1, 2]], (24.0 + 25.0 + 34.0 + 35.0) / 4.0);
        let place = |s: &Scan, row, column| s.geometry.views[0].pixel(s.geometry.detector, row, column);
        for (row, column) in [(0.0, 0.0), (2.0, 3.0), (1.0, 2.0)] {
            let (a, b) = (place(&binned, row, column), place(&scan, 2.0 * row + 0.5, 2.0 * column + 0.5));
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9), "{a:?} {b:?}");
        }
        assert_eq!(scan.binned(1).projections, scan.projections);
        let none = ScanHeader { views: 0, detector: [0; 2], volume: [4; 3] };
        assert_eq!(none.binned(4), none);
    }
}
