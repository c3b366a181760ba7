//! Samples of a cubic spline: a smooth volume on a coarse grid.
//!
//! Coefficients are the values of the volume at the centres of cells that fill the same box; between them it is the cubic
//! spline through them (Unser, IEEE Signal Process. Mag. 16(6), 1999). Along an axis the samples `c` first become the
//! spline's own coefficients `P⁻¹c`, where P has 4/6 on its diagonal and 1/6 beside it; a voxel's value is then a sum over the
//! four nearest. The spline is mirrored at the sides of the box.

use conefield_core::basis::{Basis, BasisOperator, BasisSpec, Expansion};
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::VoxelGrid;
use conefield_core::simd::Real;
use ndarray::{ArrayView3, ArrayViewMut3};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `cubic`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Cubic {
    /// The distance of the samples in voxels, 0.5 to 64. It is adjusted so that a whole number of samples fills the volume.
    pub spacing: f64,
    /// At most so many samples along the longest side, 2 or more: larger volumes have them further apart. What few views can
    /// tell depends more on this number than on how fine the voxels are.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<u32>,
}

impl Default for Cubic {
    fn default() -> Self {
        Self { spacing: 2.0, samples: None }
    }
}

conefield_core::stage_type!(Basis, "cubic", Cubic, "samples of a cubic spline on a coarser grid");

#[typetag::serde(name = "cubic")]
impl BasisSpec for Cubic {
    fn build(&self) -> Result<Box<dyn Basis>> {
        ensure((0.5..=64.0).contains(&self.spacing), "spec", "spacing", self.spacing, "0.5 to 64 voxels")?;
        let few = self.samples.filter(|n| *n < 2);
        ensure(few.is_none(), "spec", "samples", few.unwrap_or_default(), "2 or more")?;
        Ok(Box::new(*self))
    }
}

impl Basis for Cubic {
    fn on(&self, grid: &VoxelGrid) -> Result<Box<dyn Expansion>> {
        let longest = grid.shape.into_iter().max().unwrap_or(1) as f64;
        let spacing = self.samples.map_or(self.spacing, |n| self.spacing.max(longest / f64::from(n)));
        let shape = grid.shape.map(|n| ((n as f64 / spacing).round() as usize).max(1));
        let spacing = std::array::from_fn(|k| grid.spacing[k] * grid.shape[k] as f64 / shape[k] as f64);
        let axes = std::array::from_fn(|k| Axis::new(shape[k], grid.shape[k]));
        Ok(Box::new(Spline { samples: VoxelGrid { shape, spacing, center: grid.center }, voxels: grid.shape, axes }))
    }

    fn describe(&self) -> String {
        let most = self.samples.map(|n| format!(", at most {n} along a side")).unwrap_or_default();
        format!("cubic: samples of a cubic spline {} voxels apart{most}", self.spacing)
    }
}

/// A sparse matrix along one axis, a row each output: which inputs it sums over, with which weights.
struct Taps {
    inputs: usize,
    rows: Vec<Vec<(usize, f64)>>,
}

/// Weights of P⁻¹ below this share of the largest are left out: far below single precision.
const NEGLIGIBLE: f64 = 1e-10;

impl Taps {
    /// Samples to the spline's coefficients: P⁻¹, a row of which falls by 0.27 from entry to entry.
    fn prefilter(samples: usize) -> Self {
        let column = |i| {
            let mut x = vec![0.0; samples];
            x[i] = 1.0;
            solve(&mut x);
            x.iter().copied().enumerate().filter(|(_, w)| w.abs() > NEGLIGIBLE).collect()
        };
        // P is symmetric, so that a row is a column.
        Self { inputs: samples, rows: (0..samples).map(column).collect() }
    }

    /// The spline's coefficients to its values at the centres of `voxels` voxels.
    fn evaluate(samples: usize, voxels: usize) -> Self {
        let row = |i| {
            let at = (i as f64 + 0.5) * samples as f64 / voxels as f64 - 0.5;
            let cell = at.floor();
            let t = at - cell;
            let weights = [
                (1.0 - t).powi(3) / 6.0,
                2.0 / 3.0 - t * t + t.powi(3) / 2.0,
                2.0 / 3.0 - (1.0 - t).powi(2) + (1.0 - t).powi(3) / 2.0,
                t.powi(3) / 6.0,
            ];
            let mut taps: Vec<(usize, f64)> = vec![];
            for (k, weight) in weights.into_iter().enumerate() {
                let input = mirrored(cell as isize + k as isize - 1, samples);
                match taps.iter_mut().find(|tap| tap.0 == input) {
                    Some(tap) => tap.1 += weight,
                    None => taps.push((input, weight)),
                }
            }
            taps
        };
        Self { inputs: samples, rows: (0..voxels).map(row).collect() }
    }

