//! Pyramid of uniform cubic B-splines (Unser et al. 1993, B-Spline Signal Processing: Part I, IEEE Transactions on
//! Signal Processing 41(2)): points `[n, 3]` in the unit cube to `[n, levels·features]`.
//!
//! A level with `r` cells per side has `(r + 3)³` coefficients per feature, and its value is the tensor product `Σ_ijk
//! B_i(t_x)·B_j(t_y)·B_k(t_z)·c[X + i, Y + j, Z + k]`, where the position `p = clamp(x, 0, 1)·r` lies in cell `(X, Y,
//! Z)` at `t = p − ⌊p⌋`, and `B_0 … B_3` are `(1 − t)³/6`, `(3t³ − 6t² + 4)/6`, `(−3t³ + 3t² + 3t + 1)/6`, `t³/6`. It
//! has two continuous derivatives; a trilinear grid has none.

use crate::levels::{
    BLOCK, Cells, LevelCode, Table, by_channel, by_features, functions, kernel_of_levels, start, stretch,
};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::settings::EncoderSpec;
use conefield_core::simd::{Op, Real, Simd, SimdBase, SimdFloat, run};
use conefield_core::stage::{Encoder, GradKind, Grads, Info, Kernel, Parameter, Reduced, Scope, Stage, Tile, TileMut};
use conefield_core::wgsl::Fragment;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;

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

conefield_core::stage_type!(
    Encoder,
    "b-spline-grid",
    BSplineGrid,
    "multi-resolution grid of cubic B-splines",
    example = r#"{"levels": 3, "base_resolution": 4}"#
);

#[typetag::serde(name = "b-spline-grid")]
impl EncoderSpec for BSplineGrid {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        Ok(Box::new(BSplineGridStage::new(self)?))
    }
}

/// More parameters are refused: with gradients and moments they would take 32 GiB.
const MOST: u64 = 1 << 31;

/// Minimum length of a parameter range that one worker sums.
const SLAB: usize = 1 << 19;

/// Coefficients along an axis that affect a cell.
const TAPS: usize = 4;

#[derive(Debug, Clone, PartialEq)]
struct Level {
    table: Table,
    /// Cells per side.
    cells: u32,
}

