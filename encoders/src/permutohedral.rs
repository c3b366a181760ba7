//! Multi-resolution hash of a permutohedral lattice (Rosu and Behnke 2023, PermutoSDF, section 3.1; the lattice is that
//! of Adams et al. 2010, Fast High-Dimensional Filtering Using the Permutohedral Lattice).
//!
//! Points `[n, 3]` in the unit cube to `[n, levels·features]`: on each level the features of the 4 corners of the
//! point's simplex, weighted by its barycentric coordinates. A hash grid reads 8 corners.
//!
//! In three dimensions the lattice is body-centred cubic. It is the image of the integer lattice under a linear map,
//! and its simplices are those of the Kuhn triangulation: with `u = s·(y + z, x + z, x + y)`, cell `k = ⌊u⌋` and
//! fractions `f_a ≥ f_b ≥ f_c`, the corners are `k`, `k + e_a`, `k + e_a + e_b` and `k + (1, 1, 1)`, and their weights
//! `1 − f_a`, `f_a − f_b`, `f_b − f_c` and `f_c`. The axes of the lattice are thus those of the cube; in the
//! publications they are rotated.
//!
//! A level with `r` cells per side has as many vertices per volume as a cubic grid of `r` cells per side: `s = r/∛2`. A
//! level whose vertices fit into the table is indexed directly, a finer one by the hash of Müller et al. 2022, equation
//! 4, of `k`.

use crate::levels::{
    self, BLOCK, Levels, Rows, SUMS, entry, entry_mut, finest, fold, fours, grid, leaving, prefetch, primes, sizes,
    table_size,
};
use conefield_core::prelude::*;
use conefield_core::simd::{Simd, SimdBase, SimdFloat, V, load, store};
use std::ops::{Range, RangeInclusive};

/// Settings of `permutohedral`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Permutohedral {
    /// Number of levels, coarse to fine.
    pub levels: usize,
    /// Features per level: 1, 2, 4 or 8.
    pub features: usize,
    /// Cells along the cube's side on the coarsest level, for a cubic grid with the same number of vertices.
    pub base_resolution: u32,
    /// Ratio of consecutive levels' resolutions.
    pub growth: f64,
    /// Largest table, as a power of two.
    #[schemars(extend("x-log2-memory" = true))]
    pub log2_table_size: u32,
}

impl Default for Permutohedral {
    fn default() -> Self {
        Self { levels: 10, features: 2, base_resolution: 16, growth: 2.0, log2_table_size: 19 }
    }
}

grid! {
    "permutohedral", Permutohedral of SimplexLevel,
    "multi-resolution hash of a lattice of simplices: 4 corners instead of 8",
    example = r#"{"levels": 3, "log2_table_size": 8, "base_resolution": 4}"#
}

/// Positions are `f32`: a finer lattice leaves no fraction of a cell for interpolation.
const FINEST: f64 = 4_194_304.0;

/// Primes of the hash, as in the paper of Müller et al.
const PRIMES: [u32; 3] = [1, 2_654_435_761, 805_459_861];

#[derive(Debug, Clone)]
struct SimplexLevel {
    /// Cells along the cube's side, for a cubic grid with the same number of vertices.
    resolution: f64,
    /// `s` in the formula.
    scale: f64,
    /// Pairs of vertices per side if the level is indexed directly, else 0.
    side: u32,
    /// Number of entries minus one.
    last: u32,
}

/// Simplices of a block's rows on one level.
struct Located<R> {
    cell: [[u32; BLOCK]; 3],
    fraction: [[R; BLOCK]; 3],
    /// Number of other fractions that precede each one.
    rank: [[u32; BLOCK]; 3],
    /// Entry of each corner.
    entry: [[u32; BLOCK]; 4],
    /// Barycentric coordinates.
    weight: [[R; BLOCK]; 4],
}

impl<R: Real> Default for Located<R> {
    fn default() -> Self {
        let (whole, numbers) = ([0; BLOCK], [R::ZERO; BLOCK]);
        Self { cell: [whole; 3], fraction: [numbers; 3], rank: [whole; 3], entry: [whole; 4], weight: [numbers; 4] }
    }
}

impl<R: Real> Located<R> {
    /// Entries of the corners of row `i`.
    #[inline(always)]
    fn corners(&self, i: usize) -> [u32; 4] {
        [self.entry[0][i], self.entry[1][i], self.entry[2][i], self.entry[3][i]]
    }

    /// Weights of the corners of row `i`, in the layout of [`fours`].
    #[inline(always)]
    fn weights<S: Simd, const F: usize>(&self, s: S, i: usize) -> [R::Four<S>; 8] {
        fours(s, &[[self.weight[0][i]; F], [self.weight[1][i]; F], [self.weight[2][i]; F], [self.weight[3][i]; F]])
    }
}

