//! Similar patches: groups of similar patches of a volume have few coefficients.
//!
//! `R(x) = Σ_g w_g·Σ_i m_gi·|(Q·P_g·x)_i|`: P_g gathers the patches of group g, and Q is the orthonormal cosine transform
//! of each patch and then the Walsh-Hadamard transform across them; the mean of a group is free. `1/w_g` is the mean
//! number of patches that cover a voxel of the group. This is collaborative filtering (BM3D: Dabov et al., IEEE Trans.
//! Image Process. 16(8), 2007; BM4D: Maggioni et al., IEEE Trans. Image Process. 22(1), 2013) with soft thresholds: hard
//! ones belong to no convex penalty. What they gain, that large coefficients stay as they are, comes from
//! `m = ε/(|c| + ε)`, with c the coefficients before a pass (reweighted ℓ1: Candès, Wakin and Boyd, J. Fourier Anal.
//! Appl. 14, 2008). Groups and m are found before each pass and fixed during it, so that R is convex; until then, a
//! group is one patch and m is 1.
//!
//! The proximal map takes gradient steps on the dual, kept as `q = p/w`: `u = clip(v − τ·Σ_g w_g·P_gᵀ·Qᵀ·q_g)`, then
//! `q_g ← clip(q_g + σ_g/(w_g·τ)·Q·P_g·u, ±m_g)`. With `1/σ_g` the largest number of patches that cover a voxel of the
//! group, `Σ_g σ_g·P_gᵀ·P_g ≤ 1`, so that it converges.

use super::total_variation::lambda;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::VoxelGrid;
use conefield_core::parallel;
use conefield_core::regularizer::{Confines, Penalty, Regularizer, RegularizerSpec, Weight};
use conefield_core::simd::{Op, Simd, run};
use conefield_core::space::Space;
use ndarray::ArrayView3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Voxels along a side of a patch, unless the volume is thinner; also the distance between the first patches of groups.
const SIDE: usize = 4;

/// Patches per group.
const MANY: usize = 8;

/// Coefficients per group.
const SIZE: usize = SIDE * SIDE * SIDE * MANY;

/// Largest distance of similar patches along an axis.
const FAR: usize = 6;

/// Rows of groups along x in a chunk. Every other chunk adds to other planes, even if the last row is a voxel behind the
/// one before: it is at least `(2·ROWS − 1)·SIDE + 1` planes behind the first row of a chunk.
const ROWS: usize = 4;
const _: () = assert!((2 * ROWS - 1) * SIDE + 1 - FAR >= ROWS * SIDE + FAR);

/// Settings of `patches`: `Σ_g w_g·Σ_i m_gi·|c_gi|`, c the coefficients of 8 similar patches of 4 × 4 × 4 voxels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Patches {
    /// Strength of the prior.
    pub weight: Weight,
    /// Dual steps per update.
    pub inner: usize,
    /// Largest distance of similar patches along an axis, in voxels.
    pub radius: usize,
    /// Threshold of a large coefficient, which costs less: ε of `m = ε/(|c| + ε)`, as a multiple of the root mean square
    /// of all coefficients.
    pub large: f64,
}

impl Default for Patches {
    fn default() -> Self {
        Self { weight: Weight::Noise(1.0), inner: 1, radius: 4, large: 1.0 }
    }
}

conefield_core::stage_type!(RegularizerSpec, "patches", Patches, "similar patches with few coefficients");

impl RegularizerSpec for Patches {
    fn build(&self) -> Result<Box<dyn Regularizer>> {
        self.weight.validate()?;
        ensure((1..=1000).contains(&self.inner), "spec", "inner", self.inner, "1 to 1000")?;
        ensure((1..=FAR).contains(&self.radius), "spec", "radius", self.radius, format!("1 to {FAR}"))?;
        ensure((1e-3..=1e3).contains(&self.large), "spec", "large", self.large, "0.001 to 1000")?;
        Ok(Box::new(*self))
    }
}

