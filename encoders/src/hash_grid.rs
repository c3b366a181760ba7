//! Multi-resolution hash grid (Müller et al. 2022, Instant Neural Graphics Primitives, section 3).
//!
//! Points `[n, 3]` in the unit cube to `[n, levels·features]`: on each level the features of the 8 corners of the
//! point's cell, trilinearly interpolated. A level whose vertices fit into the table is indexed directly, a finer one
//! by `h(c) = (c_x·π₁ ⊕ c_y·π₂ ⊕ c_z·π₃) mod T` with products modulo 2³² by definition.

use crate::levels::{self, BLOCK, LevelCode, by_channel, functions, kernel_of_levels, prefetch};
use conefield_core::error::{Result, ensure};
use conefield_core::settings::EncoderSpec;
use conefield_core::simd::{Op, Real, Simd, SimdBase, SimdFloat, V, load, run, store};
use conefield_core::stage::{Encoder, GradKind, Grads, Info, Kernel, Parameter, Reduced, Scope, Stage, Tile, TileMut};
use conefield_core::wgsl::Fragment;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Published hash function.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Convention {
    /// From torch-ngp, also used by NAF, SAX-NeRF and NI-NeRF: primes 1, 19349663, 83492791.
    Naf,
    /// From the paper (equation 4): primes 1, 2654435761, 805459861.
    InstantNgp,
}

impl Convention {
    fn primes(self) -> [u32; 3] {
        match self {
            Self::Naf => [1, 19_349_663, 83_492_791],
            Self::InstantNgp => [1, 2_654_435_761, 805_459_861],
        }
    }
}

/// Settings of `hash-grid`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct HashGrid {
    /// Published hash function.
    pub convention: Convention,
    /// Number of levels, coarse to fine.
    pub levels: usize,
    /// Features per level: 1, 2, 4 or 8.
    pub features: usize,
    /// Cells along the cube's side on the coarsest level.
    pub base_resolution: u32,
    /// Ratio of consecutive levels' resolutions.
    pub growth: f64,
    /// Largest table, as a power of two.
    #[schemars(extend("x-log2-memory" = true))]
    pub log2_table_size: u32,
}

impl Default for HashGrid {
    fn default() -> Self {
        Self {
            convention: Convention::Naf,
            levels: 10,
            features: 2,
            base_resolution: 16,
            growth: 2.0,
            log2_table_size: 19,
        }
    }
}

conefield_core::stage_type!(
    Encoder,
    "hash-grid",
    HashGrid,
    "multi-resolution hash grid",
    example = r#"{"levels": 3, "log2_table_size": 8, "base_resolution": 4}"#
);

#[typetag::serde(name = "hash-grid")]
impl EncoderSpec for HashGrid {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        Ok(Box::new(HashGridStage::new(self)?))
    }
}

/// Positions are `f32`: a finer grid leaves no fraction of a cell for interpolation.
const FINEST: f64 = 8_388_608.0;

#[derive(Debug, Clone, PartialEq)]
struct Level {
    /// `pos = x·scale + 0.5`.
    scale: f64,
    /// Vertices per side.
    side: u32,
    /// Entries of the table.
    entries: u32,
    /// Whether the level is indexed directly.
    dense: bool,
    /// Index of the first entry among all levels.
    start: usize,
    /// Index of the level in the settings, which names its parameters.
    number: usize,
    /// Output channel of each feature; `None` if unused.
    outputs: Vec<Option<usize>>,
}

/// The stage that [`HashGrid`] builds.
#[derive(Debug, Clone)]
pub struct HashGridStage {
    settings: HashGrid,
    primes: [u32; 3],
    levels: Vec<Level>,
    entries: usize,
    outputs: usize,
}