    fn transposed(&self) -> Self {
        let mut rows = vec![vec![]; self.inputs];
        for (output, row) in self.rows.iter().enumerate() {
            row.iter().for_each(|&(input, weight)| rows[input].push((output, weight)));
        }
        Self { inputs: self.rows.len(), rows }
    }

    /// Applies the matrix along one axis of `x`, of which each entry is a run of `inner` numbers.
    fn apply<R: Real>(&self, x: &[R], inner: usize) -> Vec<R> {
        let (inputs, outputs) = (self.inputs, self.rows.len());
        let mut y = vec![R::ZERO; x.len() / inputs * outputs];
        y.par_chunks_mut(inner).with_min_len(4096usize.div_ceil(inner)).enumerate().for_each(|(at, y)| {
            let (outer, output) = (at / outputs, at % outputs);
            for &(input, weight) in &self.rows[output] {
                let weight = R::of(weight);
                let from = (outer * inputs + input) * inner;
                y.iter_mut().zip(&x[from..from + inner]).for_each(|(y, x)| *y += weight * *x);
            }
        });
        y
    }
}

/// Index `i` of `n` entries that go on mirrored at both sides.
fn mirrored(i: isize, n: usize) -> usize {
    let turn = i.rem_euclid(2 * n as isize) as usize;
    turn.min(2 * n - 1 - turn)
}

/// Solves `P·y = x` in place (Thomas' algorithm). Mirrored sides add 1/6 to the first and the last diagonal entry.
fn solve(x: &mut [f64]) {
    let n = x.len();
    let diagonal = |i| (4.0 + f64::from(u8::from(i == 0)) + f64::from(u8::from(i + 1 == n))) / 6.0;
    let mut upper = vec![0.0; n];
    let mut last = [0.0; 2];
    for i in 0..n {
        let pivot = diagonal(i) - last[0] / 6.0;
        upper[i] = 1.0 / 6.0 / pivot;
        x[i] = (x[i] - last[1] / 6.0) / pivot;
        last = [upper[i], x[i]];
    }
    for i in (0..n - 1).rev() {
        x[i] -= upper[i] * x[i + 1];
    }
}

/// What is done along one axis, and its adjoint.
struct Axis {
    prefilter: [Taps; 2],
    evaluate: [Taps; 2],
}

impl Axis {
    fn new(samples: usize, voxels: usize) -> Self {
        let both = |taps: Taps| {
            let transposed = taps.transposed();
            [taps, transposed]
        };
        Self { prefilter: both(Taps::prefilter(samples)), evaluate: both(Taps::evaluate(samples, voxels)) }
    }
}

struct Spline {
    samples: VoxelGrid,
    voxels: [usize; 3],
    axes: [Axis; 3],
}

impl Expansion for Spline {
    fn coefficients(&self) -> VoxelGrid {
        self.samples
    }
    fn are_samples(&self) -> bool {
        true
    }
    fn scratch(&self) -> u64 {
        let [sx, sy, sz] = self.samples.shape;
        let [vx, vy, vz] = self.voxels;
        // The largest two arrays that follow each other.
        let steps = [[sx, sy, sz], [sx, sy, vz], [sx, vy, vz], [vx, vy, vz]];
        let bytes = steps.map(|shape| shape.iter().fold(4u64, |n, side| n.saturating_mul(*side as u64)));
        bytes.windows(2).map(|pair| pair[0].saturating_add(pair[1])).max().unwrap_or(0).max(2 * bytes[0])
    }
    fn operator(&self) -> &dyn BasisOperator<f32> {
        self
    }
    fn reference(&self) -> &dyn BasisOperator<f64> {
        self
    }
}

impl<R: Real> BasisOperator<R> for Spline {
    fn expand(&self, coefficients: ArrayView3<'_, R>, mut voxels: ArrayViewMut3<'_, R>) {
        let (s, v) = (self.samples.shape, self.voxels);
        let mut x: Vec<R> = coefficients.iter().copied().collect();
        for (axis, inner) in self.axes.iter().zip([s[1] * s[2], s[2], 1]) {
            x = axis.prefilter[0].apply(&x, inner);
        }
        for (axis, inner) in self.axes.iter().zip([v[1] * v[2], v[2], 1]).rev() {
            x = axis.evaluate[0].apply(&x, inner);
        }
        voxels.iter_mut().zip(x).for_each(|(voxel, x)| *voxel = x);
    }