impl Patches {
    fn penalty(&self, grid: &VoxelGrid, space: &Space) -> Result<PatchesPenalty> {
        let voxels: usize = grid.shape.iter().product();
        let expected = format!("at most {}: `patches` numbers them with 32 bits", u32::MAX);
        ensure(u32::try_from(voxels).is_ok(), "scan", "volume", format!("{voxels} voxels"), expected)?;
        let lattice = Lattice::new(grid.shape);
        let count = lattice.count();
        space.hold((count * (size_of::<Similar>() + SIZE)) as u64);
        let (dual, sum) = (space.on_host(count * SIZE), space.on_host(voxels));
        let (first, limits) = match space.is_tally() {
            true => (vec![], vec![]),
            false => (lattice.all().map(|at| [at; MANY]).collect(), vec![u8::MAX; count * SIZE]),
        };
        let (groups, confines) = (vec![], Confines::default());
        let mut on = PatchesPenalty { settings: *self, lattice, groups, limits, dual, sum, confines };
        on.regroup(first);
        Ok(on)
    }
}

impl Regularizer for Patches {
    /// It runs on the host.
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
        Ok(Box::new(self.penalty(grid, space)?))
    }

    fn weight(&self, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(lambda(self.weight, grid, noise))
    }

    fn describe(&self) -> String {
        let Self { weight, inner, radius, large } = self;
        let s = if *inner == 1 { "" } else { "s" };
        format!(
            "patches: weight {weight}, {inner} dual step{s} per update, within {radius} voxels, large from {large} rms"
        )
    }
}

/// Where patches lie in a volume.
struct Lattice {
    shape: [usize; 3],
    side: [usize; 3],
    /// The first patches of groups along each axis.
    first: [Vec<usize>; 3],
    /// From a patch's first voxel to each of its voxels, in rows along z. A volume thinner than a patch repeats its last
    /// voxel.
    offsets: [[usize; SIDE]; SIDE * SIDE],
}

impl Lattice {
    fn new(shape: [usize; 3]) -> Self {
        let side = shape.map(|n| n.min(SIDE));
        let first = [0, 1, 2].map(|k| {
            let last = shape[k] - side[k];
            (0..last).step_by(SIDE).chain([last]).collect()
        });
        let [_, ny, nz] = shape;
        let row = |i: usize| (i / SIDE).min(side[0] - 1) * ny + (i % SIDE).min(side[1] - 1);
        let offsets = std::array::from_fn(|i| std::array::from_fn(|z| row(i) * nz + z.min(side[2] - 1)));
        Self { shape, side, first, offsets }
    }

    fn count(&self) -> usize {
        self.first.iter().map(Vec::len).product()
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.shape[1] + y) * self.shape[2] + z
    }

    /// The first patches of all groups, plane by plane.
    fn all(&self) -> impl Iterator<Item = u32> {
        let [x, y, z] = &self.first;
        x.iter().flat_map(move |x| y.iter().flat_map(move |y| z.iter().map(move |z| self.index([*x, *y, *z]) as u32)))
    }

    /// Groups per chunk.
    fn chunk(&self) -> usize {
        ROWS * self.first[1].len() * self.first[2].len()
    }

    /// Planes along x in which patches similar to those of some rows lie.
    fn planes(&self, rows: &[usize], radius: usize) -> Range<usize> {
        let end = rows[rows.len() - 1] + self.side[0] + radius;
        rows[0].saturating_sub(radius)..end.min(self.shape[0])
    }
}

/// A group: the first voxels of its patches, w, and σ/w.
#[derive(Clone, Copy)]
struct Similar {
    at: [u32; MANY],
    weight: f32,
    rate: f32,
}

/// Similar patches on one grid.
struct PatchesPenalty {
    settings: Patches,
    lattice: Lattice,
    groups: Vec<Similar>,
    /// m, in steps of 1/255, group by group.
    limits: Vec<u8>,
    /// q, group by group.
    dual: Vec<f32>,
    /// `Σ_g w_g·P_gᵀ·Qᵀ·q_g`.
    sum: Vec<f32>,
    confines: Confines,
}

impl PatchesPenalty {
    /// Replaces the groups. The dual starts anew, since it belongs to those of before.
    fn regroup(&mut self, groups: Vec<[u32; MANY]>) {
        let Self { lattice, sum, .. } = self;
        let (chunk, offsets) = (lattice.chunk(), &lattice.offsets);
        // For a moment, the sum is the number of patches that cover a voxel.
        sum.fill(0.0);
        let reads =
            |at: [u32; MANY]| at.into_iter().flat_map(|at| offsets.iter().flatten().map(move |o| at as usize + o));
        groups.iter().flat_map(|at| reads(*at)).for_each(|i| sum[i] += 1.0);
        let weighted = |at: [u32; MANY]| {
            let mean = reads(at).map(|i| sum[i]).sum::<f32>() / SIZE as f32;
            let most = reads(at).map(|i| sum[i]).fold(1.0, f32::max);
            Similar { at, weight: 1.0 / mean, rate: mean / most }
        };
        let part = |_, part: &[[u32; MANY]]| part.iter().map(|at| weighted(*at)).collect::<Vec<_>>();
        self.groups = parallel::map(groups.chunks(chunk), part).into_iter().flatten().collect();
        self.sum.fill(0.0);
        self.dual.fill(0.0);
    }