impl HashGridStage {
    /// Builds the stage, or names the setting that is out of range.
    pub fn new(settings: &HashGrid) -> Result<Self> {
        let s = settings;
        let bad = |field: &str, found: String, expected: &str| ensure(false, "spec", field, found, expected);
        if !(1..=32).contains(&s.levels) {
            bad("levels", s.levels.to_string(), "1 to 32")?;
        }
        if ![1, 2, 4, 8].contains(&s.features) {
            bad("features", s.features.to_string(), "1, 2, 4 or 8")?;
        }
        if !(2..=1 << 20).contains(&s.base_resolution) {
            bad("base_resolution", s.base_resolution.to_string(), "2 to 2^20")?;
        }
        if !(s.growth >= 1.0 && s.growth <= 16.0) {
            bad("growth", s.growth.to_string(), "1 to 16")?;
        }
        if !(4..=28).contains(&s.log2_table_size) {
            bad("log2_table_size", s.log2_table_size.to_string(), "4 to 28")?;
        }
        let table = 1u64 << s.log2_table_size;
        let mut levels = Vec::with_capacity(s.levels);
        let mut start = 0usize;
        for l in 0..s.levels {
            let resolution = f64::from(s.base_resolution) * s.growth.powi(l as i32);
            if resolution > FINEST {
                bad(
                    "levels",
                    format!("level {l} with {resolution:.0} cells per side"),
                    "at most 2^23 cells per side (positions are single precision): fewer levels or less growth",
                )?;
            }
            let scale = resolution - 1.0;
            // Cells range from floor(0.5) to floor(scale + 0.5), and each has a corner one further.
            let side = (scale + 0.5).floor() as u64 + 2;
            let vertices = u128::from(side).pow(3);
            let dense = vertices <= u128::from(table);
            let entries = if dense { vertices as u64 } else { table };
            levels.push(Level {
                scale,
                side: side as u32,
                entries: entries as u32,
                dense,
                start,
                number: l,
                outputs: (0..s.features).map(|f| Some(l * s.features + f)).collect(),
            });
            start += entries as usize;
        }
        Ok(Self {
            primes: s.convention.primes(),
            outputs: s.levels * s.features,
            entries: start,
            levels,
            settings: s.clone(),
        })
    }

    fn params_of(&self, level: &Level) -> Range<usize> {
        let f = self.settings.features;
        level.start * f..(level.start + level.entries as usize) * f
    }
}

/// Cells of a block's rows on one level. The corners of a cell are the ends of four edges along x; edge `e` has the
/// larger y if `e & 1` is set and the larger z if `e & 2` is.
struct Located<R> {
    /// Cell of each row.
    cell: [[u32; BLOCK]; 3],
    /// Position within the cell.
    fraction: [[R; BLOCK]; 3],
    /// Entry of each edge's end with the smaller x.
    near: [[u32; BLOCK]; 4],
    /// Entry of the other end. On a dense level it is the next entry and is not stored here.
    far: [[u32; BLOCK]; 4],
    /// Weight of each edge.
    weight: [[R; BLOCK]; 4],
}

impl<R: Real> Located<R> {
    fn new() -> Self {
        let (entries, numbers) = ([0; BLOCK], [R::ZERO; BLOCK]);
        Self { cell: [entries; 3], fraction: [numbers; 3], near: [entries; 4], far: [entries; 4], weight: [numbers; 4] }
    }

    /// Locates rows `at..at + n` of `x`. Points outside the cube are clamped to its rim.
    #[inline(always)]
    fn locate<S: Simd>(&mut self, s: S, level: &Level, primes: [u32; 3], x: Tile<'_, R>, at: usize, n: usize) {
        let number = |x: f64| V::<S, R>::splat(s, R::of(x));
        let (zero, half, scale, top) = (number(0.0), number(0.5), number(level.scale), number(level.scale + 0.5));
        // `top` may have been rounded up to the start of another cell.
        let last = number(f64::from(level.side - 2));
        for d in 0..3 {
            let x = &x.channel(d)[at..at + n];
            let mut i = 0;
            while i < n {
                // NaN becomes 0 here: the precise maximum returns its other operand.
                let p = load(s, x, i).mul_add(scale, half).max_precise(zero).min(top);
                let c = p.floor().min(last);
                store::<S, R>(p - c, &mut self.fraction[d], i);
                R::cells(s, c, &mut self.cell[d][i..]);
                i += V::<S, R>::LEN;
            }
        }
        // These loops process the whole block, even if it has fewer rows: a constant length makes them faster.
        let [cx, cy, cz] = &self.cell;
        if level.dense {
            let (sy, sz) = (level.side, level.side * level.side);
            for i in 0..BLOCK {
                let base = cx[i] + cy[i] * sy + cz[i] * sz;
                for e in 0..4u32 {
                    self.near[e as usize][i] = base + (e & 1) * sy + (e >> 1) * sz;
                }
            }
        } else {
            let mask = level.entries - 1;
            for i in 0..BLOCK {
                let (y0, z0) = (cy[i].wrapping_mul(primes[1]), cz[i].wrapping_mul(primes[2]));
                let (y1, z1) = (y0.wrapping_add(primes[1]), z0.wrapping_add(primes[2]));
                let (x0, x1) = (cx[i].wrapping_mul(primes[0]), (cx[i] + 1).wrapping_mul(primes[0]));
                for e in 0..4 {
                    let (y, z) = (if e & 1 == 0 { y0 } else { y1 }, if e & 2 == 0 { z0 } else { z1 });
                    self.near[e][i] = (x0 ^ y ^ z) & mask;
                    self.far[e][i] = (x1 ^ y ^ z) & mask;
                }
            }
        }
        let [_, fy, fz] = &self.fraction;
        for e in 0..4 {
            for i in 0..BLOCK {
                let y = if e & 1 == 0 { R::ONE - fy[i] } else { fy[i] };
                let z = if e & 2 == 0 { R::ONE - fz[i] } else { fz[i] };
                self.weight[e][i] = y * z;
            }
        }
    }

