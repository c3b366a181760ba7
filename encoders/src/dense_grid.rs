//! Multi-resolution dense grid: points `[n, 3]` in the unit cube to `[n, levels·features]`; on each level the features
//! of the 8 corners of the point's cell, trilinearly interpolated, as in a hash grid (Müller et al. 2022, section 3)
//! whose tables hold every vertex.
//!
//! A level with `r` cells per side has `(r + 1)³` vertices at the corners of its cells, which fill the cube exactly:
//! `p = clamp(x, 0, 1)·r`.

use crate::levels::{LevelCode, by_channel, by_features, functions, kernel_of_levels};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::settings::EncoderSpec;
use conefield_core::simd::{Op, Real, Simd, run};
use conefield_core::stage::{Encoder, GradKind, Grads, Info, Kernel, Parameter, Reduced, Scope, Stage, Tile, TileMut};
use conefield_core::trilinear::{BLOCK, Grid, Located};
use conefield_core::wgsl::{Fragment, TRILINEAR};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Settings of `dense-grid`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DenseGrid {
    /// Number of levels, coarse to fine.
    pub levels: usize,
    /// Features per level: 1, 2, 4 or 8.
    pub features: usize,
    /// Cells along the cube's side on the coarsest level.
    pub base_resolution: u32,
    /// Ratio of consecutive levels' resolutions, at least 1. Resolutions are rounded to whole cells.
    pub growth: f64,
}

impl Default for DenseGrid {
    fn default() -> Self {
        Self { levels: 4, features: 2, base_resolution: 16, growth: 2.0 }
    }
}

conefield_core::stage_type!(
    Encoder,
    "dense-grid",
    DenseGrid,
    "multi-resolution grid without hashing",
    example = r#"{"levels": 3, "base_resolution": 4}"#
);

#[typetag::serde(name = "dense-grid")]
impl EncoderSpec for DenseGrid {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        Ok(Box::new(DenseGridStage::new(self)?))
    }
}

/// More parameters are refused: with gradients and moments they would take 32 GiB.
const MOST: u64 = 1 << 31;

/// Minimum length of a parameter range that one worker sums.
const SLAB: usize = 1 << 19;

#[derive(Debug, Clone, PartialEq)]
struct Level {
    grid: Grid,
    /// Index of the first parameter.
    start: usize,
    /// Index of the level in the settings, which names its parameters.
    number: usize,
    /// Output channel of each feature; `None` if unused.
    outputs: Vec<Option<usize>>,
}

/// The stage that [`DenseGrid`] builds.
#[derive(Debug, Clone, PartialEq)]
pub struct DenseGridStage {
    features: usize,
    levels: Vec<Level>,
    params: usize,
    outputs: usize,
}

impl DenseGridStage {
    /// Builds the stage, or names the setting that is out of range.
    pub fn new(settings: &DenseGrid) -> Result<Self> {
        let s = settings;
        ensure((1..=32).contains(&s.levels), "spec", "levels", s.levels, "1 to 32")?;
        ensure([1, 2, 4, 8].contains(&s.features), "spec", "features", s.features, "1, 2, 4 or 8")?;
        let base = s.base_resolution;
        ensure((1..=1 << 20).contains(&base), "spec", "base_resolution", base, "1 to 2^20 cells per side")?;
        ensure((1.0..=16.0).contains(&s.growth), "spec", "growth", s.growth, "1 to 16")?;
        let mut levels = vec![];
        let mut total = 0u64;
        for l in 0..s.levels {
            let resolution = (f64::from(base) * s.growth.powi(l as i32)).round();
            // The cast saturates, and what exceeds 64 bits is refused like everything above the limit.
            let count = (resolution as u64)
                .checked_add(1)
                .and_then(|side| side.checked_pow(3))
                .and_then(|vertices| vertices.checked_mul(s.features as u64))
                .and_then(|params| params.checked_add(total))
                .filter(|&t| t <= MOST);
            let Some(count) = count else {
                return Err(Error::invalid(
                    "spec",
                    "levels",
                    format!(
                        "more than 2^31 parameters with level {l}: ({resolution:.0} + 1)^3 vertices of {} features",
                        s.features
                    ),
                    "at most 2^31 parameters: fewer levels, less growth, or a hash-grid, which bounds its tables",
                ));
            };
            levels.push(Level {
                grid: Grid::corners([resolution as usize; 3]),
                start: total as usize,
                number: l,
                outputs: (0..s.features).map(|f| Some(l * s.features + f)).collect(),
            });
            total = count;
        }
        Ok(Self { features: s.features, levels, params: total as usize, outputs: s.levels * s.features })
    }

