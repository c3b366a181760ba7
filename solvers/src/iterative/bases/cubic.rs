//! A cubic spline basis: a smooth volume on a coarse grid.
//!
//! Coefficients are samples of the volume at the centres of cells that fill the same box; between them the volume is
//! the cubic spline through them (Unser, IEEE Signal Process. Mag. 16(6), 1999). Along an axis, the samples `c` are
//! first converted to spline coefficients `P⁻¹c`, where P has 4/6 on its diagonal and 1/6 next to it; a voxel's value
//! is then a sum over the four nearest. The spline is mirrored at the sides of the box.

use conefield_core::basis::{Basis, BasisOperator, BasisSpec, Expansion};
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::VoxelGrid;
use conefield_core::parallel;
use conefield_core::simd::Real;
use ndarray::{ArrayView3, ArrayViewMut3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `cubic`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Cubic {
    /// Spacing of the samples in voxels, 0.5 to 64. It is adjusted so that a whole number of samples fills the volume.
    pub spacing: f64,
    /// Maximum number of samples along the longest side, 2 or more; larger volumes get a larger spacing. The resolution
    /// that few views support depends more on this number than on the voxel size.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<u32>,
}

impl Default for Cubic {
    fn default() -> Self {
        Self { spacing: 2.0, samples: None }
    }
}

conefield_core::stage_type!(BasisSpec, "cubic", Cubic, "samples of a cubic spline on a coarser grid");

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
        let spacing = std::array::from_fn(|k| match grid.shape[k] == shape[k] {
            // To the bit: a grid of as many samples is the grid of voxels.
            true => grid.spacing[k],
            false => grid.spacing[k] * grid.shape[k] as f64 / shape[k] as f64,
        });
        let axes = std::array::from_fn(|k| Axis::new(shape[k], grid.shape[k]));
        Ok(Box::new(Spline { samples: VoxelGrid { shape, spacing, center: grid.center }, voxels: grid.shape, axes }))
    }

    fn describe(&self) -> String {
        let most = self.samples.map(|n| format!(", at most {n} along a side")).unwrap_or_default();
        format!("cubic: samples of a cubic spline {} voxels apart{most}", self.spacing)
    }
}

/// A sparse matrix along one axis: for each output, its inputs and their weights.
struct Taps {
    inputs: usize,
    rows: Vec<Vec<(usize, f64)>>,
}

impl Taps {
    /// Maps spline coefficients to values at the centres of `voxels` voxels.
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

    /// Applies the matrix along one axis of `x`, whose entries are runs of `inner` numbers. Overwrites `y`.
    fn apply<R: Real>(&self, x: &[R], inner: usize, y: &mut [R]) {
        let (inputs, outputs) = (self.inputs, self.rows.len());
        if inner == 1 {
            return parallel::over(y.chunks_mut(LINES * outputs).zip(x.chunks(LINES * inputs)), |_, (y, x)| {
                for (y, x) in y.chunks_mut(outputs).zip(x.chunks(inputs)) {
                    for (y, row) in y.iter_mut().zip(&self.rows) {
                        *y = row.iter().fold(R::ZERO, |sum, &(input, weight)| sum + R::of(weight) * x[input]);
                    }
                }
            });
        }
        let some = 4096usize.div_ceil(inner);
        parallel::over(y.chunks_mut(some * inner), |n, y| {
            for (at, y) in (n * some..).zip(y.chunks_mut(inner)) {
                let (outer, output) = (at / outputs, at % outputs);
                y.fill(R::ZERO);
                for &(input, weight) in &self.rows[output] {
                    let weight = R::of(weight);
                    let from = (outer * inputs + input) * inner;
                    y.iter_mut().zip(&x[from..from + inner]).for_each(|(y, x)| *y += weight * *x);
                }
            }
        });
    }
}