    /// For each of the first `n` rows, whether it is the last one before a row in another cell; and their number.
    #[inline(always)]
    fn leaving(&self, n: usize) -> ([bool; BLOCK], usize) {
        let mut leaves = [true; BLOCK];
        let [cx, cy, cz] = &self.cell;
        for i in 0..BLOCK - 1 {
            leaves[i] = (cx[i] != cx[i + 1]) | (cy[i] != cy[i + 1]) | (cz[i] != cz[i + 1]);
        }
        leaves[n - 1] = true;
        let count = leaves[..n].iter().map(|&l| usize::from(l)).sum();
        (leaves, count)
    }

    /// Entries of the two ends of edge `e` of row `i`, on a dense or hashed level.
    #[inline(always)]
    fn ends(&self, dense: bool, e: usize, i: usize) -> [u32; 2] {
        let near = self.near[e][i];
        [near, if dense { near + 1 } else { self.far[e][i] }]
    }

    /// Weights of an edge's two ends for row `i`, in the layout of [`fours`].
    #[inline(always)]
    fn along<S: Simd, const F: usize>(&self, s: S, i: usize) -> [R::Four<S>; 4] {
        let f = self.fraction[0][i];
        fours(s, &[[R::ONE - f; F], [f; F]])
    }
}

/// Entry `i` of a level's table, with `i` from [`Located::locate`] for the same level.
#[inline(always)]
#[allow(unsafe_code)]
fn entry<T>(table: &[T], i: u32) -> &T {
    // SAFETY: callers slice `table` to the level's `entries`. `locate` yields indices below that: a hash is masked
    // by `entries - 1`, and direct indices come from cells clamped to `side - 2`, whose corners end at `side³ - 1`.
    unsafe { levels::entry(table, i) }
}

/// Mutable version of [`entry`].
#[inline(always)]
#[allow(unsafe_code)]
fn entry_mut<T>(table: &mut [T], i: u32) -> &mut T {
    // SAFETY: as for `entry`.
    unsafe { levels::entry_mut(table, i) }
}

/// The features of an edge's two ends, one after the other, in registers of four, of which [`registers`] are used.
/// Otherwise the compiler vectorizes over rows and gathers their entries number by number, which takes several times as
/// long as one read per entry.
#[inline(always)]
fn fours<S: Simd, R: Real, const F: usize>(s: S, ends: &[[R; F]; 2]) -> [R::Four<S>; 4] {
    let mut lanes = [[R::ZERO; 4]; 4];
    for f in 0..F {
        lanes[f / 4][f % 4] = ends[0][f];
        lanes[(F + f) / 4][(F + f) % 4] = ends[1][f];
    }
    let mut all = [R::Four::<S>::splat(s, R::ZERO); 4];
    for q in 0..registers(F) {
        all[q] = R::Four::<S>::from_slice(s, &lanes[q]);
    }
    all
}

const fn registers(features: usize) -> usize {
    (2 * features).div_ceil(4)
}