/// Entry `i` of a level's table, with `i` from `locate` for the same level.
#[inline(always)]
#[allow(unsafe_code)]
fn at<T>(table: &[T], i: u32) -> &T {
    // SAFETY: callers check that `table` has the level's entries. `locate` masks a hash by their number less one, and lowers
    // a direct index to it.
    unsafe { entry(table, i) }
}

/// Adds `sums`, in the layout of [`fours`], to four entries, one after the other: two of them may be the same.
#[inline(always)]
#[allow(unsafe_code)]
fn add<R: Real, const F: usize>(grads: &mut [[R; F]], corners: [u32; 4], sums: &[[R; 4]; 8]) {
    for (c, i) in corners.into_iter().enumerate() {
        // SAFETY: as for `at`.
        let to = unsafe { entry_mut(grads, i) };
        for f in 0..F {
            to[f] += sums[(c * F + f) / 4][(c * F + f) % 4];
        }
    }
}

/// Adds the contributions of the first `n` rows at `located` to a level's gradients. If many consecutive rows share a
/// simplex, they are summed first: the entries are then read and written once for all of them, and no row waits for the
/// writes of the previous one.
#[inline(always)]
fn scatter<S: Simd, R: Real, const F: usize>(
    s: S,
    grads: &mut [[R; F]],
    located: &Located<R>,
    dy: &[[R; F]; BLOCK],
    n: usize,
) {
    let [a, b, c, d] = &located.entry;
    let (leaves, simplices) = leaving(
        n,
        #[inline(always)]
        |i| (a[i] ^ a[i + 1]) | (b[i] ^ b[i + 1]) | (c[i] ^ c[i + 1]) | (d[i] ^ d[i + 1]) != 0,
    );
    let together = 3 * simplices <= n;
    let zero = R::Four::<S>::splat(s, R::ZERO);
    let mut sums = [zero; 8];
    for i in 0..n {
        let (weights, dy) = (located.weights::<S, F>(s, i), fours(s, &[dy[i]; 4]));
        for q in 0..F {
            sums[q] = if together { dy[q].mul_add(weights[q], sums[q]) } else { dy[q] * weights[q] };
        }
        if !together || leaves[i] {
            let mut lanes = [[R::ZERO; 4]; 8];
            for q in 0..F {
                sums[q].store_slice(&mut lanes[q]);
            }
            add(grads, located.corners(i), &lanes);
            sums = [zero; 8];
        }
    }
}

impl levels::Level for SimplexLevel {
    type Settings = Permutohedral;
    type Located<R: Real> = Located<R>;

    const BASE: (RangeInclusive<u32>, &'static str) = (2..=1 << 20, "2 to 2^20");
    const WGSL: &'static [&'static str] = &[SUMS, include_str!("permutohedral.wgsl")];

    fn parts(s: &Permutohedral, number: usize, resolution: f64, _: usize) -> Result<Vec<Self>> {
        let table = table_size(s.log2_table_size)?;
        let expected = "at most 2^22 cells per side (positions are single precision): fewer levels or less growth";
        finest(number, resolution, FINEST, expected)?;
        let scale = resolution * 0.5f64.cbrt();
        // A vertex has integer coordinates X, Y, Z in units of 1/(2s), all even or all odd. Those of a point's simplex
        // lie in [−2, 2s + 2], because rounding may move the point slightly; a pair is an even vertex and the odd one
        // after it.
        let side = (((2.0 * scale + 1e-2).ceil() as u32 + 3) >> 1) + 1;
        let vertices = 2 * u128::from(side).pow(3);
        let direct = vertices <= u128::from(table);
        let (side, entries) = if direct { (side, vertices as u32) } else { (0, table) };
        Ok(vec![Self { resolution, scale, side, last: entries - 1 }])
    }

    fn resolution(&self) -> f64 {
        self.resolution
    }

    fn scale(&self) -> [f64; 2] {
        [self.scale, 0.0]
    }

    fn blocks(&self, features: usize) -> Vec<(String, Vec<usize>)> {
        vec![("table".into(), vec![self.last as usize + 1, features])]
    }

    fn macs(features: usize) -> usize {
        4 * features + 9
    }

