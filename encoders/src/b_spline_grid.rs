//! Pyramid of uniform cubic B-splines (Unser et al. 1993, B-Spline Signal Processing: Part I, IEEE Transactions on
//! Signal Processing 41(2)): points `[n, 3]` in the unit cube to `[n, levels·features]`.
//!
//! A level with `r` cells per side has `(r + 3)³` coefficients per feature, and its value is the tensor product `Σ_ijk
//! B_i(t_x)·B_j(t_y)·B_k(t_z)·c[X + i, Y + j, Z + k]`, where the position `p = clamp(x, 0, 1)·r` lies in cell `(X, Y,
//! Z)` at `t = p − ⌊p⌋`, and `B_0 … B_3` are `(1 − t)³/6`, `(3t³ − 6t² + 4)/6`, `(−3t³ + 3t² + 3t + 1)/6`, `t³/6`. It
//! has two continuous derivatives; a trilinear grid has none.

use crate::levels::{self, BLOCK, Cells, Levels, Rows, SUMS, cube, fold, fours, grid};
use conefield_core::prelude::*;
use conefield_core::simd::{Simd, SimdBase, SimdFloat};
use std::ops::{Range, RangeInclusive};

/// Settings of `b-spline-grid`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BSplineGrid {
    /// Number of levels, coarse to fine.
    pub levels: usize,
    /// Features per level: 1, 2, 4 or 8.
    pub features: usize,
    /// Cells along the cube's side on the coarsest level.
    pub base_resolution: u32,
    /// Ratio of consecutive levels' resolutions, at least 1. Resolutions are rounded to whole cells.
    pub growth: f64,
}

impl Default for BSplineGrid {
    fn default() -> Self {
        Self { levels: 4, features: 2, base_resolution: 16, growth: 2.0 }
    }
}

grid! {
    "b-spline-grid", BSplineGrid of SplineLevel,
    "multi-resolution grid of cubic B-splines",
    example = r#"{"levels": 3, "base_resolution": 4}"#
}

/// Coefficients along an axis that affect a cell.
const TAPS: usize = 4;

#[derive(Debug, Clone)]
struct SplineLevel {
    /// Cells per side.
    cells: u32,
}

impl SplineLevel {
    /// Coefficients per side.
    fn side(&self) -> usize {
        self.cells as usize + TAPS - 1
    }

    /// Index of the first of [`TAPS`] coefficients along z, `i` and `j` coefficients from the first along x and y.
    #[inline(always)]
    fn run<R>(&self, at: &Cells<R>, row: usize, i: usize, j: usize, features: usize) -> usize {
        let [x, y, z] = [at.cell[0][row] as usize + i, at.cell[1][row] as usize + j, at.cell[2][row] as usize];
        ((x * self.side() + y) * self.side() + z) * features
    }
}

/// The four B-splines that affect a cell.
#[inline(always)]
fn splines<R: Real>(t: R) -> [R; TAPS] {
    let (one, sixth, rest) = (R::ONE, R::of(1.0 / 6.0), R::ONE - t);
    let of = |t: R| ((R::of(3.0) * t - R::of(6.0)) * t * t + R::of(4.0)) * sixth;
    let (first, last) = (rest * rest * rest * sixth, t * t * t * sixth);
    let second = of(t);
    [first, second, one - first - second - last, last]
}

/// Their derivatives with respect to `t`.
fn slopes<R: Real>(t: R) -> [R; TAPS] {
    let (half, rest) = (R::of(0.5), R::ONE - t);
    let (first, last) = (R::ZERO - rest * rest * half, t * t * half);
    let second = (R::of(1.5) * t - R::of(2.0)) * t;
    [first, second, R::ZERO - first - second - last, last]
}

/// Cells of a block's rows on one level, and the weights of the coefficients.
struct Located<R> {
    cells: Cells<R>,
    /// Per axis.
    weight: [[[R; TAPS]; BLOCK]; 3],
}

impl<R: Real> Default for Located<R> {
    fn default() -> Self {
        Self { cells: Cells::default(), weight: [[[R::ZERO; TAPS]; BLOCK]; 3] }
    }
}

impl<R: Real> Located<R> {
    /// Weights along z of row `i`, each repeated per feature.
    #[inline(always)]
    fn along<S: Simd, const F: usize>(&self, s: S, i: usize) -> [R::Four<S>; 8] {
        fours(s, &self.weight[2][i].map(|weight| [weight; F]))
    }
}

/// Adds `weight·what` to the numbers of a level from `first` that lie in `own`. `grads` holds the gradients of that
/// range.
#[inline(always)]
fn add<S: Simd, R: Real, const F: usize>(
    s: S,
    (grads, own): (&mut [R], &Range<usize>),
    first: usize,
    weight: R,
    what: &[R::Four<S>; 8],
) {
    let end = first + TAPS * F;
    if own.start <= first && end <= own.end {
        let run = &mut grads[first - own.start..][..TAPS * F];
        let weight = R::Four::<S>::splat(s, weight);
        for q in 0..F {
            let to = &mut run[4 * q..4 * q + 4];
            what[q].mul_add(weight, R::Four::<S>::from_slice(s, to)).store_slice(to);
        }
    } else if own.start < end && first < own.end {
        for n in 0..TAPS * F {
            if own.contains(&(first + n)) {
                let to = &mut grads[first + n - own.start];
                let weight = R::Four::<S>::splat(s, weight);
                let sum = what[n / 4].mul_add(weight, R::Four::<S>::splat(s, *to));
                *to = sum.as_slice()[n % 4];
            }
        }
    }
}