/// Index `i` of `n` entries with mirrored boundaries.
fn mirrored(i: isize, n: usize) -> usize {
    let turn = i.rem_euclid(2 * n as isize) as usize;
    turn.min(2 * n - 1 - turn)
}

/// P⁻¹ along one axis, which is its own adjoint, by Thomas' algorithm. Mirrored boundaries add 1/6 to the first and the
/// last diagonal entry of P.
struct Prefilter {
    /// Reciprocal pivots.
    pivots: Vec<f64>,
}

impl Prefilter {
    fn new(samples: usize) -> Self {
        let mut upper = 0.0;
        let pivots = (0..samples).map(|i| {
            let diagonal = (4.0 + f64::from(u8::from(i == 0)) + f64::from(u8::from(i + 1 == samples))) / 6.0;
            let pivot = 1.0 / (diagonal - upper / 6.0);
            upper = pivot / 6.0;
            pivot
        });
        Self { pivots: pivots.collect() }
    }

    /// Applies it in place along one axis of `x`, whose entries are runs of `inner` numbers.
    fn apply<R: Real>(&self, x: &mut [R], inner: usize) {
        let n = self.pivots.len();
        if inner == 1 {
            return parallel::over(x.chunks_mut(LINES * n), |_, x| x.chunks_mut(n).for_each(|line| self.solve(line)));
        }
        if x.len() > n * inner {
            return parallel::over(x.chunks_mut(n * inner), |_, x| self.solve_rows(x.chunks_mut(inner).collect()));
        }
        // Along the first axis, in blocks of columns.
        let mut parts: Vec<Vec<&mut [R]>> = (0..inner.div_ceil(COLUMNS)).map(|_| Vec::with_capacity(n)).collect();
        for row in x.chunks_mut(inner) {
            row.chunks_mut(COLUMNS).zip(&mut parts).for_each(|(part, parts)| parts.push(part));
        }
        parallel::over(parts, |_, part| self.solve_rows(part));
    }

    /// Solves `P·y = x` in place.
    fn solve<R: Real>(&self, x: &mut [R]) {
        let (sixth, mut last) = (R::of(1.0 / 6.0), R::ZERO);
        for (x, &pivot) in x.iter_mut().zip(&self.pivots) {
            last = (*x - last * sixth) * R::of(pivot);
            *x = last;
        }
        for (x, &pivot) in x.iter_mut().zip(&self.pivots).rev().skip(1) {
            last = *x - R::of(pivot / 6.0) * last;
            *x = last;
        }
    }

    /// Solves for many right-hand sides: row i has the i-th number of each.
    fn solve_rows<R: Real>(&self, mut rows: Vec<&mut [R]>) {
        let sixth = R::of(1.0 / 6.0);
        for (i, &pivot) in self.pivots.iter().enumerate() {
            let (before, here) = rows.split_at_mut(i);
            let (here, pivot) = (&mut here[0], R::of(pivot));
            match before.last() {
                None => here.iter_mut().for_each(|x| *x *= pivot),
                Some(last) => here.iter_mut().zip(&**last).for_each(|(x, last)| *x = (*x - *last * sixth) * pivot),
            }
        }
        for i in (1..rows.len()).rev() {
            let (before, after) = rows.split_at_mut(i);
            let upper = R::of(self.pivots[i - 1] / 6.0);
            before[i - 1].iter_mut().zip(&*after[0]).for_each(|(x, next)| *x -= upper * *next);
        }
    }
}

/// Lines per task.
const LINES: usize = 64;

/// Columns solved together.
const COLUMNS: usize = 1024;

/// The operators along one axis: samples to spline coefficients, and coefficients to values.
struct Axis {
    prefilter: Prefilter,
    evaluate: [Taps; 2],
}