    /// The sum of a number for each group, in f64. `of` gets a group's number and its coefficients.
    fn total(&self, x: &[f32], of: impl Fn(usize, &Block) -> f64 + Sync) -> f64 {
        let Self { lattice, groups, .. } = self;
        let chunk = lattice.chunk();
        let part = |n: usize, part: &[Similar]| {
            let groups = part.iter().enumerate();
            groups.map(|(i, group)| of(n * chunk + i, &run(Transform { lattice, group, x }))).sum::<f64>()
        };
        parallel::map(groups.chunks(chunk), part).iter().sum()
    }

    /// Finds m for the groups of now.
    fn reweight(&mut self, x: &[f32]) {
        let square = |c: &Block| c.iter().flatten().map(|c| f64::from(c * c)).sum::<f64>();
        let count = self.groups.len() * SIZE;
        let rms = (self.total(x, |_, c| square(c)) / count as f64).sqrt();
        let large = (self.settings.large * rms) as f32;
        let Self { lattice, groups, limits, .. } = self;
        parallel::over(
            groups.chunks(lattice.chunk()).zip(limits.chunks_mut(lattice.chunk() * SIZE)),
            |_, (groups, limits)| {
                for (group, limits) in groups.iter().zip(limits.as_chunks_mut::<SIZE>().0) {
                    let block = run(Transform { lattice, group, x });
                    let limit = |c: f32| if large > 0.0 { large / (c.abs() + large) } else { 1.0 };
                    limits
                        .iter_mut()
                        .zip(block.iter().flatten())
                        .for_each(|(m, c)| *m = (255.0 * limit(*c)).ceil() as u8);
                }
            },
        );
    }

    /// A step on the dual from `u`, and the new sum. Chunks that may add to the same planes come after one another.
    fn ascend(&mut self, u: &[f32], tau: f32) {
        let Self { settings, lattice, groups, limits, dual, sum, .. } = self;
        let (many, plane) = (lattice.chunk(), lattice.shape[1] * lattice.shape[2]);
        sum.fill(0.0);
        for wave in 0..2 {
            let (mut rest, mut done) = (&mut sum[..], 0);
            let chunks = lattice.first[0].chunks(ROWS).zip(groups.chunks(many));
            let chunks = chunks.zip(dual.chunks_mut(many * SIZE)).zip(limits.chunks(many * SIZE));
            let ascents = chunks.skip(wave).step_by(2).map(|(((rows, groups), dual), limits)| {
                let planes = lattice.planes(rows, settings.radius);
                let (own, after) =
                    std::mem::take(&mut rest)[(planes.start - done) * plane..].split_at_mut(planes.len() * plane);
                (rest, done) = (after, planes.end);
                Ascent { lattice, groups, dual, limits, u, tau, sum: own, from: planes.start * plane }
            });
            parallel::over(ascents, |_, ascent| run(ascent));
        }
    }

    /// `u = clip(v − τ·sum)`
    fn descend(&self, v: &[f32], tau: f32, u: &mut [f32]) {
        let bounds = self.confines.bounds;
        parallel::change(u, [v, &self.sum], |u, [v, sum]| {
            u.iter_mut().zip(v).zip(sum).for_each(|((u, v), sum)| *u = bounds.clip(v - tau * sum));
        });
        self.confines.clip_each(u);
    }
}