/// Adds `sums`, in the layout of [`fours`], to two entries.
#[inline(always)]
fn add<S: Simd, R: Real, const F: usize>(s: S, grads: &mut [[R; F]], ends: [u32; 2], sums: [R::Four<S>; 4]) {
    // The two always differ: the hashes of neighbours differ in their last bit.
    let mut new = fours(s, &ends.map(|i| *entry(grads, i)));
    for q in 0..registers(F) {
        new[q] += sums[q];
    }
    for (k, i) in ends.into_iter().enumerate() {
        let to = entry_mut(grads, i);
        for f in 0..F {
            to[f] = new[(k * F + f) / 4].as_slice()[(k * F + f) % 4];
        }
    }
}

/// The features of the first `n` rows at `located`, on a `DENSE` or hashed level.
#[inline(always)]
fn interpolate<S: Simd, R: Real, const F: usize, const DENSE: bool>(
    s: S,
    table: &[[R; F]],
    located: &Located<R>,
    n: usize,
    out: &mut [[R; F]; BLOCK],
) {
    for i in 0..n {
        let mut sum = [R::Four::<S>::splat(s, R::ZERO); 4];
        for e in 0..4 {
            let ends = located.ends(DENSE, e, i).map(|i| *entry(table, i));
            let (w, ends) = (R::Four::<S>::splat(s, located.weight[e][i]), fours(s, &ends));
            for q in 0..registers(F) {
                sum[q] = ends[q].mul_add(w, sum[q]);
            }
        }
        let along = located.along::<S, F>(s, i);
        if F < 4 {
            let both = sum[0] * along[0];
            let other = if F == 1 { both.rotate_elements_left::<1>() } else { both.rotate_elements_left::<2>() };
            out[i].copy_from_slice(&(both + other).as_slice()[..F]);
        } else {
            for q in 0..F / 4 {
                let other = q + F / 4;
                let both = sum[other].mul_add(along[other], sum[q] * along[q]);
                out[i][4 * q..4 * q + 4].copy_from_slice(both.as_slice());
            }
        }
    }
}

struct Forward<'a, R> {
    stage: &'a HashGridStage,
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
        for level in &self.stage.levels[self.levels.clone()] {
            let (table, _) = self.params[self.stage.params_of(level)].as_chunks::<F>();
            assert_eq!(table.len(), level.entries as usize);
            for at in (0..self.x.rows).step_by(BLOCK) {
                let n = BLOCK.min(self.x.rows - at);
                located.locate(s, level, self.stage.primes, self.x, at, n);
                if level.dense {
                    interpolate::<S, R, F, true>(s, table, &located, n, &mut out);
                } else {
                    prefetch(table, located.near.iter().chain(&located.far), n);
                    interpolate::<S, R, F, false>(s, table, &located, n, &mut out);
                }
                for (f, channel) in level.outputs.iter().enumerate() {
                    if let Some(c) = *channel {
                        for (y, out) in self.y.channel(c)[at..at + n].iter_mut().zip(&out) {
                            *y = out[f];
                        }
                    }
                }
            }
        }
    }
}

impl<R: Real> Op for Forward<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        match self.stage.settings.features {
            1 => self.features::<S, 1>(s),
            2 => self.features::<S, 2>(s),
            4 => self.features::<S, 4>(s),
            _ => self.features::<S, 8>(s),
        }
    }
}

/// Adds the contributions of the first `n` rows at `located` to a level's gradients. If many consecutive rows share a
/// cell, they are summed first: the entries are then read and written once for all of them, and no row waits for the
/// writes of the previous one.
#[inline(always)]
fn scatter<S: Simd, R: Real, const F: usize, const DENSE: bool>(
    s: S,
    grads: &mut [[R; F]],
    located: &Located<R>,
    dy: &[[R; F]; BLOCK],
    n: usize,
) {
    let (leaves, cells) = located.leaving(n);
    let together = 3 * cells <= n;
    let zero = R::Four::<S>::splat(s, R::ZERO);
    let mut sums = [[zero; 4]; 4];
    for i in 0..n {
        let (along, mut part) = (located.along::<S, F>(s, i), fours(s, &[dy[i]; 2]));
        for q in 0..registers(F) {
            part[q] *= along[q];
        }
        if together {
            for e in 0..4 {
                let w = R::Four::<S>::splat(s, located.weight[e][i]);
                for q in 0..registers(F) {
                    sums[e][q] = part[q].mul_add(w, sums[e][q]);
                }
            }
            if leaves[i] {
                for e in 0..4 {
                    add(s, grads, located.ends(DENSE, e, i), sums[e]);
                }
                sums = [[zero; 4]; 4];
            }
        } else {
            for e in 0..4 {
                let w = R::Four::<S>::splat(s, located.weight[e][i]);
                let mut own = [zero; 4];
                for q in 0..registers(F) {
                    own[q] = part[q] * w;
                }
                add(s, grads, located.ends(DENSE, e, i), own);
            }
        }
    }
}

