//! Multi-resolution hash grid (Müller et al. 2022, Instant Neural Graphics Primitives, section 3).
//!
//! Points `[n, 3]` in the unit cube to `[n, levels·features]`: on each level the features of the 8 corners of the
//! point's cell, trilinearly interpolated. A level whose vertices fit into the table is indexed directly, a finer one
//! by `h(c) = (c_x·π₁ ⊕ c_y·π₂ ⊕ c_z·π₃) mod T` with products modulo 2³² by definition.

use crate::levels::{self, BLOCK, Levels, Rows, SUMS, finest, grid, leaving, prefetch, primes, sizes, table_size};
use conefield_core::prelude::*;
use conefield_core::simd::{Simd, SimdBase, SimdFloat, V, load, store};
use std::ops::{Range, RangeInclusive};

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

grid! {
    "hash-grid", HashGrid of HashLevel,
    "multi-resolution hash grid",
    example = r#"{"levels": 3, "log2_table_size": 8, "base_resolution": 4}"#
}

/// Positions are `f32`: a finer grid leaves no fraction of a cell for interpolation.
const FINEST: f64 = 8_388_608.0;

#[derive(Debug, Clone)]
struct HashLevel {
    /// `pos = x·scale + 0.5`.
    scale: f64,
    /// Vertices per side.
    side: u32,
    /// Entries of the table.
    entries: u32,
    /// Whether the level is indexed directly.
    dense: bool,
    primes: [u32; 3],
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

impl<R: Real> Default for Located<R> {
    fn default() -> Self {
        let (entries, numbers) = ([0; BLOCK], [R::ZERO; BLOCK]);
        Self { cell: [entries; 3], fraction: [numbers; 3], near: [entries; 4], far: [entries; 4], weight: [numbers; 4] }
    }
}

impl<R: Real> Located<R> {
    /// Entries of the two ends of edge `e` of row `i`, on a dense or hashed level.
    #[inline(always)]
    fn ends(&self, dense: bool, e: usize, i: usize) -> [u32; 2] {
        let near = self.near[e][i];
        [near, if dense { near + 1 } else { self.far[e][i] }]
    }

    /// Computes the weights of edges, in the whole block, as `locate` does.
    #[inline(always)]
    fn weigh(&mut self) {
        let [_, fy, fz] = &self.fraction;
        for e in 0..4 {
            for i in 0..BLOCK {
                let y = if e & 1 == 0 { R::ONE - fy[i] } else { fy[i] };
                let z = if e & 2 == 0 { R::ONE - fz[i] } else { fz[i] };
                self.weight[e][i] = y * z;
            }
        }
    }