    /// Points outside the cube are clamped to its rim, a NaN coordinate to 0.
    #[inline(always)]
    fn locate<S: Simd, R: Real>(&self, s: S, to: &mut Located<R>, x: Tile<'_, R>, at: usize, n: usize) {
        let number = |v: f64| V::<S, R>::splat(s, R::of(v));
        let (zero, one, scale) = (number(0.0), number(1.0), number(self.scale));
        let [x, y, z] = [0, 1, 2].map(|d| &x.channel(d)[at..at + n]);
        for (d, [a, b]) in [[y, z], [x, z], [x, y]].into_iter().enumerate() {
            let mut i = 0;
            while i < n {
                // The precise maximum returns the number if the other operand is NaN.
                let a = load(s, a, i).max_precise(zero).min(one);
                let b = load(s, b, i).max_precise(zero).min(one);
                let u = (a + b) * scale;
                let k = u.floor();
                store::<S, R>(u - k, &mut to.fraction[d], i);
                R::cells(s, k, &mut to.cell[d][i..]);
                i += V::<S, R>::LEN;
            }
        }
        // These loops process the whole block, even if it has fewer rows: a constant length makes them faster.
        let [f, g, h] = &to.fraction;
        for i in 0..BLOCK {
            let (fg, fh, gh) = (u32::from(f[i] >= g[i]), u32::from(f[i] >= h[i]), u32::from(g[i] >= h[i]));
            to.rank[0][i] = 2 - fg - fh;
            to.rank[1][i] = 1 + fg - gh;
            to.rank[2][i] = fh + gh;
        }
        for i in 0..BLOCK {
            let (more, less) = if f[i] >= g[i] { (f[i], g[i]) } else { (g[i], f[i]) };
            let (top, rest) = if more >= h[i] { (more, h[i]) } else { (h[i], more) };
            let (middle, bottom) = if rest >= less { (rest, less) } else { (less, rest) };
            to.weight[0][i] = R::ONE - top;
            to.weight[1][i] = top - middle;
            to.weight[2][i] = middle - bottom;
            to.weight[3][i] = bottom;
        }
        let ([a, b, c], [p, q, r]) = (&to.cell, &to.rank);
        for (corner, entry) in to.entry.iter_mut().enumerate() {
            let corner = corner as u32;
            if self.side == 0 {
                for i in 0..BLOCK {
                    let k = (a[i] + u32::from(p[i] < corner)).wrapping_mul(PRIMES[0]);
                    let l = (b[i] + u32::from(q[i] < corner)).wrapping_mul(PRIMES[1]);
                    let m = (c[i] + u32::from(r[i] < corner)).wrapping_mul(PRIMES[2]);
                    entry[i] = (k ^ l ^ m) & self.last;
                }
            } else {
                for i in 0..BLOCK {
                    let k = a[i] + u32::from(p[i] < corner);
                    let l = b[i] + u32::from(q[i] < corner);
                    let m = c[i] + u32::from(r[i] < corner);
                    // X, Y, Z plus 2, so that none is negative.
                    let two = 2 + k + l + m;
                    let (x, y, z) = (two - 2 * k, two - 2 * l, two - 2 * m);
                    let pair = ((x >> 1) * self.side + (y >> 1)) * self.side + (z >> 1);
                    entry[i] = (2 * pair + (x & 1)).min(self.last);
                }
            }
        }
    }