impl Axis {
    fn new(samples: usize, voxels: usize) -> Self {
        let evaluate = Taps::evaluate(samples, voxels);
        let transposed = evaluate.transposed();
        Self { prefilter: Prefilter::new(samples), evaluate: [evaluate, transposed] }
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
        // The largest two consecutive arrays.
        let steps = [[sx, sy, sz], [sx, sy, vz], [sx, vy, vz], [vx, vy, vz]];
        let bytes = steps.map(|shape| shape.iter().fold(4u64, |n, side| n.saturating_mul(*side as u64)));
        bytes.windows(2).map(|pair| pair[0].saturating_add(pair[1])).max().unwrap_or(0).max(2 * bytes[0])
    }
    fn operator(&self) -> &dyn BasisOperator<f32> {
        self
    }
    fn reference(&self) -> Option<&dyn BasisOperator<f64>> {
        Some(self)
    }
}

impl<R: Real> BasisOperator<R> for Spline {
    fn expand(&self, coefficients: ArrayView3<'_, R>, mut voxels: ArrayViewMut3<'_, R>) {
        let ([sx, sy, _], [vx, vy, vz]) = (self.samples.shape, self.voxels);
        let [x, y, z] = &self.axes;
        let mut own: Vec<R> = coefficients.iter().copied().collect();
        self.prefilter(&mut own);
        let mut z_done = vec![R::ZERO; sx * sy * vz];
        z.evaluate[0].apply(&own, 1, &mut z_done);
        drop(own);
        let mut y_done = vec![R::ZERO; sx * vy * vz];
        y.evaluate[0].apply(&z_done, vz, &mut y_done);
        drop(z_done);
        let last = |voxels: &mut [R]| x.evaluate[0].apply(&y_done, vy * vz, voxels);
        match voxels.as_slice_mut() {
            Some(voxels) => last(voxels),
            None => {
                let mut all = vec![R::ZERO; vx * vy * vz];
                last(&mut all);
                voxels.iter_mut().zip(all).for_each(|(voxel, x)| *voxel = x);
            }
        }
    }

    fn adjoint(&self, voxels: ArrayView3<'_, R>, mut coefficients: ArrayViewMut3<'_, R>) {
        let [[sx, sy, sz], [_, vy, vz]] = [self.samples.shape, self.voxels];
        let [x, y, z] = &self.axes;
        let all = voxels.as_standard_layout();
        let mut x_done = vec![R::ZERO; sx * vy * vz];
        x.evaluate[1].apply(all.as_slice().unwrap_or_default(), vy * vz, &mut x_done);
        let mut y_done = vec![R::ZERO; sx * sy * vz];
        y.evaluate[1].apply(&x_done, vz, &mut y_done);
        drop(x_done);
        let mut own = vec![R::ZERO; sx * sy * sz];
        z.evaluate[1].apply(&y_done, 1, &mut own);
        self.prefilter(&mut own);
        coefficients.iter_mut().zip(own).for_each(|(coefficient, x)| *coefficient = x);
    }
}

impl Spline {
    /// Samples to spline coefficients; also its adjoint.
    fn prefilter<R: Real>(&self, x: &mut [R]) {
        let [_, sy, sz] = self.samples.shape;
        for (axis, inner) in self.axes.iter().zip([sy * sz, sz, 1]) {
            axis.prefilter.apply(x, inner);
        }
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
        of.reference().unwrap().expand(x.view(), voxels.view_mut());
        voxels
    }

    /// A voxel whose centre is a sample point has the sample's value.
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

    /// Away from the boundaries a spline of order four reproduces cubics.
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

    /// To the bit, so that the grid is known to be that of the voxels.
    #[test]
    fn a_grid_of_as_many_samples_is_the_grid_of_voxels() {
        for (n, mm) in [(48, 0.1), (96, 0.2), (96, 0.4), (192, 0.7), (384, 0.1)] {
            let grid = VoxelGrid { shape: [n, n + 1, 7], spacing: [mm; 3], center: [0.1; 3] };
            assert_eq!(Cubic { spacing: 1.0, samples: None }.on(&grid).unwrap().coefficients(), grid);
        }
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