    /// Weights of an edge's two ends for row `i`, in the layout of [`fours`].
    #[inline(always)]
    fn along<S: Simd, const F: usize>(&self, s: S, i: usize) -> [R::Four<S>; 4] {
        let f = self.fraction[0][i];
        fours(s, &[[R::ONE - f; F], [f; F]])
    }
}

/// Entry `i` of a level's table, with `i` from `locate` for the same level.
#[inline(always)]
#[allow(unsafe_code)]
fn entry<T>(table: &[T], i: u32) -> &T {
    // SAFETY: callers check that `table` has the level's `entries`. `locate` yields indices below that: a hash is masked
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
    let [cx, cy, cz] = &located.cell;
    let (leaves, cells) = leaving(
        n,
        #[inline(always)]
        |i| (cx[i] != cx[i + 1]) | (cy[i] != cy[i + 1]) | (cz[i] != cz[i + 1]),
    );
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

impl levels::Level for HashLevel {
    type Settings = HashGrid;
    type Located<R: Real> = Located<R>;

    const BASE: (RangeInclusive<u32>, &'static str) = (2..=1 << 20, "2 to 2^20");
    const WGSL: &'static [&'static str] = &[SUMS, include_str!("hash_grid.wgsl")];

    fn parts(s: &HashGrid, number: usize, resolution: f64, _: usize) -> Result<Vec<Self>> {
        let table = table_size(s.log2_table_size)?;
        let expected = "at most 2^23 cells per side (positions are single precision): fewer levels or less growth";
        finest(number, resolution, FINEST, expected)?;
        let scale = resolution - 1.0;
        // Cells range from floor(0.5) to floor(scale + 0.5), and each has a corner one further.
        let side = (scale + 0.5).floor() as u32 + 2;
        let vertices = u128::from(side).pow(3);
        let dense = vertices <= u128::from(table);
        let entries = if dense { vertices as u32 } else { table };
        Ok(vec![Self { scale, side, entries, dense, primes: s.convention.primes() }])
    }

    fn resolution(&self) -> f64 {
        self.scale + 1.0
    }

    fn scale(&self) -> [f64; 2] {
        [self.scale, 0.5]
    }

    fn blocks(&self, features: usize) -> Vec<(String, Vec<usize>)> {
        vec![("table".into(), vec![self.entries as usize, features])]
    }

    fn macs(features: usize) -> usize {
        8 * features + 16
    }

    /// Points outside the cube are clamped to its rim.
    #[inline(always)]
    fn locate<S: Simd, R: Real>(&self, s: S, to: &mut Located<R>, x: Tile<'_, R>, at: usize, n: usize) {
        let number = |x: f64| V::<S, R>::splat(s, R::of(x));
        let (zero, half, scale, top) = (number(0.0), number(0.5), number(self.scale), number(self.scale + 0.5));
        // `top` may have been rounded up to the start of another cell.
        let last = number(f64::from(self.side - 2));
        for d in 0..3 {
            let x = &x.channel(d)[at..at + n];
            let mut i = 0;
            while i < n {
                // NaN becomes 0 here: the precise maximum returns its other operand.
                let p = load(s, x, i).mul_add(scale, half).max_precise(zero).min(top);
                let c = p.floor().min(last);
                store::<S, R>(p - c, &mut to.fraction[d], i);
                R::cells(s, c, &mut to.cell[d][i..]);
                i += V::<S, R>::LEN;
            }
        }
        // These loops process the whole block, even if it has fewer rows: a constant length makes them faster.
        let [cx, cy, cz] = &to.cell;
        if self.dense {
            let (sy, sz) = (self.side, self.side * self.side);
            for i in 0..BLOCK {
                let base = cx[i] + cy[i] * sy + cz[i] * sz;
                for e in 0..4u32 {
                    to.near[e as usize][i] = base + (e & 1) * sy + (e >> 1) * sz;
                }
            }
        } else {
            let mask = self.entries - 1;
            for i in 0..BLOCK {
                let (y0, z0) = (cy[i].wrapping_mul(self.primes[1]), cz[i].wrapping_mul(self.primes[2]));
                let (y1, z1) = (y0.wrapping_add(self.primes[1]), z0.wrapping_add(self.primes[2]));
                let (x0, x1) = (cx[i].wrapping_mul(self.primes[0]), (cx[i] + 1).wrapping_mul(self.primes[0]));
                for e in 0..4 {
                    let (y, z) = (if e & 1 == 0 { y0 } else { y1 }, if e & 2 == 0 { z0 } else { z1 });
                    to.near[e][i] = (x0 ^ y ^ z) & mask;
                    to.far[e][i] = (x1 ^ y ^ z) & mask;
                }
            }
        }
        to.weigh();
    }

    #[inline(always)]
    fn gather<S: Simd, R: Real, const F: usize>(&self, s: S, rows: &Rows<'_, Self, R, F>, out: &mut [[R; F]; BLOCK]) {
        let &Rows { located, table, n } = rows;
        assert_eq!(table.len(), self.entries as usize);
        if self.dense {
            interpolate::<S, R, F, true>(s, table, located, n, out);
        } else {
            prefetch(table, located.near.iter().chain(&located.far), n);
            interpolate::<S, R, F, false>(s, table, located, n, out);
        }
    }

    #[inline(always)]
    fn scatter<S: Simd, R: Real, const F: usize>(
        &self,
        s: S,
        rows: &Rows<'_, Self, R, F>,
        dy: &[[R; F]; BLOCK],
        grads: &mut [R],
        _: &Range<usize>,
    ) {
        let &Rows { located, n, .. } = rows;
        let (grads, _) = grads.as_chunks_mut::<F>();
        assert_eq!(grads.len(), self.entries as usize);
        if self.dense {
            scatter::<S, R, F, true>(s, grads, located, dy, n);
        } else {
            prefetch(grads, located.near.iter().chain(&located.far), n);
            scatter::<S, R, F, false>(s, grads, located, dy, n);
        }
    }

    fn move_to<R: Real>(&self, to: &mut Located<R>, d: usize, end: R) {
        to.fraction[d] = [end; BLOCK];
        to.weigh();
    }

    fn code(&self) -> String {
        let (scale, last) = (self.scale as f32, (self.side - 2) as f32);
        format!("{scale:?}, {last:?}, {}u, {}u", if self.dense { self.side } else { 0 }, self.entries - 1)
    }

    fn constants(s: &HashGrid) -> String {
        primes(s.convention.primes())
    }

    fn size(stage: &Levels<Self>) -> String {
        sizes(stage.settings.log2_table_size, stage.levels().filter(|l| l.dense).count())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type HashGridStage = Levels<HashLevel>;

    /// The published index, in exact arithmetic.
    fn index(level: &HashLevel, primes: [u64; 3], c: [u64; 3]) -> u64 {
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
        for level in stage.levels() {
            for p in [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.3, 0.71, 0.999], [0.5, 0.25, 0.125f64]] {
                let located: Located<f64> = levels::located(level, p);
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
        let entries: Vec<_> = naf.levels().take(4).map(|l| (l.entries, l.dense)).collect();
        assert_eq!(entries, [(4913, true), (35937, true), (274_625, true), (524_288, false)]);
    }

    /// At the rim of these levels `scale + 0.5`, just below an integer, rounds to it in single precision.
    #[test]
    fn rounding_at_the_rim_stays_inside_the_table() {
        for (base_resolution, growth) in [(25, 1.14), (50, 1.13), (50, 1.15), (50, 2.01), (30, 2.05)] {
            let stage =
                HashGridStage::new(&HashGrid { levels: 2, base_resolution, growth, ..HashGrid::default() }).unwrap();
            let level = stage.levels().nth(1).unwrap();
            let up = (level.scale + 0.5) as f32;
            assert!(f64::from(up) > level.scale + 0.5 && up.fract() == 0.0, "{base_resolution} x {growth}");
            for x in [1.0f32, 2.0, f32::INFINITY] {
                let located: Located<f32> = levels::located(level, [x; 3]);
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
        stage.backward(Backward {
            params: &params,
            x: Tile::new(&x, rows),
            tape: TileMut::new(&mut [], rows),
            dy: Tile::new(&dy, rows),
            grads: Grads::all(&mut grads),
            dx: Some(TileMut::new(&mut dx, rows)),
        });
        assert_eq!([dx[0], dx[4]], [0.0, 0.0]);
        assert!([dx[1], dx[2], dx[3], dx[5]].iter().all(|g| *g != 0.0), "{dx:?}");
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