    #[inline(always)]
    fn gather<S: Simd, R: Real, const F: usize>(&self, s: S, rows: &Rows<'_, Self, R, F>, out: &mut [[R; F]; BLOCK]) {
        let &Rows { located, table, n } = rows;
        assert_eq!(table.len(), self.last as usize + 1);
        if self.side == 0 {
            prefetch(table, located.entry.iter(), n);
        }
        for i in 0..n {
            let corners = fours(s, &located.corners(i).map(|c| *at(table, c)));
            let weights = located.weights::<S, F>(s, i);
            let mut sum = [corners[0] * weights[0], R::Four::<S>::splat(s, R::ZERO)];
            for q in 1..F {
                let to = if F == 8 { q % 2 } else { 0 };
                sum[to] = corners[q].mul_add(weights[q], sum[to]);
            }
            out[i] = fold::<S, R, F>(sum);
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
        assert_eq!(grads.len(), self.last as usize + 1);
        if self.side == 0 {
            prefetch(grads, located.entry.iter(), n);
        }
        scatter(s, grads, located, dy, n);
    }

    /// Along an axis two fractions grow. The weight of the corner that a fraction adds to grows with it, that of the one
    /// before falls.
    fn move_to<R: Real>(&self, to: &mut Located<R>, d: usize, end: R) {
        to.weight = [[R::ZERO; BLOCK]; 4];
        for rank in [(d + 1) % 3, (d + 2) % 3].map(|fraction| to.rank[fraction]) {
            for (i, rank) in rank.into_iter().enumerate() {
                to.weight[rank as usize + 1][i] += end;
                to.weight[rank as usize][i] -= end;
            }
        }
    }

    fn code(&self) -> String {
        format!("{:?}, {}u, {}u", self.scale as f32, self.side, self.last)
    }

    fn constants(_: &Permutohedral) -> String {
        primes(PRIMES)
    }

    fn size(stage: &Levels<Self>) -> String {
        sizes(stage.settings.log2_table_size, stage.levels().filter(|l| l.side > 0).count())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type PermutohedralStage = Levels<SimplexLevel>;

    fn stage(base_resolution: u32, growth: f64, log2_table_size: u32) -> PermutohedralStage {
        let settings =
            Permutohedral { levels: 2, base_resolution, growth, log2_table_size, ..Permutohedral::default() };
        PermutohedralStage::new(&settings).unwrap()
    }

    /// Cartesian coordinates of a corner, in units of `1/(2s)`; see the linear map.
    fn vertex(located: &Located<f64>, corner: u32) -> [i64; 3] {
        let k = [0, 1, 2].map(|d| i64::from(located.cell[d][0] + u32::from(located.rank[d][0] < corner)));
        let sum: i64 = k.iter().sum();
        k.map(|k| sum - 2 * k)
    }

    /// The lattice is that of Adams et al.: a point is the weighted mean of its simplex's corners; of all nearby
    /// vertices the four are those whose Voronoi cells meet in the simplex (edges have the two lengths of that
    /// lattice); and every vertex of a directly indexed level has its own entry.
    #[test]
    fn simplices_are_those_of_the_body_centred_lattice() {
        let stage = stage(5, 1.7, 12);
        for level in stage.levels() {
            assert!(level.side > 0);
            let mut owner = std::collections::BTreeMap::new();
            for n in 0..4000u64 {
                let p = [0, 1, 2].map(|d| f64::from(conefield_core::random::unit(conefield_core::random::mix(d, n))));
                let located: Located<f64> = levels::located(level, p);
                let corners: Vec<[i64; 3]> = (0..4).map(|c| vertex(&located, c)).collect();
                for (c, v) in corners.iter().enumerate() {
                    assert!(v.iter().all(|x| (x - v[0]) % 2 == 0), "{v:?} is no vertex");
                    let entry = located.entry[c][0];
                    assert_eq!(*owner.entry(entry).or_insert(*v), *v, "entry {entry} has two vertices");
                    for w in &corners[..c] {
                        let distance: i64 = (0..3).map(|d| (v[d] - w[d]).pow(2)).sum();
                        assert!(distance == 3 || distance == 4, "{v:?} and {w:?} are no neighbours");
                    }
                }
                let weights = [0, 1, 2, 3].map(|c| located.weight[c][0]);
                assert!(weights.iter().all(|w| (0.0..=1.0).contains(w)));
                for d in 0..3 {
                    let mean: f64 = (0..4).map(|c| weights[c] * corners[c][d] as f64).sum();
                    assert!((mean - 2.0 * level.scale * p[d]).abs() < 1e-9, "{p:?}");
                }
            }
        }
    }

    /// A cube with `r` cells per side has about `r³` vertices, not counting those around it.
    #[test]
    fn a_level_has_as_many_vertices_as_a_cubic_grid() {
        let stage = stage(64, 2.0, 24);
        let entries = f64::from(stage.levels().nth(1).unwrap().last + 1);
        assert!((1.0..1.08).contains(&(entries / 128f64.powi(3))), "{entries}");
    }

    /// Corners of the cube, points beyond it and rounding near integer cells stay inside direct tables, with weights
    /// that sum to one.
    #[test]
    fn the_rim_stays_inside_the_table() {
        for (base, growth) in [(2, 1.26), (25, 1.14), (63, 1.25), (50, 1.15), (30, 2.05)] {
            for level in stage(base, growth, 22).levels() {
                for bits in 0..27 {
                    let x = [0, 1, 2].map(|d| [0.0f32, 1.0, f32::INFINITY][bits / 3usize.pow(d) % 3]);
                    let located: Located<f32> = levels::located(level, x);
                    let k = located.cell.map(|c| i64::from(c[0]));
                    let total: f32 = located.weight.iter().map(|w| w[0]).sum();
                    assert!((total - 1.0).abs() < 1e-6, "{x:?}");
                    for c in 0..4 {
                        let v = [0, 1, 2].map(|d| k[d] + i64::from(located.rank[d][0] < c));
                        let side = 2 * i64::from(level.side);
                        let sum: i64 = 2 + v.iter().sum::<i64>();
                        assert!(
                            v.iter().all(|k| (0..side).contains(&(sum - 2 * k))),
                            "{base} x {growth} at {x:?}: {v:?}"
                        );
                    }
                }
            }
        }
    }
}