impl Penalty for PatchesPenalty {
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        let x = x.as_standard_layout();
        let Some(x) = x.as_slice() else { return f64::NAN };
        self.total(x, |n, block| {
            let Similar { weight, .. } = self.groups[n];
            let limits = &self.limits[n * SIZE..][..SIZE];
            let sizes = block.iter().flatten().zip(limits).map(|(c, m)| f64::from(c.abs() * limit(*m)));
            f64::from(weight) * sizes.sum::<f64>()
        })
    }

    fn adapts(&self) -> bool {
        true
    }

    fn adapt(&mut self, x: ArrayView3<'_, f32>) -> Option<f64> {
        let flat = x.as_standard_layout();
        let flat = flat.as_slice()?;
        let (lattice, radius) = (&self.lattice, self.settings.radius);
        let found = parallel::map(&lattice.first[0], |_, row| run(Matching { lattice, x: flat, row: *row, radius }));
        self.regroup(found.concat());
        self.reweight(flat);
        Some(self.value(x))
    }

    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        // A weight of 0 leaves the bounds.
        if tau < f32::MIN_POSITIVE {
            return self.descend(v, 0.0, u);
        }
        self.descend(v, tau, u);
        for _ in 0..self.settings.inner {
            self.ascend(u, tau);
            self.descend(v, tau, u);
        }
    }

    fn confines(&mut self) -> Option<&mut Confines> {
        Some(&mut self.confines)
    }
}

/// Numbers of one voxel or coefficient in all patches of a group.
type Lanes = [f32; MANY];

/// The coefficients of a group, or its voxels.
type Block = [Lanes; SIDE * SIDE * SIDE];

/// The voxels of a group.
#[inline(always)]
fn gather(lattice: &Lattice, x: &[f32], group: &Similar) -> Block {
    let mut block = [[0.0; MANY]; SIDE * SIDE * SIDE];
    for (rows, o) in block.as_chunks_mut::<SIDE>().0.iter_mut().zip(&lattice.offsets) {
        for (lane, at) in group.at.iter().enumerate() {
            let x = &x[*at as usize..];
            match x[o[0]..].first_chunk::<SIDE>() {
                Some(line) if o[SIDE - 1] == o[0] + SIDE - 1 => {
                    rows.iter_mut().zip(line).for_each(|(r, x)| r[lane] = *x)
                }
                _ => rows.iter_mut().zip(o).for_each(|(r, o)| r[lane] = x[*o]),
            }
        }
    }
    block
}

/// Adds the weighted voxels of a group to `sum`, which starts at voxel `from`. Patch by patch: rows of patches that
/// overlap come far apart, or each would wait for the one before.
#[inline(always)]
fn scatter(lattice: &Lattice, block: &Block, group: &Similar, from: usize, sum: &mut [f32]) {
    let mut patches = [[[0.0; SIDE]; SIDE * SIDE]; MANY];
    for (i, rows) in block.as_chunks::<SIDE>().0.iter().enumerate() {
        for (lane, patch) in patches.iter_mut().enumerate() {
            patch[i].iter_mut().zip(rows).for_each(|(x, lanes)| *x = group.weight * lanes[lane]);
        }
    }
    for (at, patch) in group.at.iter().zip(&patches) {
        let sum = &mut sum[*at as usize - from..];
        for (o, parts) in lattice.offsets.iter().zip(patch) {
            match sum[o[0]..].first_chunk_mut::<SIDE>() {
                Some(line) if o[SIDE - 1] == o[0] + SIDE - 1 => {
                    line.iter_mut().zip(parts).for_each(|(x, part)| *x += part)
                }
                _ => o.iter().zip(parts).for_each(|(o, part)| sum[*o] += part),
            }
        }
    }
}

/// The orthonormal cosine transform (DCT-II) of a line of a patch, row by row: √½·cos(π·i·(2j + 1)/8), ½ for i = 0.
const COSINES: [[f32; SIDE]; SIDE] = {
    let [a, b] = [0.653_281_5, 0.270_598_06];
    [[0.5; SIDE], [a, b, -b, -a], [0.5, -0.5, -0.5, 0.5], [b, -a, a, -b]]
};

/// Cosine transforms along all axes of the patches; `back` is the inverse.
#[inline(always)]
fn cosine(block: &mut Block, back: bool) {
    for stride in [SIDE * SIDE, SIDE, 1] {
        for start in (0..SIDE * SIDE * SIDE).step_by(SIDE * stride).flat_map(|i| i..i + stride) {
            let mut line = [[0.0; MANY]; SIDE];
            line.iter_mut().enumerate().for_each(|(j, lanes)| *lanes = block[start + j * stride]);
            for (i, factors) in COSINES.iter().enumerate() {
                let [a, b, c, d] = if back { COSINES.map(|row| row[i]) } else { *factors };
                for (l, x) in block[start + i * stride].iter_mut().enumerate() {
                    *x = a * line[0][l] + b * line[1][l] + c * line[2][l] + d * line[3][l];
                }
            }
        }
    }
}