struct Backward<'a, R> {
    stage: &'a HashGridStage,
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
        let (mut dy, zeros) = ([[R::ZERO; F]; BLOCK], [R::ZERO; BLOCK]);
        if let Some(dx) = &mut self.dx {
            dx.data.fill(R::ZERO);
        }
        for level in &self.stage.levels {
            let params = self.stage.params_of(level);
            let range = self.grads.range.clone();
            let (from, to) = (params.start.max(range.start), params.end.min(range.end));
            if from >= to && self.dx.is_none() {
                continue;
            }
            // If only part of a level is requested, the rest is summed too, into a separate buffer: the order of
            // summation stays the same.
            let part = if from < to && to - from < params.len() { params.len() } else { 0 };
            let mut beside = vec![R::ZERO; part];
            let own = if from < to { from - range.start..to - range.start } else { 0..0 };
            let place = if part > 0 { from - params.start..to - params.start } else { 0..0 };
            if part > 0 {
                beside[place.clone()].copy_from_slice(&self.grads.values[own.clone()]);
            }
            let grads = if part > 0 { &mut beside[..] } else { &mut self.grads.values[own.clone()] };
            let (grads, _) = grads.as_chunks_mut::<F>();
            assert!(grads.is_empty() || grads.len() == level.entries as usize);
            for at in (0..self.x.rows).step_by(BLOCK) {
                let n = BLOCK.min(self.x.rows - at);
                let mut channels = [&zeros[..n]; F];
                for (from, channel) in channels.iter_mut().zip(&level.outputs) {
                    if let Some(c) = *channel {
                        *from = &self.dy.channel(c)[at..at + n];
                    }
                }
                for i in 0..n {
                    for f in 0..F {
                        dy[i][f] = channels[f][i];
                    }
                }
                located.locate(s, level, self.stage.primes, self.x, at, n);
                if !grads.is_empty() {
                    if level.dense {
                        scatter::<S, R, F, true>(s, grads, &located, &dy, n);
                    } else {
                        prefetch(grads, located.near.iter().chain(&located.far), n);
                        scatter::<S, R, F, false>(s, grads, &located, &dy, n);
                    }
                }
                if let Some(dx) = &mut self.dx {
                    let (table, _) = self.params[params.clone()].as_chunks::<F>();
                    for i in 0..n {
                        let v: [R; 8] = std::array::from_fn(|c| {
                            let entry = &table[located.ends(level.dense, c >> 1, i)[c & 1] as usize];
                            (0..F).map(|f| entry[f] * dy[i][f]).sum()
                        });
                        for d in 0..3 {
                            // Beyond the rim a position is clamped, whatever its value.
                            let x = self.x.channel(d)[at + i];
                            if !(x <= R::ONE && x * R::of(level.scale) + R::of(0.5) >= R::ZERO) {
                                continue;
                            }
                            let mut slope = R::ZERO;
                            for c in 0..8 {
                                let mut w = if c >> d & 1 == 1 { R::of(level.scale) } else { R::of(-level.scale) };
                                for e in (0..3).filter(|&e| e != d) {
                                    let fraction = located.fraction[e][i];
                                    w *= if c >> e & 1 == 1 { fraction } else { R::ONE - fraction };
                                }
                                slope += w * v[c];
                            }
                            dx.channel(d)[at + i] += slope;
                        }
                    }
                }
            }
            if part > 0 {
                self.grads.values[own].copy_from_slice(&beside[place]);
            }
        }
    }
}

impl<R: Real> Op for Backward<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        match self.stage.settings.features {
            1 => self.features::<S, 1>(s),
            2 => self.features::<S, 2>(s),
            4 => self.features::<S, 4>(s),
            _ => self.features::<S, 8>(s),
        }
    }
}

kernel_of_levels!(HashGridStage);