    fn adjoint(&self, voxels: ArrayView3<'_, R>, mut coefficients: ArrayViewMut3<'_, R>) {
        let (s, v) = (self.samples.shape, self.voxels);
        let mut x: Vec<R> = voxels.iter().copied().collect();
        for (axis, inner) in self.axes.iter().zip([v[1] * v[2], v[2], 1]) {
            x = axis.evaluate[1].apply(&x, inner);
        }
        for (axis, inner) in self.axes.iter().zip([s[1] * s[2], s[2], 1]).rev() {
            x = axis.prefilter[1].apply(&x, inner);
        }
        coefficients.iter_mut().zip(x).for_each(|(coefficient, x)| *coefficient = x);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    fn spline(shape: [usize; 3], spacing: f64) -> Box<dyn Expansion> {
        Cubic { spacing, samples: None }.on(&VoxelGrid { shape, spacing: [1.0; 3], center: [0.0; 3] }).unwrap()
    }

    fn expand(of: &dyn Expansion, shape: [usize; 3], x: &Array3<f64>) -> Array3<f64> {
        let mut voxels = Array3::zeros(shape);
        of.reference().expand(x.view(), voxels.view_mut());
        voxels
    }

    /// Where a sample stands at a voxel's centre, that voxel has its value.
    #[test]
    fn the_spline_goes_through_its_samples() {
        let shape = [15, 9, 12];
        let of = spline(shape, 3.0);
        assert_eq!(of.coefficients().shape, [5, 3, 4]);
        let x = Array3::from_shape_fn((5, 3, 4), |(i, j, k)| ((7 * i + 3 * j + 5 * k) % 11) as f64);
        let voxels = expand(of.as_ref(), shape, &x);
        for ((i, j, k), sample) in x.indexed_iter() {
            let voxel = voxels[[3 * i + 1, 3 * j + 1, 3 * k + 1]];
            assert!((voxel - sample).abs() < 1e-8, "{voxel} {sample}");
        }
        assert!(expand(of.as_ref(), shape, &Array3::ones((5, 3, 4))).iter().all(|v| (v - 1.0).abs() < 1e-8));
    }

    /// Away from the sides a spline of order four repeats cubics.
    #[test]
    fn cubics_are_exact() {
        let of = spline([1, 1, 96], 2.0);
        let cubic = |z: f64| 1.0 + 0.02 * z - 3e-3 * z * z + 5e-5 * z.powi(3);
        let x = Array3::from_shape_fn((1, 1, 48), |(_, _, k)| cubic(2.0 * k as f64 + 0.5));
        let voxels = expand(of.as_ref(), [1, 1, 96], &x);
        for z in 36..60 {
            let (found, want) = (voxels[[0, 0, z]], cubic(z as f64));
            assert!((found / want - 1.0).abs() < 1e-6, "{found} {want}");
        }
    }

    #[test]
    fn as_many_samples_as_voxels_change_nothing() {
        let shape = [4, 5, 6];
        let x = Array3::from_shape_fn((4, 5, 6), |(i, j, k)| ((5 * i + 3 * j + 7 * k) % 13) as f64);
        let voxels = expand(spline(shape, 1.0).as_ref(), shape, &x);
        assert!(voxels.iter().zip(&x).all(|(a, b)| (a - b).abs() < 1e-8));
    }

    #[test]
    fn larger_volumes_have_samples_further_apart() {
        let shape = |shape| {
            let grid = VoxelGrid { shape, spacing: [0.5; 3], center: [0.0; 3] };
            Cubic { spacing: 1.0, samples: Some(20) }.on(&grid).unwrap().coefficients().shape
        };
        assert_eq!(shape([16, 10, 12]), [16, 10, 12]);
        assert_eq!(shape([40, 20, 30]), [20, 10, 15]);
        let e = BasisSpec::build(&Cubic { spacing: 1.0, samples: Some(1) }).err().unwrap().to_string();
        assert!(e.contains("samples") && e.contains("2 or more"), "{e}");
    }

    #[test]
    fn spacings_out_of_range_are_refused() {
        for spacing in [0.0, -1.0, f64::NAN, f64::INFINITY, 0.4, 65.0] {
            let e = BasisSpec::build(&Cubic { spacing, samples: None }).err().unwrap().to_string();
            assert!(e.contains("spacing") && e.contains("0.5 to 64"), "{e}");
        }
    }
}