/// The orthonormal Walsh-Hadamard transform, its own inverse. Each of its steps sorts numbers by even and odd places, so
/// that all steps are the same.
#[inline(always)]
fn hadamard(mut v: Lanes) -> Lanes {
    for _ in 0..MANY.ilog2() {
        let before = v;
        let (sums, differences) = v.split_at_mut(MANY / 2);
        let pairs = before.as_chunks::<2>().0;
        for ((sum, difference), [a, b]) in sums.iter_mut().zip(differences).zip(pairs) {
            (*sum, *difference) = (a + b, a - b);
        }
    }
    v.map(|x| x * 0.353_553_4)
}

/// m from its steps.
#[inline(always)]
fn limit(steps: u8) -> f32 {
    f32::from(steps) * (1.0 / 255.0)
}

/// The coefficients of a group, without its mean.
struct Transform<'a> {
    lattice: &'a Lattice,
    group: &'a Similar,
    x: &'a [f32],
}

impl Op for Transform<'_> {
    type Number = f32;
    type Out = Block;
    #[inline(always)]
    fn call<S: Simd>(self, _: S) -> Block {
        let mut block = gather(self.lattice, self.x, self.group);
        cosine(&mut block, false);
        block.iter_mut().for_each(|lanes| *lanes = hadamard(*lanes));
        block[0][0] = 0.0;
        block
    }
}

/// A step on the dual of some groups, whose voxels it adds to `sum`, which starts at voxel `from`.
struct Ascent<'a> {
    lattice: &'a Lattice,
    groups: &'a [Similar],
    dual: &'a mut [f32],
    limits: &'a [u8],
    u: &'a [f32],
    tau: f32,
    sum: &'a mut [f32],
    from: usize,
}

impl Op for Ascent<'_> {
    type Number = f32;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, _: S) {
        let Self { lattice, groups, dual, limits, u, tau, sum, from } = self;
        let blocks = dual.as_chunks_mut::<SIZE>().0.iter_mut().zip(limits.as_chunks::<SIZE>().0);
        for (group, (dual, limits)) in groups.iter().zip(blocks) {
            let mut block = gather(lattice, u, group);
            cosine(&mut block, false);
            let rate = group.rate / tau;
            let lanes = dual.as_chunks_mut::<MANY>().0.iter_mut().zip(limits.as_chunks::<MANY>().0);
            for (i, (block, (dual, limits))) in block.iter_mut().zip(lanes).enumerate() {
                let slope = hadamard(*block);
                for ((q, slope), m) in dual.iter_mut().zip(slope).zip(limits) {
                    let m = limit(*m);
                    *q = (*q + slope * rate).max(-m).min(m);
                }
                if i == 0 {
                    dual[0] = 0.0;
                }
                *block = hadamard(*dual);
            }
            cosine(&mut block, true);
            scatter(lattice, &block, group, from, sum);
        }
    }
}

/// Finds the groups whose first patches lie in a plane.
struct Matching<'a> {
    lattice: &'a Lattice,
    x: &'a [f32],
    row: usize,
    radius: usize,
}

/// Patches along z whose distances are computed together: at least as many as lie within [`FAR`].
const WIDE: usize = 16;
const _: () = assert!(WIDE > 2 * FAR);

/// Squared distances of the patch at `first` to those at `from` and after, or numbers of at least `most` if none is below it.
#[inline(always)]
fn distances(offsets: &[[usize; SIDE]; SIDE * SIDE], x: &[f32], first: usize, from: usize, most: f32) -> [f32; WIDE] {
    let mut sum = [0.0; WIDE];
    let fits = x.len() >= from + offsets[SIDE * SIDE - 1][SIDE - 1] + WIDE;
    for plane in offsets.as_chunks::<SIDE>().0 {
        for o in plane.iter().flatten() {
            let r = x[first + o];
            if fits {
                let line = &x[from + o..][..WIDE];
                sum.iter_mut().zip(line).for_each(|(sum, x)| *sum += (x - r) * (x - r));
            } else {
                sum.iter_mut().zip(&x[from + o..]).for_each(|(sum, x)| *sum += (x - r) * (x - r));
            }
        }
        if sum.iter().fold(true, |all, d| all & (*d >= most)) {
            break;
        }
    }
    sum
}