    fn params_of(&self, level: &Level) -> Range<usize> {
        level.start..level.start + level.grid.entries() * self.features
    }
}

struct Forward<'a, R> {
    stage: &'a DenseGridStage,
    levels: Range<usize>,
    params: &'a [R],
    x: Tile<'a, R>,
    y: TileMut<'a, R>,
}

impl<R: Real> Forward<'_, R> {
    #[inline(always)]
    fn features<S: Simd, const F: usize>(mut self, s: S) {
        let mut located = Located::default();
        let mut out = [[R::ZERO; BLOCK]; F];
        for level in &self.stage.levels[self.levels.clone()] {
            let (table, _) = self.params[self.stage.params_of(level)].as_chunks::<F>();
            let offsets = level.grid.offsets();
            for at in (0..self.x.rows).step_by(BLOCK) {
                let n = BLOCK.min(self.x.rows - at);
                located.locate(s, &level.grid, self.x, at, n);
                for i in 0..n {
                    let value = located.gather(i, &offsets, table);
                    for f in 0..F {
                        out[f][i] = value[f];
                    }
                }
                for (out, channel) in out.iter().zip(&level.outputs) {
                    if let Some(c) = *channel {
                        self.y.channel(c)[at..at + n].copy_from_slice(&out[..n]);
                    }
                }
            }
        }
    }
}

struct Backward<'a, R> {
    stage: &'a DenseGridStage,
    params: &'a [R],
    x: Tile<'a, R>,
    dy: Tile<'a, R>,
    grads: Grads<'a, R>,
    dx: Option<TileMut<'a, R>>,
}

impl<R: Real> Backward<'_, R> {
    #[inline(always)]
    fn features<S: Simd, const F: usize>(mut self, s: S) {
        let mut located = Located::default();
        let mut dy = [[R::ZERO; F]; BLOCK];
        if let Some(dx) = &mut self.dx {
            dx.data.fill(R::ZERO);
        }
        let range = self.grads.range.clone();
        for level in &self.stage.levels {
            let params = self.stage.params_of(level);
            let (from, to) = (params.start.max(range.start), params.end.min(range.end));
            if from >= to && self.dx.is_none() {
                continue;
            }
            // The requested part of this level, relative to its first parameter.
            let own = if from < to { from - params.start..to - params.start } else { 0..0 };
            let grads = if from < to { &mut self.grads.values[from - range.start..to - range.start] } else { &mut [] };
            let (table, _) = self.params[params].as_chunks::<F>();
            let offsets = level.grid.offsets();
            for at in (0..self.x.rows).step_by(BLOCK) {
                let n = BLOCK.min(self.x.rows - at);
                for (f, channel) in level.outputs.iter().enumerate() {
                    match *channel {
                        Some(c) => dy.iter_mut().zip(&self.dy.channel(c)[at..at + n]).for_each(|(dy, &v)| dy[f] = v),
                        None => dy[..n].iter_mut().for_each(|dy| dy[f] = R::ZERO),
                    }
                }
                located.locate(s, &level.grid, self.x, at, n);
                if !own.is_empty() {
                    for i in 0..n {
                        located.scatter(i, &offsets, &dy[i], grads, &own);
                    }
                }
                if let Some(dx) = &mut self.dx {
                    for i in 0..n {
                        let cell = &table[located.base(i)..];
                        let corners = offsets.map(|o| (0..F).map(|f| cell[o][f] * dy[i][f]).sum());
                        for (d, slope) in located.slopes(i, corners).into_iter().enumerate() {
                            dx.channel(d)[at + i] += slope;
                        }
                    }
                }
            }
        }
    }
}

by_features!(Forward);
by_features!(Backward);

kernel_of_levels!(DenseGridStage);