impl Stage for HashGridStage {
    fn info(&self) -> Info {
        let f = self.settings.features;
        Info {
            input: 3,
            output: self.outputs,
            params: self.entries * f,
            tape: 0,
            scope: Scope::Row,
            grads: GradKind::Scatter,
            macs: self.levels.len() * (8 * f + 16),
            identity: false,
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let f = self.settings.features;
        self.levels
            .iter()
            .map(|l| Parameter {
                name: format!("{}.table", l.number),
                shape: vec![l.entries as usize, f],
                start: l.start * f,
            })
            .collect()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        levels::start(seed, params);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn partition(&self) -> Vec<Range<usize>> {
        self.levels.iter().map(|l| self.params_of(l)).collect()
    }

    fn wgsl(&self) -> Option<Fragment> {
        let f = self.settings.features;
        let code = |l: &Level| {
            let (side, start) = (if l.dense { l.side } else { 0 }, u32::try_from(l.start * f).ok()?);
            let (scale, last) = (l.scale as f32, (l.side - 2) as f32);
            let value = format!("stage_Level({scale:?}, {last:?}, {side}u, {}u, {start}u)", l.entries - 1);
            Some(LevelCode { value, outputs: l.outputs.clone() })
        };
        let levels = self.levels.iter().map(code).collect::<Option<Vec<_>>>()?;
        let [x, y, z] = self.primes;
        let constants = format!("const stage_FEATURES = {f}u;\nconst stage_PRIMES = vec3<u32>({x}u, {y}u, {z}u);\n");
        Some(Fragment::new(&[&constants, include_str!("hash_grid.wgsl"), &functions(&levels, self.outputs)]))
    }

    fn describe(&self) -> String {
        let side = |l: Option<&Level>| l.map_or(0.0, |l| l.scale + 1.0);
        format!(
            "hash-grid: {} levels x {}, {:.0} to {:.0} cells per side, tables up to 2^{}, {} of them direct",
            self.levels.len(),
            self.settings.features,
            side(self.levels.first()),
            side(self.levels.last()),
            self.settings.log2_table_size,
            self.levels.iter().filter(|l| l.dense).count()
        )
    }
}

impl Encoder for HashGridStage {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        let mut stage = Self { levels: vec![], entries: 0, outputs: keep.len(), ..self.clone() };
        let mut params = vec![];
        for level in &self.levels {
            let outputs: Vec<_> =
                level.outputs.iter().map(|c| c.and_then(|c| keep.iter().position(|&k| k == c))).collect();
            if outputs.iter().all(Option::is_none) {
                continue;
            }
            params.push(self.params_of(level));
            stage.levels.push(Level { outputs, start: stage.entries, ..level.clone() });
            stage.entries += level.entries as usize;
        }
        Ok(Reduced { stage: Box::new(stage), params, channels: (0..3).collect() })
    }

    fn coarse_to_fine(&self) -> bool {
        true
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        Some(by_channel(self.levels.iter().map(|l| (l.scale + 1.0, &l.outputs[..])), self.outputs))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Locate<'a, R>(&'a mut Located<R>, &'a Level, [u32; 3], Tile<'a, R>);
    impl<R: Real> Op for Locate<'_, R> {
        type Number = R;
        type Out = ();
        #[inline(always)]
        fn call<S: Simd>(self, s: S) {
            self.0.locate(s, self.1, self.2, self.3, 0, 1);
        }
    }

    /// The published index, in exact arithmetic.
    fn index(level: &Level, primes: [u64; 3], c: [u64; 3]) -> u64 {
        if level.dense {
            let s = u64::from(level.side);
            c[0] + s * (c[1] + s * c[2])
        } else {
            let h = (0..3).fold(0u64, |h, d| h ^ (c[d] * primes[d] % (1 << 32)));
            h % u64::from(level.entries)
        }
    }