impl Op for Matching<'_> {
    type Number = f32;
    type Out = Vec<[u32; MANY]>;
    #[inline(always)]
    fn call<S: Simd>(self, _: S) -> Self::Out {
        let Self { lattice, x, row, radius } = self;
        let Lattice { shape, side, first: [_, ys, zs], offsets } = lattice;
        let near = |k: usize, at: usize| at.saturating_sub(radius)..=(at + radius).min(shape[k] - side[k]);
        let mut found = Vec::with_capacity(ys.len() * zs.len());
        for (j, k) in ys.iter().flat_map(|j| zs.iter().map(move |k| (*j, *k))) {
            let first = lattice.index([row, j, k]);
            let along = near(2, k);
            // The patch itself stays in front.
            let mut best = [(f32::INFINITY, first as u32); MANY];
            best[0].0 = -1.0;
            for (a, b) in near(0, row).flat_map(|a| near(1, j).map(move |b| (a, b))) {
                let from = lattice.index([a, b, *along.start()]);
                let distances = distances(offsets, x, first, from, best[MANY - 1].0);
                for (w, distance) in distances[..along.clone().count()].iter().enumerate() {
                    let at = (from + w) as u32;
                    if *distance < best[MANY - 1].0 && at as usize != first {
                        let to = best.partition_point(|(d, _)| d <= distance);
                        best.copy_within(to..MANY - 1, to + 1);
                        best[to] = (*distance, at);
                    }
                }
            }
            found.push(best.map(|(_, at)| at));
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::place::Host;
    use conefield_core::random::{mix, unit};
    use conefield_core::scan::ScanHeader;
    use ndarray::{Array3, s};
    use std::collections::BTreeSet;
    use std::f32::consts::PI;
    use std::sync::Arc;

    fn on(shape: [usize; 3], settings: Patches) -> PatchesPenalty {
        let grid = VoxelGrid { shape, spacing: [1.0; 3], center: [0.0; 3] };
        let header = ScanHeader { views: 0, detector: [0; 2], volume: shape };
        settings.penalty(&grid, &Space::new(header, Arc::new(Host))).unwrap()
    }

    /// Random numbers from -0.5 to 0.5.
    fn noise(shape: [usize; 3], seed: u64) -> Array3<f32> {
        let mut i = 0;
        Array3::from_shape_simple_fn(shape, || {
            i += 1;
            unit(mix(seed, i)) - 0.5
        })
    }

    /// A step of 1 along x, with noise.
    fn step(shape: [usize; 3]) -> Array3<f32> {
        Array3::from_shape_fn(shape, |(x, _, _)| f32::from(u8::from(2 * x >= shape[0]))) + 0.3 * noise(shape, 7)
    }

    fn prox(on: &mut PatchesPenalty, v: &Array3<f32>, tau: f32) -> Array3<f32> {
        let mut u = Array3::zeros(v.dim());
        on.prox(v.as_slice().unwrap(), tau, u.as_slice_mut().unwrap());
        u
    }

    #[test]
    fn transforms_are_orthonormal() {
        let mut block = [[0.0; MANY]; SIDE * SIDE * SIDE];
        for (i, lanes) in block.iter_mut().enumerate() {
            *lanes = std::array::from_fn(|l| unit(mix(i as u64, l as u64)));
        }
        let before = block;
        let square = |block: &Block| block.iter().flatten().map(|x| f64::from(x * x)).sum::<f64>();
        cosine(&mut block, false);
        block.iter_mut().for_each(|lanes| *lanes = hadamard(*lanes));
        assert!((square(&block) - square(&before)).abs() < 1e-4 * square(&before));
        let mean: f32 = before.iter().flatten().sum::<f32>() / (SIZE as f32).sqrt();
        assert!((block[0][0] - mean).abs() < 1e-4);
        block.iter_mut().for_each(|lanes| *lanes = hadamard(*lanes));
        cosine(&mut block, true);
        assert!(block.iter().flatten().zip(before.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-5));
    }

    /// A cosine along an axis is one coefficient.
    #[test]
    fn a_cosine_has_one_coefficient() {
        for stride in [16, 4, 1] {
            for k in 0..SIDE {
                let wave = |i: usize| (PI * k as f32 * ((i / stride % SIDE) as f32 + 0.5) / SIDE as f32).cos();
                let mut block = std::array::from_fn(|i| [wave(i); MANY]);
                cosine(&mut block, false);
                let others = block.iter().enumerate().filter(|(i, _)| *i != k * stride);
                assert!(others.into_iter().all(|(_, lanes)| lanes.iter().all(|x| x.abs() < 1e-5)), "{stride}, {k}");
                assert!(block[k * stride][0] > 5.0, "{stride}, {k}");
            }
        }
    }

    /// Two boxes of the same content, with noise around them.
    #[test]
    fn a_patch_finds_its_copy() {
        let mut x = noise([12, 12, 24], 3);
        let copied = x.slice(s![4..8, 4..8, 4..8]).to_owned();
        x.slice_mut(s![5..9, 2..6, 8..12]).assign(&(copied + 1e-3));
        let mut on = on([12, 12, 24], Patches::default());
        on.adapt(x.view());
        let [from, to] = [[4, 4, 4], [5, 2, 8]].map(|at| on.lattice.index(at) as u32);
        let found = on.groups.iter().find(|group| group.at[0] == from).unwrap();
        assert_eq!(found.at[1], to);
        assert_eq!(found.at.into_iter().collect::<BTreeSet<_>>().len(), MANY);
    }

    /// The objective of the proximal problem and that of its dual meet, with groups that overlap.
    #[test]
    fn the_duality_gap_closes() {
        let tau = 0.2f32;
        for (shape, large) in [([9, 8, 13], 1.0), ([33, 5, 6], 1e3), ([5, 1, 3], 1.0)] {
            let v = step(shape);
            let mut on = on(shape, Patches { inner: 3000, large, radius: FAR, ..Patches::default() });
            on.adapt(v.view());
            let u = prox(&mut on, &v, tau);
            let half = |x: &Array3<f32>| 0.5 * x.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>();
            let value = on.value(u.view());
            let (primal, dual) = (half(&(&u - &v)) + f64::from(tau) * value, half(&v) - half(&u));
            println!("{shape:?}, large {large}: {primal} and {dual}");
            assert!((primal - dual).abs() < 2e-3 * primal && primal > dual * (1.0 - 1e-5), "{primal} and {dual}");
            assert!(value < 0.8 * on.value(v.view()), "{value}");
        }
    }

    /// Where at least as much noise goes, a texture stays higher if large coefficients cost less.
    #[test]
    fn large_coefficients_cost_less() {
        let shape = [16, 16, 16];
        let texture = Array3::from_shape_fn(shape, |(_, _, z)| [1.0, -1.0, -1.0, 1.0][z % 4]);
        let v: Array3<f32> = 0.1 * &texture + 0.3 * noise(shape, 7) + 0.5;
        let of = |large: f64, tau: f32| {
            let mut on = on(shape, Patches { inner: 200, large, ..Patches::default() });
            on.adapt(v.view());
            let u = prox(&mut on, &v, tau);
            let height = (&u * &texture).mean().unwrap();
            let rest = &u - &(height * &texture);
            (height, rest.std(0.0))
        };
        let ((high, noisy), (low, even)) = (of(1.0, 0.3), of(1e3, 0.15));
        println!("texture of {high} with noise {noisy}; of {low} with {even} if all cost the same");
        assert!(
            noisy <= even && high > 0.099 && low < 0.098,
            "texture of {high} with noise {noisy}; of {low} with {even}"
        );
    }

    /// Where all is 0, no coefficient is large and none costs less.
    #[test]
    fn an_empty_volume_has_no_numbers_that_are_not_finite() {
        let shape = [8, 8, 8];
        let mut on = on(shape, Patches::default());
        assert_eq!(on.adapt(Array3::zeros(shape).view()), Some(0.0));
        assert!(prox(&mut on, &step(shape), 0.1).iter().all(|u| u.is_finite() && *u >= 0.0));
    }

    #[test]
    fn groups_do_not_depend_on_threads() {
        let x = noise([17, 9, 21], 5);
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let mut on = on([17, 9, 21], Patches::default());
                on.adapt(x.view());
                let u = prox(&mut on, &x, 0.1);
                (on.groups.iter().flat_map(|group| group.at).collect::<Vec<_>>(), on.limits, u)
            })
        };
        assert!(run(1) == run(5));
    }
}