impl Stage for DenseGridStage {
    fn info(&self) -> Info {
        Info {
            input: 3,
            output: self.outputs,
            params: self.params,
            tape: 0,
            scope: Scope::Row,
            grads: GradKind::Scatter,
            macs: self.levels.len() * (8 * self.features + 16),
            identity: false,
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let shape = |l: &Level| l.grid.side().into_iter().chain([self.features]).collect();
        self.levels
            .iter()
            .map(|l| Parameter { name: format!("{}.table", l.number), shape: shape(l), start: l.start })
            .collect()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        crate::levels::start(seed, params);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn partition(&self) -> Vec<Range<usize>> {
        let f = self.features;
        let slabs = |l: &Level| {
            let start = l.start;
            l.grid.slabs(SLAB / f).into_iter().map(move |r| start + r.start * f..start + r.end * f)
        };
        self.levels.iter().flat_map(slabs).collect()
    }

    fn wgsl(&self) -> Option<Fragment> {
        let code = |l: &Level| {
            let ([x, y, z], [sx, sy, sz]) = (l.grid.side(), l.grid.strides());
            let (cells, start) = ((x - 1) as f32, l.start);
            let value = format!(
                "stage_Level(vec3<u32>({x}u, {y}u, {z}u), vec3<u32>({sx}u, {sy}u, {sz}u), {cells:?}, {start}u)"
            );
            LevelCode { value, outputs: l.outputs.clone() }
        };
        let levels: Vec<_> = self.levels.iter().map(code).collect();
        let constants = format!("const stage_FEATURES = {}u;\n", self.features);
        let functions = functions(&levels, self.outputs);
        Some(Fragment::new(&[&constants, TRILINEAR, include_str!("dense_grid.wgsl"), &functions]))
    }

    fn describe(&self) -> String {
        let cells = |l: Option<&Level>| l.map_or(0, |l| l.grid.side()[0] - 1);
        format!(
            "dense-grid: {} levels x {}, {} to {} cells per side, {} parameters",
            self.levels.len(),
            self.features,
            cells(self.levels.first()),
            cells(self.levels.last()),
            self.params
        )
    }
}

impl Encoder for DenseGridStage {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        ensure(!keep.is_empty(), "dense-grid", "channels", "none kept", "at least one")?;
        let mut stage = Self { levels: vec![], params: 0, outputs: keep.len(), ..self.clone() };
        let mut params = vec![];
        for level in &self.levels {
            let outputs: Vec<_> =
                level.outputs.iter().map(|c| c.and_then(|c| keep.iter().position(|&k| k == c))).collect();
            if outputs.iter().all(Option::is_none) {
                continue;
            }
            let old = self.params_of(level);
            stage.levels.push(Level { outputs, start: stage.params, ..level.clone() });
            stage.params += old.len();
            params.push(old);
        }
        Ok(Reduced { stage: Box::new(stage), params, channels: vec![0, 1, 2] })
    }

    fn coarse_to_fine(&self) -> bool {
        true
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        let cells = |l: &Level| (l.grid.side()[0] - 1) as f64;
        Some(by_channel(self.levels.iter().map(|l| (cells(l), &l.outputs[..])), self.outputs))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vertices_have_the_stated_shape_and_place() {
        let stage =
            DenseGridStage::new(&DenseGrid { levels: 2, features: 1, base_resolution: 2, growth: 1.5 }).unwrap();
        let names: Vec<_> = stage.parameters().into_iter().map(|p| (p.name, p.shape)).collect();
        assert_eq!(names, [("0.table".into(), vec![3, 3, 3, 1]), ("1.table".into(), vec![4, 4, 4, 1])]);
        // Each vertex of level 0 holds 100·i + 10·j + k, which is linear, so that interpolation is exact.
        let mut params = vec![0.0f64; stage.info().params];
        for v in 0..27 {
            params[v] = (100 * (v / 9) + 10 * (v / 3 % 3) + v % 3) as f64;
        }
        let mut y = vec![0.0; 2];
        let x = [0.75, 0.5, 0.125];
        stage.forward(&params, Tile::new(&x, 1), TileMut::new(&mut y, 1), TileMut::new(&mut [], 1));
        assert!((y[0] - (150.0 + 10.0 + 0.25)).abs() < 1e-12 && y[1] == 0.0, "{y:?}");
    }

    #[test]
    fn too_many_parameters_are_refused_with_words() {
        for s in [
            DenseGrid { levels: 8, ..DenseGrid::default() },
            DenseGrid { levels: 32, growth: 16.0, base_resolution: 1 << 20, ..DenseGrid::default() },
        ] {
            let e = DenseGridStage::new(&s).unwrap_err().to_string();
            assert!(e.contains("levels") && e.contains("2^31") && e.contains("hash-grid"), "{e}");
        }
    }
}