impl Level {
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

/// The stage that [`BSplineGrid`] builds.
#[derive(Debug, Clone, PartialEq)]
pub struct BSplineGridStage {
    features: usize,
    levels: Vec<Level>,
    params: usize,
    outputs: usize,
}

impl BSplineGridStage {
    /// Builds the stage, or names the setting that is out of range.
    pub fn new(settings: &BSplineGrid) -> Result<Self> {
        let s = settings;
        ensure((1..=32).contains(&s.levels), "spec", "levels", s.levels, "1 to 32")?;
        ensure([1, 2, 4, 8].contains(&s.features), "spec", "features", s.features, "1, 2, 4 or 8")?;
        let base = s.base_resolution;
        ensure((1..=1 << 20).contains(&base), "spec", "base_resolution", base, "1 to 2^20 cells per side")?;
        ensure((1.0..=16.0).contains(&s.growth), "spec", "growth", s.growth, "1 to 16")?;
        let mut levels = vec![];
        let mut params = 0u64;
        for number in 0..s.levels {
            let resolution = (f64::from(base) * s.growth.powi(number as i32)).round();
            // The cast saturates, and what exceeds 64 bits is refused like everything above the limit.
            let len = (resolution as u64)
                .checked_add(TAPS as u64 - 1)
                .and_then(|side| side.checked_pow(3))
                .and_then(|coefficients| coefficients.checked_mul(s.features as u64))
                .filter(|len| params.checked_add(*len).is_some_and(|all| all <= MOST));
            let Some(len) = len else {
                return Err(Error::invalid(
                    "spec",
                    "levels",
                    format!(
                        "more than 2^31 parameters with level {number}: ({resolution:.0} + 3)^3 coefficients of {} features",
                        s.features
                    ),
                    "at most 2^31 parameters: fewer levels, less growth, or a hash-grid, which bounds its tables",
                ));
            };
            let outputs = (0..s.features).map(|f| Some(number * s.features + f)).collect();
            let table = Table { start: params as usize, len: len as usize, number, outputs };
            levels.push(Level { table, cells: resolution as u32 });
            params += len;
        }
        Ok(Self { features: s.features, levels, params: params as usize, outputs: s.levels * s.features })
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
#[inline(always)]
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

impl<R: Real> Located<R> {
    fn new() -> Self {
        Self { cells: Cells::new(), weight: [[[R::ZERO; TAPS]; BLOCK]; 3] }
    }

    #[inline(always)]
    fn locate<S: Simd>(&mut self, s: S, level: &Level, x: Tile<'_, R>, at: usize, n: usize) {
        self.cells.locate(s, level.cells, x, at, n);
        for (weight, fraction) in self.weight.iter_mut().zip(&self.cells.fraction) {
            for i in 0..n {
                weight[i] = splines(fraction[i]);
            }
        }
    }

    /// Weights along z of row `i`, each repeated per feature: registers of four, of which `F` are used.
    #[inline(always)]
    fn along<S: Simd, const F: usize>(&self, s: S, i: usize) -> [R::Four<S>; 8] {
        let mut lanes = [[R::ZERO; 4]; 8];
        let weight = &self.weight[2][i];
        for n in 0..TAPS * F {
            lanes[n / 4][n % 4] = weight[n / F];
        }
        let mut all = [R::Four::<S>::splat(s, R::ZERO); 8];
        for q in 0..F {
            all[q] = R::Four::<S>::from_slice(s, &lanes[q]);
        }
        all
    }
}

struct Forward<'a, R> {
    stage: &'a BSplineGridStage,
    levels: Range<usize>,
    params: &'a [R],
    x: Tile<'a, R>,
    y: TileMut<'a, R>,
}

impl<R: Real> Forward<'_, R> {
    #[inline(always)]
    fn features<S: Simd, const F: usize>(mut self, s: S) {
        let mut located = Located::new();
        let mut out = [[R::ZERO; F]; BLOCK];
        let zero = R::Four::<S>::splat(s, R::ZERO);
        for level in &self.stage.levels[self.levels.clone()] {
            let table = &self.params[level.table.range()];
            for at in (0..self.x.rows).step_by(BLOCK) {
                let n = BLOCK.min(self.x.rows - at);
                located.locate(s, level, self.x, at, n);
                for r in 0..n {
                    let mut sums = [zero; 8];
                    for i in 0..TAPS {
                        for j in 0..TAPS {
                            let weight = R::Four::<S>::splat(s, located.weight[0][r][i] * located.weight[1][r][j]);
                            let run = &table[level.run(&located.cells, r, i, j, F)..][..TAPS * F];
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
                    if F < 4 {
                        sum[0] += sum[0].rotate_elements_left::<2>();
                    }
                    if F < 2 {
                        sum[0] += sum[0].rotate_elements_left::<1>();
                    }
                    for f in 0..F {
                        out[r][f] = sum[f / 4].as_slice()[f % 4];
                    }
                }
                level.table.put(&out, &mut self.y, at, n);
            }
        }
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

struct Backward<'a, R> {
    stage: &'a BSplineGridStage,
    params: &'a [R],
    x: Tile<'a, R>,
    dy: Tile<'a, R>,
    grads: Grads<'a, R>,
    dx: Option<TileMut<'a, R>>,
}

impl<R: Real> Backward<'_, R> {
    #[inline(always)]
    fn features<S: Simd, const F: usize>(mut self, s: S) {
        let mut located = Located::new();
        let mut dy = [[R::ZERO; F]; BLOCK];
        if let Some(dx) = &mut self.dx {
            dx.data.fill(R::ZERO);
        }
        let range = self.grads.range.clone();
        for level in &self.stage.levels {
            let params = level.table.range();
            let (from, to) = (params.start.max(range.start), params.end.min(range.end));
            if from >= to && self.dx.is_none() {
                continue;
            }
            // The requested part of this level, relative to its first parameter.
            let own = if from < to { from - params.start..to - params.start } else { 0..0 };
            let grads = if from < to { &mut self.grads.values[from - range.start..to - range.start] } else { &mut [] };
            for at in (0..self.x.rows).step_by(BLOCK) {
                let n = BLOCK.min(self.x.rows - at);
                level.table.take(self.dy, &mut dy, at, n);
                located.locate(s, level, self.x, at, n);
                if !own.is_empty() {
                    for r in 0..n {
                        // All coefficients that the row affects.
                        let first = level.run(&located.cells, r, 0, 0, F);
                        let end = level.run(&located.cells, r, TAPS - 1, TAPS - 1, F) + TAPS * F;
                        if end <= own.start || own.end <= first {
                            continue;
                        }
                        let mut what = located.along::<S, F>(s, r);
                        for q in 0..F {
                            let mut lanes = [R::ZERO; 4];
                            for k in 0..4 {
                                lanes[k] = dy[r][(4 * q + k) % F];
                            }
                            what[q] *= R::Four::<S>::from_slice(s, &lanes);
                        }
                        for i in 0..TAPS {
                            for j in 0..TAPS {
                                let weight = located.weight[0][r][i] * located.weight[1][r][j];
                                let first = level.run(&located.cells, r, i, j, F);
                                add::<S, R, F>(s, (&mut *grads, &own), first, weight, &what);
                            }
                        }
                    }
                }
                if let Some(dx) = &mut self.dx {
                    let table = &self.params[params.clone()];
                    for r in 0..n {
                        let slope = slope_of(level, table, &located, r, &dy[r]);
                        for (d, slope) in slope.into_iter().enumerate() {
                            dx.channel(d)[at + r] += slope * stretch(self.x.channel(d)[at + r], level.cells);
                        }
                    }
                }
            }
        }
    }
}

/// Derivative of `Σ dy·y` of row `r` with respect to its position in cells.
fn slope_of<R: Real, const F: usize>(
    level: &Level,
    table: &[R],
    located: &Located<R>,
    r: usize,
    dy: &[R; F],
) -> [R; 3] {
    let weight = located.weight.each_ref().map(|w| w[r]);
    let by = located.cells.fraction.each_ref().map(|f| slopes(f[r]));
    let mut sum = [R::ZERO; 3];
    for i in 0..TAPS {
        for j in 0..TAPS {
            let run = &table[level.run(&located.cells, r, i, j, F)..][..TAPS * F];
            for k in 0..TAPS {
                let value: R = (0..F).map(|f| run[k * F + f] * dy[f]).sum();
                sum[0] += by[0][i] * weight[1][j] * weight[2][k] * value;
                sum[1] += weight[0][i] * by[1][j] * weight[2][k] * value;
                sum[2] += weight[0][i] * weight[1][j] * by[2][k] * value;
            }
        }
    }
    sum
}

by_features!(Forward);
by_features!(Backward);

kernel_of_levels!(BSplineGridStage);

impl Stage for BSplineGridStage {
    fn info(&self) -> Info {
        Info {
            input: 3,
            output: self.outputs,
            params: self.params,
            tape: 0,
            scope: Scope::Row,
            grads: GradKind::Scatter,
            macs: self.levels.len() * (64 * self.features + 40),
            identity: false,
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        self.levels.iter().map(|l| l.table.parameter(vec![l.side(), l.side(), l.side(), self.features])).collect()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        start(seed, params);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    /// A worker owns some planes of equal x of a large level: at most 16 parts, because each visits every row again.
    fn partition(&self) -> Vec<Range<usize>> {
        let slabs = |l: &Level| {
            let (start, side, plane) = (l.table.start, l.side(), l.side() * l.side() * self.features);
            let pieces = l.table.len.div_ceil(SLAB).clamp(1, 16).min(side);
            (0..pieces).map(move |i| start + i * side / pieces * plane..start + (i + 1) * side / pieces * plane)
        };
        self.levels.iter().flat_map(slabs).collect()
    }

    fn wgsl(&self) -> Option<Fragment> {
        let code = |l: &Level| {
            let first = u32::try_from(l.table.start).ok()?;
            let value = format!("stage_Level({}u, {}u, {first}u)", l.cells, l.side());
            Some(LevelCode { value, outputs: l.table.outputs.clone() })
        };
        let levels = self.levels.iter().map(code).collect::<Option<Vec<_>>>()?;
        let constants = format!("const stage_FEATURES = {}u;\n", self.features);
        Some(Fragment::new(&[&constants, include_str!("b_spline_grid.wgsl"), &functions(&levels, self.outputs)]))
    }

    fn describe(&self) -> String {
        let cells = |l: Option<&Level>| l.map_or(0, |l| l.cells);
        format!(
            "b-spline-grid: {} levels x {}, {} to {} cells per side, {} parameters",
            self.levels.len(),
            self.features,
            cells(self.levels.first()),
            cells(self.levels.last()),
            self.params
        )
    }
}

impl Encoder for BSplineGridStage {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        ensure(!keep.is_empty(), "b-spline-grid", "channels", "none kept", "at least one")?;
        let mut stage = Self { levels: vec![], params: 0, outputs: keep.len(), ..self.clone() };
        let mut params = vec![];
        for level in &self.levels {
            if let Some(table) = level.table.kept(keep, stage.params) {
                stage.params += table.len;
                params.push(level.table.range());
                stage.levels.push(Level { table, ..level.clone() });
            }
        }
        Ok(Reduced { stage: Box::new(stage), params, channels: vec![0, 1, 2] })
    }

    fn coarse_to_fine(&self) -> bool {
        true
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        let levels = self.levels.iter().map(|l| (f64::from(l.cells), &l.table.outputs[..]));
        Some(by_channel(levels, self.outputs))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    fn too_many_parameters_are_refused_with_words() {
        for s in [
            BSplineGrid { levels: 8, ..BSplineGrid::default() },
            BSplineGrid { levels: 32, growth: 16.0, base_resolution: 1 << 20, ..BSplineGrid::default() },
        ] {
            let e = BSplineGridStage::new(&s).unwrap_err().to_string();
            assert!(e.contains("levels") && e.contains("2^31") && e.contains("hash-grid"), "{e}");
        }
    }
}