impl levels::Level for SplineLevel {
    type Settings = BSplineGrid;
    type Located<R: Real> = Located<R>;

    const BASE: (RangeInclusive<u32>, &'static str) = (1..=1 << 20, "1 to 2^20 cells per side");
    const WGSL: &'static [&'static str] = &[SUMS, include_str!("b_spline_grid.wgsl")];

    fn parts(s: &BSplineGrid, number: usize, resolution: f64, before: usize) -> Result<Vec<Self>> {
        let resolution = resolution.round();
        cube(number, resolution, TAPS as u64 - 1, "coefficients", s.features, before)?;
        Ok(vec![Self { cells: resolution as u32 }])
    }

    fn resolution(&self) -> f64 {
        f64::from(self.cells)
    }

    fn blocks(&self, features: usize) -> Vec<(String, Vec<usize>)> {
        vec![("table".into(), vec![self.side(), self.side(), self.side(), features])]
    }

    /// Planes of equal x.
    fn slices(&self) -> usize {
        self.side()
    }

    fn macs(features: usize) -> usize {
        64 * features + 40
    }

    #[inline(always)]
    fn locate<S: Simd, R: Real>(&self, s: S, to: &mut Located<R>, x: Tile<'_, R>, at: usize, n: usize) {
        to.cells.locate(s, self.cells, x, at, n);
        for (weight, fraction) in to.weight.iter_mut().zip(&to.cells.fraction) {
            for i in 0..n {
                weight[i] = splines(fraction[i]);
            }
        }
    }

    #[inline(always)]
    fn gather<S: Simd, R: Real, const F: usize>(&self, s: S, rows: &Rows<'_, Self, R, F>, out: &mut [[R; F]; BLOCK]) {
        let &Rows { located, table, n } = rows;
        let (table, zero) = (table.as_flattened(), R::Four::<S>::splat(s, R::ZERO));
        for r in 0..n {
            let mut sums = [zero; 8];
            for i in 0..TAPS {
                for j in 0..TAPS {
                    let weight = R::Four::<S>::splat(s, located.weight[0][r][i] * located.weight[1][r][j]);
                    let run = &table[self.run(&located.cells, r, i, j, F)..][..TAPS * F];
                    for q in 0..F {
                        let four = R::Four::<S>::from_slice(s, &run[4 * q..4 * q + 4]);
                        sums[q] = four.mul_add(weight, sums[q]);
                    }
                }
            }
            let along = located.along::<S, F>(s, r);
            let mut sum = [zero; 2];
            for q in 0..F {
                let to = if F == 8 { q % 2 } else { 0 };
                sum[to] = sums[q].mul_add(along[q], sum[to]);
            }
            out[r] = fold::<S, R, F>(sum);
        }
    }

    #[inline(always)]
    fn scatter<S: Simd, R: Real, const F: usize>(
        &self,
        s: S,
        rows: &Rows<'_, Self, R, F>,
        dy: &[[R; F]; BLOCK],
        grads: &mut [R],
        own: &Range<usize>,
    ) {
        let &Rows { located, n, .. } = rows;
        for r in 0..n {
            // All coefficients that the row affects.
            let first = self.run(&located.cells, r, 0, 0, F);
            let end = self.run(&located.cells, r, TAPS - 1, TAPS - 1, F) + TAPS * F;
            if end <= own.start || own.end <= first {
                continue;
            }
            let (mut what, dy) = (located.along::<S, F>(s, r), fours(s, &[dy[r]; TAPS]));
            for q in 0..F {
                what[q] *= dy[q];
            }
            for i in 0..TAPS {
                for j in 0..TAPS {
                    let weight = located.weight[0][r][i] * located.weight[1][r][j];
                    let first = self.run(&located.cells, r, i, j, F);
                    add::<S, R, F>(s, (&mut *grads, own), first, weight, &what);
                }
            }
        }
    }

    /// The weights become their derivatives.
    fn move_to<R: Real>(&self, to: &mut Located<R>, d: usize, end: R) {
        to.weight[d] = to.cells.fraction[d].map(|t| slopes(t).map(|slope| slope * end));
    }

    fn code(&self) -> String {
        format!("{}u, {}u", self.cells, self.side())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type BSplineGridStage = Levels<SplineLevel>;

    /// Splines sum to 1 and reproduce a straight line: coefficient `c` is at cell `c − 1`.
    #[test]
    fn a_straight_line_is_reproduced() {
        let settings = BSplineGrid { levels: 2, features: 1, base_resolution: 3, growth: 2.0 };
        let stage = BSplineGridStage::new(&settings).unwrap();
        let mut params = vec![0.0f64; stage.info().params];
        let at = |c: usize| c as f64 - 1.0;
        for (n, p) in params[..216].iter_mut().enumerate() {
            *p = 0.5 + 2.0 * at(n / 36) - 3.0 * at(n / 6 % 6) + 0.25 * at(n % 6);
        }
        for x in [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.3, 0.71, 0.999], [0.5, 1.0 / 3.0, -7.0], [2.0, f64::NAN, 0.1]] {
            let mut y = [0.0; 2];
            stage.forward(&params, Tile::new(&x, 1), TileMut::new(&mut y, 1), TileMut::new(&mut [], 1));
            let p = x.map(|x| 3.0 * x.clamp(0.0, 1.0)).map(|p| if p.is_nan() { 0.0 } else { p });
            let want = 0.5 + 2.0 * p[0] - 3.0 * p[1] + 0.25 * p[2];
            assert!((y[0] - want).abs() < 1e-12 && y[1] == 0.0, "{x:?}: {y:?} {want}");
        }
    }
}