    #[test]
    fn corners_match_the_published_hash_on_every_level() {
        let settings = HashGrid { levels: 16, log2_table_size: 14, ..HashGrid::default() };
        let stage = HashGridStage::new(&settings).unwrap();
        let primes = settings.convention.primes().map(u64::from);
        for level in &stage.levels {
            for p in [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.3, 0.71, 0.999], [0.5, 0.25, 0.125f64]] {
                let mut located = Located::<f64>::new();
                let data: Vec<f64> = p.to_vec();
                run(Locate(&mut located, level, stage.primes, Tile::new(&data, 1)));
                let cell = p.map(|x| (x * level.scale + 0.5).floor() as u64);
                let mut total = 0.0;
                for c in 0..8u64 {
                    let corner = [cell[0] + (c & 1), cell[1] + (c >> 1 & 1), cell[2] + (c >> 2)];
                    assert!(corner.iter().all(|&v| v < u64::from(level.side)));
                    let (e, end) = ((c >> 1) as usize, (c & 1) as usize);
                    assert_eq!(u64::from(located.ends(level.dense, e, 0)[end]), index(level, primes, corner));
                    let x = located.fraction[0][0];
                    total += located.weight[e][0] * if end == 0 { 1.0 - x } else { x };
                }
                assert!((total - 1.0).abs() < 1e-12);
            }
        }
        // NAF's first three levels (17³, 33³, … vertices), and which of them are indexed directly with 2^19 entries.
        let naf = HashGridStage::new(&HashGrid::default()).unwrap();
        let entries: Vec<_> = naf.levels.iter().take(4).map(|l| (l.entries, l.dense)).collect();
        assert_eq!(entries, [(4913, true), (35937, true), (274_625, true), (524_288, false)]);
    }

    /// At the rim of these levels `scale + 0.5`, just below an integer, rounds to it in single precision.
    #[test]
    fn rounding_at_the_rim_stays_inside_the_table() {
        for (base_resolution, growth) in [(25, 1.14), (50, 1.13), (50, 1.15), (50, 2.01), (30, 2.05)] {
            let stage =
                HashGridStage::new(&HashGrid { levels: 2, base_resolution, growth, ..HashGrid::default() }).unwrap();
            let level = &stage.levels[1];
            let up = (level.scale + 0.5) as f32;
            assert!(f64::from(up) > level.scale + 0.5 && up.fract() == 0.0, "{base_resolution} x {growth}");
            for x in [1.0f32, 2.0, f32::INFINITY] {
                let mut located = Located::<f32>::new();
                run(Locate(&mut located, level, stage.primes, Tile::new(&[x; 3], 1)));
                let mut ends = located.near.iter().chain(&located.far);
                assert!(ends.all(|i| i[0] < level.entries), "{base_resolution} x {growth} at {x}");
                let total: f32 = located.weight.iter().map(|w| w[0]).sum();
                assert!((total - 1.0).abs() < 1e-6 && (0.0..=1.0).contains(&located.fraction[0][0]));
            }
        }
    }

    /// Moving a clamped coordinate changes nothing: its gradient is 0; those of the others are not.
    #[test]
    fn clamped_positions_have_no_gradient() {
        let stage = HashGridStage::new(&HashGrid { levels: 2, ..HashGrid::default() }).unwrap();
        let info = stage.info();
        let mut params = vec![0.0f64; info.params];
        params.iter_mut().enumerate().for_each(|(i, p)| *p = ((i * 7919) % 101) as f64 / 101.0);
        // Channel by channel: x clamped below, y inside, z clamped above; then all inside.
        let (x, rows) = ([-0.3, 0.4, 0.45, 0.7, 1.4, 0.9], 2);
        let dy = vec![1.0; info.output * rows];
        let (mut grads, mut dx) = (vec![0.0; info.params], vec![0.0; 3 * rows]);
        let into = Grads { values: &mut grads, range: 0..info.params };
        let kernel: &dyn Kernel<f64> = &stage;
        let (tape, into_x) = (TileMut::new(&mut [], rows), Some(TileMut::new(&mut dx, rows)));
        kernel.backward(&params, Tile::new(&x, rows), tape, Tile::new(&dy, rows), into, into_x);
        assert_eq!([dx[0], dx[4]], [0.0, 0.0]);
        assert!([dx[1], dx[2], dx[3], dx[5]].iter().all(|g| *g != 0.0), "{dx:?}");
    }

    #[test]
    fn a_level_past_single_precision_is_refused() {
        let e = HashGridStage::new(&HashGrid { levels: 32, ..HashGrid::default() }).unwrap_err().to_string();
        assert!(e.contains("levels") && e.contains("2^23"), "{e}");
    }

    #[test]
    fn levels_of_which_nothing_is_read_leave_the_stage() {
        let stage = HashGridStage::new(&HashGrid { levels: 3, ..HashGrid::default() }).unwrap();
        let r = stage.keep_outputs(&[0, 5]).unwrap();
        assert_eq!(r.params, [0..9826, 81_700..630_950]);
        assert_eq!(r.stage.info().output, 2);
        assert_eq!(r.stage.parameters()[1].name, "2.table");
    }
}
