//! Total variation of a volume: `Σ_j √(Σ_k (g_k·(x_{j+k} − x_j))²)` over voxels j and axes k. For anisotropic voxels,
//! differences are weighted by `g_k = h/h_k` with h the geometric mean of the sides. At the far faces differences are
//! 0.
//!
//! With [`Edges`] it is directional: `Σ_j |D_j·∇x_j|` with `D = I − n·nᵀ`, in which slopes across edges cost less than
//! slopes along them (Ehrhardt and Betcke, SIAM J. Imaging Sci. 9(3), 2016, whose edges come from another image).
//!
//! [`Limited`] arcs put `A = I − (1 − f)·m·mᵀ` in front, with the same direction m for all voxels: `Σ_j |A·D_j·∇x_j|`.

use super::edges::Edges;
use conefield_core::allowance;
use conefield_core::error::Result;
use conefield_core::geometry::{Vec3, VoxelGrid};
use conefield_core::parallel;
use conefield_core::place::{ADD, Array, Place, Slab, StatePart, VariationSlope};
use conefield_core::regularizer::{Bounds, Confines, Dual, Kernels, Penalty, Update};
use conefield_core::simd::{Op, Simd, SimdBase, SimdFloat, SimdMask, load, run, store};
use conefield_core::space::Space;
use conefield_core::wgsl::Fragment;
use ndarray::ArrayView3;
use std::ops::Range;

/// Weights of differences along x, y, z.
pub fn anisotropy(grid: &VoxelGrid) -> [f32; 3] {
    let h = grid.spacing.iter().product::<f64>().cbrt();
    grid.spacing.map(|s| (h / s) as f32)
}

/// Voxels of a line, the axis across lines and the one along them. Lines run along z; those of a single slice run along
/// y, because lines of one voxel would leave vectors empty. The array is the same.
fn along([_, ny, nz]: [usize; 3]) -> [usize; 3] {
    if nz == 1 { [ny, 2, 1] } else { [nz, 1, 2] }
}

/// The total variation of `x`, which must be contiguous in standard order.
pub fn total_variation(x: ArrayView3<'_, f32>, g: [f32; 3], edges: Option<&Edges>, limited: Option<Limited>) -> f64 {
    variations(x, g, edges, limited).iter().sum()
}

/// The total variation of each plane of `x`.
fn variations(x: ArrayView3<'_, f32>, g: [f32; 3], edges: Option<&Edges>, limited: Option<Limited>) -> Vec<f64> {
    let plane = x.dim().1 * x.dim().2;
    let [nz, y, z] = along(x.dim().into());
    let g = [g[0], g[y], g[z]];
    let limited = limited.map(|limited| limited.turned([0, y, z]));
    let x = x.as_standard_layout();
    let Some(all) = x.as_slice() else { return vec![] };
    parallel::map(all.chunks(plane.max(1)), |i, x| {
        let n = edges.map(|edges| {
            let n = edges.vectors();
            [n[0], n[y], n[z]].map(|n| &n[i * plane..(i + 1) * plane])
        });
        run(Variation { x, after: all.get((i + 1) * plane..(i + 2) * plane), n, g, limited, nz })
    })
}

/// The total variation of a plane.
struct Variation<'a> {
    x: &'a [f32],
    /// The next plane.
    after: Option<&'a [f32]>,
    /// The plane's edges.
    n: Option<[&'a [f32]; 3]>,
    g: [f32; 3],
    limited: Option<Limited>,
    nz: usize,
}

impl Op for Variation<'_> {
    type Number = f32;
    type Out = f64;
    #[inline(always)]
    fn call<S: Simd>(self, s: S) -> f64 {
        let (len, nz) = (S::f32s::LEN, self.nz);
        let g = self.g.map(|g| S::f32s::splat(s, g));
        let zero = S::f32s::splat(s, 0.0);
        let limited = self.limited.map(|limited| limited.splat(s));
        let mut line = vec![0.0; nz + 1];
        let mut sum = 0.0;
        for (j, x) in self.x.chunks(nz).enumerate() {
            // No difference across the far faces.
            let after = self.after.map_or(x, |a| &a[j * nz..(j + 1) * nz]);
            let next = self.x.get((j + 1) * nz..(j + 2) * nz).unwrap_or(x);
            line[..nz].copy_from_slice(x);
            line[nz] = x[nz - 1];
            // A line is short enough for sums in single precision.
            let mut part = zero;
            for k in (0..nz).step_by(len) {
                let here = load(s, x, k);
                let (a, b) = ((load(s, after, k) - here) * g[0], (load(s, next, k) - here) * g[1]);
                let c = (load(s, &line, k + 1) - here) * g[2];
                let n = self.n.map(|n| n.map(|n| load(s, &n[j * nz..(j + 1) * nz], k)));
                let square = if let Some((m, f)) = limited {
                    let n = n.unwrap_or([zero; 3]);
                    let d = less(m, S::f32s::splat(s, 1.0) - f, less(n, S::f32s::splat(s, 1.0), [a, b, c]));
                    dot(d, d)
                } else if let Some(n) = n {
                    // |D·d|² = |d|² − (2 − |n|²)·(n·d)²
                    let inner = dot(n, [a, b, c]);
                    let square = a * a + b * b + c * c;
                    (square - (S::f32s::splat(s, 2.0) - dot(n, n)) * inner * inner).max(zero)
                } else {
                    a * a + b * b + c * c
                };
                part += square.sqrt();
            }
            sum += part.as_slice().iter().map(|x| f64::from(*x)).sum::<f64>();
        }
        sum
    }
}

/// A direction in which slopes cost less: the unit vector m along the middle of an arc, and the factor f of slopes
/// along it, above 0 and at most 1.
#[derive(Debug, Clone, Copy)]
pub struct Limited {
    middle: [f32; 3],
    factor: f32,
}

impl Limited {
    /// With m `middle` and f `factor`.
    fn new(middle: Vec3, factor: f64) -> Self {
        Self { middle: middle.map(|m| m as f32), factor: factor as f32 }
    }

    /// With the axes in another order.
    fn turned(self, axes: [usize; 3]) -> Self {
        Self { middle: axes.map(|k| self.middle[k]), ..self }
    }

    fn splat<S: Simd>(self, s: S) -> ([S::f32s; 3], S::f32s) {
        (self.middle.map(|m| S::f32s::splat(s, m)), S::f32s::splat(s, self.factor))
    }
}

/// `v − share·m·(m·v)`
#[inline(always)]
fn less<V: SimdFloat<S>, S: Simd>(m: [V; 3], share: V, v: [V; 3]) -> [V; 3] {
    let inner = dot(m, v) * share;
    std::array::from_fn(|k| v[k] - m[k] * inner)
}

/// The proximal map of total variation within bounds l and h, by default 0 and ∞, by gradient steps on its dual, warm-started from the previous
/// call.
///
/// `argmin_{l ≤ u ≤ h} ½‖u − v‖² + τ·TV(u)`, with `u = min(h, max(l, v − τ·∇ᵀp))` and `|p_j| ≤ 1` (Beck and Teboulle, IEEE Trans.
/// Image Process. 18(11), 2009; without their momentum, which a warm start does not need).
///
/// All steps pass through the volume in one sweep (`Sweep`), so that memory is read and written once for all of them.
pub struct TvProx {
    shape: [usize; 3],
    g: [f32; 3],
    confines: Confines,
    /// The dual variable along x, y and z; with edges or a limited arc it is `D·A·p`.
    dual: [Array; 3],
    /// Edges across which slopes cost less, initially 0.
    pub(super) edges: Option<Edges>,
    limited: Option<Limited>,
    /// Dual steps of an update.
    inner: usize,
    /// Factor along the middle of a limited arc.
    arc: f64,
}

impl TvProx {
    /// For volumes of `shape`, with `inner` dual steps per update, starting with a dual of 0. Slopes along the middle of a
    /// limited arc count `arc` times.
    pub fn new(shape: [usize; 3], g: [f32; 3], inner: usize, arc: f64, space: &Space) -> Result<Self> {
        let split = Split::new(shape[0], REACH, rayon::current_num_threads());
        space.briefly(|space| {
            let planes = (split.slabs - 1) * 4 * split.halo() + split.slabs * 2 * split.reach;
            space.hold((planes * (shape[1] + 1) * (shape[2] + 1) * size_of::<f32>()) as u64);
        });
        let dual = || space.array(shape);
        let dual = [dual()?, dual()?, dual()?];
        let confines = Confines::default();
        Ok(Self { shape, g, confines, dual, edges: None, limited: None, inner, arc })
    }

    /// Overwrites `u` with the proximal map of `v` after `steps` dual steps. With a weight of 0, only clips to
    /// the bounds.
    fn apply(&mut self, v: &[f32], tau: f32, steps: usize, u: &mut [f32]) {
        if tau < f32::MIN_POSITIVE {
            self.confines.bounds.clip_to(u, v);
            return self.confines.clip_each(u);
        }
        let mut left = steps;
        loop {
            let split = Split::new(self.shape[0], left, rayon::current_num_threads());
            left -= split.reach;
            self.steps(Lines::Map(v, u), tau, split);
            if left == 0 {
                return;
            }
        }
    }

    /// Makes a whole update in one sweep, see [`Penalty::update`]; returns the update if `steps` does not fit into one.
    fn sweep<'a>(&mut self, update: Update<'a>, tau: f32, steps: usize) -> Option<Update<'a>> {
        let split = Split::new(self.shape[0], steps, rayon::current_num_threads());
        if tau < f32::MIN_POSITIVE || split.reach < steps {
            return Some(update);
        }
        self.steps(Lines::Update(update), tau, split);
        None
    }

    /// Makes some steps in one sweep. The slabs of `split` run in parallel; near its ends each works on a copy of its
    /// neighbour's data, so that every number is computed from the same values whatever the split.
    fn steps(&mut self, lines: Lines<'_>, tau: f32, split: Split) {
        let [nz, y, z] = along(self.shape);
        let plane = self.shape[1] * self.shape[2];
        let bounds = split.bounds(self.shape[0]);
        let limited = self.limited.map(|limited| limited.turned([0, y, z]));
        let scale = Scale::new([self.g[0], self.g[y], self.g[z]], tau, self.confines.bounds, limited);
        let edges = self.edges.as_ref().map(Edges::vectors).map(|n| [n[0], n[y], n[z]]);
        let [px, py, pz] = self.dual.each_mut().map(Array::slice_mut);
        let dual = if y == 1 { [px, py, pz] } else { [px, pz, py] };
        // Copies of the neighbour's planes on both sides of every inner bound.
        let mut halos: Vec<([Vec<f32>; 3], Vec<f32>)> = bounds[1..bounds.len() - 1]
            .iter()
            .map(|&b| {
                let near = (b - split.below()) * plane..(b + split.reach) * plane;
                let mut v = vec![0.0; near.len()];
                lines.read(near.start, &mut v);
                (dual.each_ref().map(|p| p[near.clone()].to_vec()), v)
            })
            .collect();
        let mut copies = halos.iter_mut().map(|(halo, v)| {
            let mut low = Planes::default();
            let mut high = Planes::default();
            for (k, p) in halo.each_mut().into_iter().enumerate() {
                let (below, above) = p.split_at_mut(split.below() * plane);
                (low.0[k], high.0[k]) = (below.chunks_mut(plane).collect(), above.chunks_mut(plane).collect());
            }
            let v = v.split_at(split.below() * plane);
            ((low, v.0), (high, v.1))
        });
        let mut own = dual.map(|p| p.chunks_mut(plane));
        let mut rest = lines;
        let mut slabs = vec![];
        let (mut low, mut low_v): (_, &[f32]) = Default::default();
        for range in bounds.windows(2).map(|b| b[0]..b[1]) {
            let ((next, next_v), (high, high_v)) = copies.next().unwrap_or_default();
            let mut planes = std::mem::replace(&mut low, next);
            let v = [std::mem::replace(&mut low_v, next_v), high_v];
            let copied = planes.0[0].len();
            for ((all, own), high) in planes.0.iter_mut().zip(&mut own).zip(high.0) {
                all.extend(own.take(range.len()).chain(high));
            }
            let [lines, others] = rest.split(range.len() * plane);
            rest = others;
            let own = copied..copied + range.len();
            let first = (range.start - copied) * plane;
            let edges = edges.map(|n| n.map(|n| &n[first..first + planes.0[0].len() * plane]));
            let part = first..first + planes.0[0].len() * plane;
            let each = self.confines.each.as_ref().map(|each| each.each_ref().map(|x| &x[part.clone()]));
            slabs.push(Sweep { planes, own, lines, v, edges, each, line: nz, steps: split.reach, scale });
        }
        parallel::over(slabs, |_, slab| run(slab));
    }
}

impl Penalty for TvProx {
    /// The total variation of `x`, or the part of its own planes.
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        let planes = variations(x, self.g, self.edges.as_ref(), self.limited);
        planes[self.confines.slab.as_ref().map_or(0..planes.len(), Slab::inner)].iter().sum()
    }

    fn adapts(&self) -> bool {
        self.edges.is_some()
    }

    fn adapt(&mut self, x: ArrayView3<'_, f32>) -> Option<f64> {
        self.edges.as_mut()?.find(x, self.g, self.confines.slab.as_ref());
        Some(self.value(x))
    }

    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        self.apply(v, tau, self.inner, u);
    }

    fn confines(&mut self) -> Option<&mut Confines> {
        Some(&mut self.confines)
    }

    fn limited(&mut self, middle: Vec3) {
        if self.arc < 1.0 {
            self.limited = Some(Limited::new(middle, self.arc));
        }
    }

    fn update(&mut self, update: Update<'_>, tau: f32) {
        if let Some(update) = self.sweep(update, tau, self.inner) {
            update.around(|v, u| self.apply(v, tau, self.inner, u));
        }
    }

    /// Kernels have the same bounds for all voxels.
    fn kernels(&mut self) -> Option<Kernels<'_>> {
        let Confines { bounds, each: None, slab } = &self.confines else { return None };
        let fragment = match self.limited {
            Some(Limited { middle: [x, y, z], factor }) => {
                let constants =
                    format!("const stage_MIDDLE = vec3<f32>({x:?}, {y:?}, {z:?});\nconst stage_FACTOR = {factor:?};\n");
                Fragment::new(&[&constants, LIMITED])
            }
            None => Fragment::new(&[if self.edges.is_some() { ALONG_EDGES } else { PLAIN }]),
        };
        let guide = self.edges.as_mut().map(Edges::guide);
        let (p, slab, bounds) = (self.dual.each_mut(), slab.as_ref(), *bounds);
        Some(Kernels::Dual(Dual { fragment, weights: self.g, steps: self.inner, bounds, p, guide, slab }))
    }

    fn state(&mut self) -> Vec<(&str, StatePart<'_>)> {
        let [x, y, z] = self.dual.each_mut().map(StatePart::Placed);
        vec![("dual.x", x), ("dual.y", y), ("dual.z", z)]
    }
}

/// Most dual steps per sweep, so that their part of the volume stays in the last-level cache.
const REACH: usize = 4;

/// Number of slabs along x, and steps per sweep.
#[derive(Debug, Clone, Copy)]
struct Split {
    slabs: usize,
    reach: usize,
}

impl Split {
    /// For `planes` planes and `threads` threads: each slab is at least twice as thick as its redundant part.
    fn new(planes: usize, steps: usize, threads: usize) -> Self {
        let reach = steps.min((planes / threads.max(1) / 4).clamp(1, REACH));
        let mut split = Self { slabs: 1, reach };
        split.slabs = threads.min(planes / (2 * split.halo())).max(1);
        split
    }

    /// Planes below a slab that affect it: one per step, and the dual's before the first.
    fn below(self) -> usize {
        self.reach + 1
    }

    fn halo(self) -> usize {
        self.below() + self.reach
    }

    /// Where slabs begin, and where the last one ends.
    fn bounds(self, planes: usize) -> Vec<usize> {
        (0..=self.slabs).map(|n| n * planes / self.slabs).collect()
    }
}

/// Factors of differences, and bounds of the primal.
#[derive(Clone, Copy)]
struct Scale {
    /// For the primal: `g·τ`.
    down: [f32; 3],
    /// For a dual step: `g/(L·τ)`, L a bound on `‖∇‖²`.
    up: [f32; 3],
    bounds: Bounds,
    limited: Option<Limited>,
}

impl Scale {
    fn new(g: [f32; 3], tau: f32, bounds: Bounds, limited: Option<Limited>) -> Self {
        let bound = Dual::bound(g);
        Self { down: g.map(|g| g * tau), up: g.map(|g| g / (bound * tau)), bounds, limited }
    }
}

/// Planes of the dual along x, y and z.
#[derive(Default)]
struct Planes<'a>([Vec<&'a mut [f32]>; 3]);

/// Input and output of the proximal map in a sweep, line by line. A line is not read again after it was written.
enum Lines<'a> {
    /// Those of an update.
    Update(Update<'a>),
    /// The map alone, from the first to the second.
    Map(&'a [f32], &'a mut [f32]),
}

impl Lines<'_> {
    /// Overwrites `v` with the input from index `at` on.
    #[inline(always)]
    fn read(&self, at: usize, v: &mut [f32]) {
        match self {
            Self::Update(update) => update.read(at, v),
            Self::Map(from, _) => v.copy_from_slice(&from[at..at + v.len()]),
        }
    }

    /// Receives the proximal map `u` from index `at` on.
    #[inline(always)]
    fn write(&mut self, at: usize, u: &[f32]) {
        match self {
            Self::Update(update) => update.write(at, u),
            Self::Map(_, to) => to[at..at + u.len()].copy_from_slice(u),
        }
    }

    /// Splits into the first `at` numbers and the rest.
    fn split(self, at: usize) -> [Self; 2] {
        match self {
            Self::Update(update) => update.split(at).map(Self::Update),
            Self::Map(v, u) => {
                let (v, u) = (v.split_at(at), u.split_at_mut(at));
                [Self::Map(v.0, u.0), Self::Map(v.1, u.1)]
            }
        }
    }
}

/// Dual steps and then the primal on a slab of planes, of which `own` are correct at the end. Differences at the slab's
/// ends count as 0; where the volume goes on, the resulting error spreads by one plane per step.
struct Sweep<'a> {
    planes: Planes<'a>,
    own: Range<usize>,
    /// The lines of `own`.
    lines: Lines<'a>,
    /// The input of the map below and above `own`.
    v: [&'a [f32]; 2],
    /// The edges of all planes.
    edges: Option<[&'a [f32]; 3]>,
    /// The bounds of each voxel of all planes, if they differ.
    each: Option<[&'a [f32]; 2]>,
    /// Numbers per line along z.
    line: usize,
    steps: usize,
    scale: Scale,
}

impl Op for Sweep<'_> {
    type Number = f32;
    type Out = ();
    /// Step k runs one plane behind step k − 1, line by line: once a line's primal is known, the dual of the line one
    /// plane before can advance, whose primal the next step then uses. So one plane per step is kept.
    #[inline(always)]
    fn call<S: Simd>(mut self, s: S) {
        let (nz, scale) = (self.line, self.scale);
        let plane = self.planes.0[0].first().map_or(0, |p| p.len());
        let (ny, count) = (plane / nz, self.planes.0[0].len());
        // The primal of every step, with each line's last number doubled: no difference across the far face. A line
        // replaces the one that is a plane and a line older, which no dual needs any more.
        let stride = nz + 1;
        let ring = ny + 1;
        let mut kept = vec![0.0f32; self.steps * ring * stride];
        // The map's input, from the line of the last step to the line of the first.
        let reach = self.steps * ny + 1;
        let mut given = vec![0.0f32; reach * nz];
        let given_at = |i: usize, j: usize| (i * ny + j) % reach * nz;
        let (zeros, mut map) = (vec![0.0f32; nz], vec![0.0f32; nz]);
        let (limited, mut line) = (scale.limited.is_some(), vec![0.0f32; nz]);
        for front in 0..count + self.steps {
            allowance::trim();
            for j in 0..ny {
                if front < count {
                    self.give(front, j, &mut given[given_at(front, j)..][..nz]);
                }
                for step in 0..self.steps.min(front + 1) {
                    let i = front - step;
                    let known = i < count;
                    let kept = &mut kept[step * ring * stride..(step + 1) * ring * stride];
                    let at = |i: usize, j: usize| (i * ny + j) % ring * stride;
                    if known {
                        let v = &given[given_at(i, j)..][..nz];
                        let fresh = &mut kept[at(i, j)..][..stride];
                        primal(s, self.beside(i, j, &zeros, limited.then_some(&mut line)), v, scale, &mut fresh[..nz]);
                        self.clip(i, j, &mut fresh[..nz]);
                        fresh[nz] = fresh[nz - 1];
                    }
                    if i > 0 && i <= count {
                        let u = &kept[at(i - 1, j)..][..stride];
                        let after = if known { &kept[at(i, j)..][..nz] } else { u };
                        let next = if j + 1 < ny { &kept[at(i - 1, j + 1)..][..nz] } else { u };
                        let at = (i - 1) * plane + j * nz;
                        let n = self.edges.map(|n| n.map(|n| &n[at..at + nz]));
                        ascend(s, u, [after, next], n, scale, self.planes.line(i - 1, j, nz));
                    }
                }
                let Some(i) = front.checked_sub(self.steps).filter(|i| self.own.contains(i)) else { continue };
                primal(
                    s,
                    self.beside(i, j, &zeros, limited.then_some(&mut line)),
                    &given[given_at(i, j)..][..nz],
                    scale,
                    &mut map,
                );
                self.clip(i, j, &mut map);
                self.lines.write((i - self.own.start) * plane + j * nz, &map);
            }
        }
    }
}

impl Sweep<'_> {
    /// Clips line `j` of plane `i` to the bounds of its voxels.
    #[inline(always)]
    fn clip(&self, i: usize, j: usize, u: &mut [f32]) {
        let Some([low, high]) = self.each else { return };
        let (nz, plane) = (self.line, self.planes.0[0][i].len());
        let at = i * plane + j * nz;
        for ((u, low), high) in u.iter_mut().zip(&low[at..at + nz]).zip(&high[at..at + nz]) {
            *u = u.max(*low).min(*high);
        }
    }

    /// The dual at and before line `j` of plane `i`. With `line`, of a limited arc, it has no components across the far
    /// faces: there is no difference, but `A` puts a part of the others there.
    #[inline(always)]
    fn beside<'b>(&'b self, i: usize, j: usize, zeros: &'b [f32], line: Option<&'b mut Vec<f32>>) -> Beside<'b> {
        let mut beside = self.planes.beside(i, j, zeros);
        let Some(line) = line else { return beside };
        if i + 1 == self.planes.0[0].len() && i + 1 == self.own.end {
            beside.p[0] = zeros;
        }
        if (j + 1) * self.line == self.planes.0[0][i].len() {
            beside.p[1] = zeros;
        }
        line.copy_from_slice(beside.p[2]);
        line[self.line - 1] = 0.0;
        beside.p[2] = line;
        beside
    }

    /// Overwrites `v` with line `j` of plane `i` of the map's input.
    #[inline(always)]
    fn give(&self, i: usize, j: usize, v: &mut [f32]) {
        let (nz, plane) = (self.line, self.planes.0[0][i].len());
        let [low, high] = self.v;
        if i < self.own.start {
            v.copy_from_slice(&low[i * plane + j * nz..][..nz]);
        } else if i < self.own.end {
            self.lines.read((i - self.own.start) * plane + j * nz, v);
        } else {
            v.copy_from_slice(&high[(i - self.own.end) * plane + j * nz..][..nz]);
        }
    }
}

/// The dual at a line, and along x and y at the lines before; zeros if there are none.
struct Beside<'a> {
    p: [&'a [f32]; 3],
    before: [&'a [f32]; 2],
}

impl Planes<'_> {
    fn beside<'a>(&'a self, i: usize, j: usize, zeros: &'a [f32]) -> Beside<'a> {
        let nz = zeros.len();
        let row = |k: usize, i: usize, j: usize| &self.0[k][i][j * nz..(j + 1) * nz];
        Beside {
            p: [row(0, i, j), row(1, i, j), row(2, i, j)],
            before: [if i > 0 { row(0, i - 1, j) } else { zeros }, if j > 0 { row(1, i, j - 1) } else { zeros }],
        }
    }

    fn line(&mut self, i: usize, j: usize, nz: usize) -> [&mut [f32]; 3] {
        self.0.each_mut().map(|p| &mut p[i][j * nz..(j + 1) * nz])
    }
}

/// A whole vector of a line. Loops over these leave the end of a line to [`load`] and [`store`], whose out-of-line
/// paths make the compiler spill every vector to the stack.
#[inline(always)]
fn whole<S: Simd>(s: S, line: &[f32], k: usize) -> S::f32s {
    S::f32s::from_slice(s, &line[k..k + S::f32s::LEN])
}

/// `u = min(h, max(l, v − τ·∇ᵀp))` along a line.
#[inline(always)]
fn primal<S: Simd>(s: S, Beside { p: [px, py, pz], before }: Beside<'_>, v: &[f32], scale: Scale, u: &mut [f32]) {
    let (n, len) = (u.len(), S::f32s::LEN);
    let within = [scale.bounds.low, scale.bounds.high].map(|x| S::f32s::splat(s, x));
    let scale = scale.down.map(|x| S::f32s::splat(s, x));
    let [bx, by] = before;
    // There is no difference before the first voxel along z.
    let mut first = [0.0; 32];
    let head = n.min(len);
    first[1..=head].copy_from_slice(&pz[..head]);
    let first = &first[..len];
    let mut k = 0;
    while k + len <= n {
        let bz = if k == 0 { first } else { &pz[k - 1..k - 1 + len] };
        let p = [whole(s, px, k), whole(s, py, k), whole(s, pz, k)];
        let behind = [whole(s, bx, k), whole(s, by, k), whole(s, bz, 0)];
        descent(behind, p, whole(s, v, k), scale, within).store_slice(&mut u[k..k + len]);
        k += len;
    }
    if k < n {
        let bz = if k == 0 { whole(s, first, 0) } else { load(s, pz, k - 1) };
        let p = [load(s, px, k), load(s, py, k), load(s, pz, k)];
        let behind = [load(s, bx, k), load(s, by, k), bz];
        store::<S, f32>(descent(behind, p, load(s, v, k), scale, within), u, k);
    }
}

/// The primal of a vector of voxels.
#[inline(always)]
fn descent<V: SimdFloat<S>, S: Simd>(behind: [V; 3], p: [V; 3], v: V, scale: [V; 3], [low, high]: [V; 2]) -> V {
    let [x, y, z] = [behind[0] - p[0], behind[1] - p[1], behind[2] - p[2]];
    let turn = x * scale[0] + y * scale[1] + z * scale[2];
    (v - turn).max(low).min(high)
}

/// `p ← p + A·D·∇u/(L·τ)` along a line, then projection onto the unit ball. `u` has its last number doubled; `after`
/// are the next lines along x and y, or `u` itself at the end; `n` are the edges, if `D` is not 1.
#[inline(always)]
fn ascend<S: Simd>(s: S, u: &[f32], after: [&[f32]; 2], n: Option<[&[f32]; 3]>, scale: Scale, p: [&mut [f32]; 3]) {
    // A loop of its own: within that of plain total variation, the arc makes a run of `fista-tv` 6 % slower.
    match scale.limited {
        None => each::<S, false>(s, u, after, n, scale, p),
        Some(_) => each::<S, true>(s, u, after, n, scale, p),
    }
}

/// [`ascend`] by a vector of voxels at a time.
#[inline(always)]
fn each<S: Simd, const LIMITED: bool>(
    s: S,
    u: &[f32],
    after: [&[f32]; 2],
    n: Option<[&[f32]; 3]>,
    scale: Scale,
    [px, py, pz]: [&mut [f32]; 3],
) {
    let (count, len) = (px.len(), S::f32s::LEN);
    let arc = scale.limited.filter(|_| LIMITED).map(|limited| limited.splat(s));
    let scale = scale.up.map(|x| S::f32s::splat(s, x));
    let mut k = 0;
    while k + len <= count {
        let p = [whole(s, px, k), whole(s, py, k), whole(s, pz, k)];
        let next = [whole(s, after[0], k), whole(s, after[1], k), whole(s, u, k + 1)];
        let n = n.map(|n| n.map(|n| whole(s, n, k)));
        let [x, y, z] = match arc {
            None => ascent(s, whole(s, u, k), next, p, n, scale),
            Some(arc) => ascent_limited(s, whole(s, u, k), next, p, n, arc, scale),
        };
        x.store_slice(&mut px[k..k + len]);
        y.store_slice(&mut py[k..k + len]);
        z.store_slice(&mut pz[k..k + len]);
        k += len;
    }
    if k < count {
        let p = [load(s, px, k), load(s, py, k), load(s, pz, k)];
        let next = [load(s, after[0], k), load(s, after[1], k), load(s, u, k + 1)];
        let n = n.map(|n| n.map(|n| load(s, n, k)));
        let [x, y, z] = match arc {
            None => ascent(s, load(s, u, k), next, p, n, scale),
            Some(arc) => ascent_limited(s, load(s, u, k), next, p, n, arc, scale),
        };
        store::<S, f32>(x, px, k);
        store::<S, f32>(y, py, k);
        store::<S, f32>(z, pz, k);
    }
}

/// The dual of a vector of voxels after a step. With edges it is stored as `w = D·p`, so that the primal does not need
/// them; then `p = D⁻¹·w = w + n·(n·w)/(1 − |n|²)`.
#[inline(always)]
fn ascent<S: Simd>(
    s: S,
    here: S::f32s,
    next: [S::f32s; 3],
    p: [S::f32s; 3],
    n: Option<[S::f32s; 3]>,
    scale: [S::f32s; 3],
) -> [S::f32s; 3] {
    let one = S::f32s::splat(s, 1.0);
    let Some(n) = n else {
        let [x, y, z]: [S::f32s; 3] = std::array::from_fn(|k| (next[k] - here).mul_add(scale[k], p[k]));
        let square = x.mul_add(x, y.mul_add(y, z * z));
        // Flat parts stay in the ball and need neither the root nor the quotient.
        if square.simd_le(one).all_true() {
            return [x, y, z];
        }
        let shrink = one / square.sqrt().max(one);
        return [x * shrink, y * shrink, z * shrink];
    };
    let d: [S::f32s; 3] = std::array::from_fn(|k| (next[k] - here) * scale[k]);
    let along = dot(n, p) / (one - dot(n, n)) - dot(n, d);
    let p: [S::f32s; 3] = std::array::from_fn(|k| n[k].mul_add(along, p[k] + d[k]));
    let shrink = one / dot(p, p).sqrt().max(one);
    let inner = dot(n, p);
    std::array::from_fn(|k| (p[k] - n[k] * inner) * shrink)
}

/// [`ascent`] for a limited arc, whose dual is stored as `w = D·A·p`: `A⁻¹·w = w − (1 − 1/f)·m·(m·w)`.
#[inline(always)]
fn ascent_limited<S: Simd>(
    s: S,
    here: S::f32s,
    next: [S::f32s; 3],
    p: [S::f32s; 3],
    n: Option<[S::f32s; 3]>,
    (m, f): ([S::f32s; 3], S::f32s),
    scale: [S::f32s; 3],
) -> [S::f32s; 3] {
    let one = S::f32s::splat(s, 1.0);
    let n = n.unwrap_or([S::f32s::splat(s, 0.0); 3]);
    let d = less(n, one, std::array::from_fn(|k| (next[k] - here) * scale[k]));
    let d = less(m, one - f, d);
    let p = less(m, one - one / f, less(n, -(one / (one - dot(n, n))), p));
    let p: [S::f32s; 3] = std::array::from_fn(|k| p[k] + d[k]);
    let shrink = one / dot(p, p).sqrt().max(one);
    less(n, one, less(m, one - f, p.map(|p| p * shrink)))
}

/// [`ascent`] and [`Variation`] in WGSL, without edges and with them.
const PLAIN: &str = include_str!("tv.wgsl");
const ALONG_EDGES: &str = include_str!("tv_edges.wgsl");
/// The same of a limited arc, without edges (n = 0) and with them.
const LIMITED: &str = include_str!("tv_limited.wgsl");

#[inline(always)]
fn dot<T: Copy + std::ops::Add<Output = T> + std::ops::Mul<Output = T>>(a: [T; 3], b: [T; 3]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Adds `−step·∇TV/‖∇TV‖` of the smoothed total variation to `x`: a step of ASD-POCS. `work` is scratch of `x`'s
/// shape. Differences are divided by `smoothing`, so that their squares are of order one whatever the unit of `x`.
pub fn descend(
    place: &dyn Place,
    x: &mut Array,
    g: [f32; 3],
    step: f64,
    smoothing: f32,
    work: &mut Array,
) -> Result<()> {
    if !smoothing.is_normal() {
        return Ok(());
    }
    let (unit, shape) = (1.0 / smoothing, x.shape());
    let host = |x: &[f32], out: &mut [f32]| slopes(x, shape, g, unit, out);
    let norm = place.slope(&VariationSlope { weights: g, unit, host: &host }, x, work)?.sqrt();
    if norm > 0.0 {
        place.map(&ADD, [-f64::from((step / norm) as f32), 1.0], x, &[work])?;
    }
    Ok(())
}

/// Overwrites `out` with the slope at every voxel; returns the sum of squares.
fn slopes(x: &[f32], shape: [usize; 3], g: [f32; 3], unit: f32, out: &mut [f32]) -> f64 {
    let [_, ny, nz] = shape;
    let squares: Vec<f64> = parallel::map(out.chunks_mut(ny * nz), |i, out| {
        let mut sum = 0.0;
        for j in 0..ny {
            for k in 0..nz {
                let grad = slope(x, shape, g, unit, [i, j, k]);
                out[j * nz + k] = grad;
                sum += f64::from(grad) * f64::from(grad);
            }
        }
        sum
    });
    squares.iter().sum()
}

/// Derivative of the smoothed total variation with respect to one voxel; differences times `unit` are compared with 1.
#[inline(always)]
fn slope(x: &[f32], shape: [usize; 3], g: [f32; 3], unit: f32, at: [usize; 3]) -> f32 {
    let stride = [shape[1] * shape[2], shape[2], 1];
    let index = at[0] * stride[0] + at[1] * stride[1] + at[2];
    // Forward differences at a voxel and their norm.
    let forward = |at: [usize; 3], index: usize| {
        let to_next = |k: usize| g[k] * ((x[index + stride[k]] - x[index]) * unit);
        let d: [f32; 3] = std::array::from_fn(|k| if at[k] + 1 < shape[k] { to_next(k) } else { 0.0 });
        let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + 1.0).sqrt();
        (d, length)
    };
    let (d, length) = forward(at, index);
    let mut sum = -(g[0] * d[0] + g[1] * d[1] + g[2] * d[2]) / length;
    for k in 0..3 {
        if at[k] > 0 {
            let mut behind = at;
            behind[k] -= 1;
            let (d, length) = forward(behind, index - stride[k]);
            sum += g[k] * d[k] / length;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::place::Host;
    use conefield_core::random::{mix, unit};
    use conefield_core::scan::ScanHeader;
    use ndarray::Array3;
    use std::sync::Arc;

    fn space(volume: [usize; 3]) -> Space {
        Space::new(ScanHeader { views: 0, detector: [0; 2], volume }, Arc::new(Host))
    }

    fn prox(shape: [usize; 3], g: [f32; 3]) -> TvProx {
        TvProx::new(shape, g, 1, 0.3, &space(shape)).unwrap()
    }

    /// The dual of a prior.
    fn dual(prox: TvProx) -> [Array3<f32>; 3] {
        prox.dual.map(|p| Host.take(p).unwrap())
    }

    /// The prior with the edges of `x`.
    fn with_edges(shape: [usize; 3], g: [f32; 3], x: &Array3<f32>) -> TvProx {
        let edges = Edges::new(shape, 0.9, 0.7, &space(shape)).unwrap();
        let mut prox = TvProx { edges: Some(edges), ..prox(shape, g) };
        assert!(prox.adapt(x.view()).is_some());
        prox
    }

    fn noisy(shape: [usize; 3]) -> Array3<f32> {
        let mut i = 0;
        Array3::from_shape_fn(shape, |(x, _, _)| {
            i += 1;
            f32::from(u8::from(x > shape[0] / 2)) + 0.3 * (unit(mix(5, i)) - 0.5)
        })
    }

    /// Primal and dual objective of the proximal problem converge, which verifies both.
    #[test]
    fn the_duality_gap_closes() {
        let shape = [9, 8, 19];
        let (g, tau) = ([1.0, 0.7, 1.3], 0.15f32);
        let v = noisy(shape);
        for (directional, limited) in [(false, false), (true, false), (false, true), (true, true)] {
            let mut prox = if directional { with_edges(shape, g, &v) } else { prox(shape, g) };
            if limited {
                prox.limited([0.6, 0.8, 0.0]);
            }
            let mut u = Array3::zeros(shape);
            let gap = |prox: &TvProx, u: &Array3<f32>| {
                // P(u) = ½‖u − v‖² + τTV(u); D(p) = ½‖v‖² − ½‖max(0, v − τ∇ᵀp)‖², and u is that maximum.
                let half = |a: f64| 0.5 * a;
                let distance: f64 = u.iter().zip(&v).map(|(a, b)| f64::from(a - b).powi(2)).sum();
                let primal = half(distance) + f64::from(tau) * prox.value(u.view());
                let square = |x: &Array3<f32>| x.iter().map(|&a| f64::from(a).powi(2)).sum::<f64>();
                let dual = half(square(&v)) - half(square(u));
                (primal - dual) / primal
            };
            let mut gaps = vec![];
            for steps in [5, 20, 2000] {
                prox.apply(v.as_slice().unwrap(), tau, steps, u.as_slice_mut().unwrap());
                gaps.push(gap(&prox, &u));
            }
            assert!(gaps[2] < 2e-3 && gaps[2] > -1e-5 && gaps[0] > gaps[1] && gaps[1] > gaps[2], "{gaps:?}");
            assert!(prox.value(u.view()) < 0.5 * prox.value(v.view()));
        }
    }

    /// A step between two faces costs less than without edges; a step of the same size on one voxel does not.
    #[test]
    fn slopes_across_an_edge_count_less() {
        let (shape, g) = ([12, 9, 10], [1.0; 3]);
        let step = Array3::from_shape_fn(shape, |(x, _, _)| f32::from(u8::from(x >= 6)));
        let prox = with_edges(shape, g, &step);
        let plain = total_variation(step.view(), g, None, None);
        assert!(prox.value(step.view()) < 0.3 * plain, "{} and {plain}", prox.value(step.view()));
        let along = Array3::from_shape_fn(shape, |(_, y, _)| f32::from(u8::from(y >= 4)));
        let plain = total_variation(along.view(), g, None, None);
        assert!((prox.value(along.view()) - plain).abs() < 1e-3 * plain);
    }

    /// The cost does not depend on the frame: a face at any angle costs f times as much if the arc's middle is its normal.
    #[test]
    fn slopes_along_the_middle_of_an_arc_cost_less_at_any_angle() {
        let shape = [16, 16, 4];
        for angle in [0.0f64, 0.7, 1.2] {
            let middle = [angle.cos(), angle.sin(), 0.0];
            let across = [-angle.sin(), angle.cos(), 0.0];
            let ramp = Array3::from_shape_fn(shape, |(x, y, _)| (x as f64 * middle[0] + y as f64 * middle[1]) as f32);
            let cost = |limited| total_variation(ramp.view(), [1.0; 3], None, limited);
            let (plain, along) = (cost(None), cost(Some(Limited::new(middle, 0.25))));
            let other = cost(Some(Limited::new(across, 0.25)));
            // At the far faces one of the differences is 0, so that the slope has another direction there.
            assert!(
                (along / plain - 0.25).abs() < 0.06 && other / plain > 0.94,
                "{angle}: {along}, {other} of {plain}"
            );
        }
    }

    /// The same steps one after another, voxel by voxel; `dual` is `D·A·p`.
    fn plain(prox: &mut TvProx, v: &Array3<f32>, tau: f32, steps: usize) -> Array3<f32> {
        let TvProx { shape, g, confines: Confines { bounds, each, .. }, dual, edges, limited, .. } = prox;
        let (shape, g, bounds, dual) = (*shape, *g, *bounds, &mut dual.each_mut().map(|p| p.on_host_mut().unwrap()));
        let moved = |at: [usize; 3], k: usize, by: isize| {
            let mut to = at;
            to[k] = to[k].wrapping_add_signed(by);
            to
        };
        let primal = |dual: &[&mut Array3<f32>; 3]| {
            Array3::from_shape_fn(shape, |(x, y, z)| {
                let at = [x, y, z];
                let behind = |k: usize| if at[k] > 0 { dual[k][moved(at, k, -1)] } else { 0.0 };
                // No difference across the far faces.
                let here = |k: usize| if at[k] + 1 < shape[k] { dual[k][at] } else { 0.0 };
                let turn: f32 = (0..3).map(|k| (behind(k) - here(k)) * g[k] * tau).sum();
                let here = bounds.clip(v[at] - turn);
                let index = (at[0] * shape[1] + at[1]) * shape[2] + at[2];
                each.as_ref().map_or(here, |each| here.max(each[0][index]).min(each[1][index]))
            })
        };
        let bound = 4.0 * g.iter().map(|g| g * g).sum::<f32>();
        for _ in 0..steps {
            let u = primal(dual);
            for (index, ((x, y, z), &here)) in u.indexed_iter().enumerate() {
                let at = [x, y, z];
                let ahead = |k: usize| if at[k] + 1 < shape[k] { u[moved(at, k, 1)] - here } else { 0.0 };
                let n = edges.as_ref().map_or([0.0; 3], |edges| edges.vectors().map(|n| n[index]));
                let directed = |d: [f32; 3]| std::array::from_fn::<f32, 3, _>(|k| d[k] - n[k] * dot(n, d));
                let (m, f) = limited.map_or(([0.0; 3], 1.0), |limited| (limited.middle, limited.factor));
                let along =
                    |f: f32, d: [f32; 3]| std::array::from_fn::<f32, 3, _>(|k| d[k] + (f - 1.0) * m[k] * dot(m, d));
                let slope = along(f, directed(std::array::from_fn(|k| ahead(k) * g[k] / (bound * tau))));
                let w: [f32; 3] = std::array::from_fn(|k| dual[k][at]);
                // D⁻¹ = 1 + n·nᵀ/(1 − |n|²)
                let p = along(1.0 / f, std::array::from_fn(|k| w[k] + n[k] * dot(n, w) / (1.0 - dot(n, n))));
                let p: [f32; 3] = std::array::from_fn(|k| p[k] + slope[k]);
                let length = dot(p, p).sqrt().max(1.0);
                let w = directed(along(f, p.map(|p| p / length)));
                (0..3).for_each(|k| dual[k][at] = w[k]);
            }
        }
        primal(dual)
    }

    /// Tiny volumes, lines shorter and longer than a vector, more steps than a sweep makes, slabs with and without
    /// neighbours: a sweep equals its single steps, bit by bit, for any number of threads.
    #[test]
    fn a_sweep_is_its_steps_one_by_one_on_any_number_of_threads() {
        let (g, tau) = ([1.0, 0.7, 1.3], 0.15f32);
        for (shape, steps) in [
            ([1, 1, 1], 3),
            ([2, 1, 17], 4),
            ([3, 5, 16], 1),
            ([1, 9, 33], 2),
            ([41, 4, 7], 4),
            ([64, 3, 35], 11),
            ([97, 2, 5], 5),
        ] {
            let v = noisy(shape);
            for (directional, limited) in [(false, false), (true, false), (false, true), (true, true)] {
                let made = || {
                    let mut made = if directional { with_edges(shape, g, &v) } else { prox(shape, g) };
                    if limited {
                        made.limited([0.6, 0.8, 0.0]);
                    }
                    made.confine(Bounds { low: 0.02, high: 0.9 }).unwrap();
                    if directional != limited {
                        let low: Vec<f32> = (0..v.len()).map(|i| 0.02 + 0.3 * (i % 3) as f32).collect();
                        let high = low.iter().enumerate().map(|(i, low)| low + 0.1 * (i % 2) as f32).collect();
                        made.confine_each(Arc::new([low, high])).unwrap();
                    }
                    made
                };
                let on = |threads: usize| {
                    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                    pool.install(|| {
                        let (mut prox, mut u) = (made(), Array3::from_elem(shape, f32::NAN));
                        for _ in 0..2 {
                            prox.apply(v.as_slice().unwrap(), tau, steps, u.as_slice_mut().unwrap());
                        }
                        (u, dual(prox))
                    })
                };
                let (u, p) = on(1);
                let mut slow = made();
                plain(&mut slow, &v, tau, steps);
                let want = plain(&mut slow, &v, tau, steps);
                let near = |a: &Array3<f32>, b: &Array3<f32>| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
                assert!(near(&u, &want) && p.iter().zip(dual(slow)).all(|(p, slow)| near(p, &slow)), "{shape:?}");
                for threads in [2, 3, 8] {
                    assert!(on(threads) == (u.clone(), p.clone()), "{shape:?} on {threads} threads");
                }
            }
        }
    }

    /// With and without pull and mask, for any number of threads: bit-identical to step, proximal map and momentum in
    /// turn.
    #[test]
    fn an_update_in_one_sweep_is_its_parts_one_after_another() {
        let (g, tau) = ([1.0, 0.7, 1.3], 0.15f32);
        for (shape, steps) in [([1, 1, 1], 1), ([3, 5, 16], 1), ([41, 4, 7], 4), ([64, 3, 35], 4), ([97, 2, 5], 5)] {
            let number = |seed: u64| {
                let mut i = 0;
                Array3::from_shape_simple_fn(shape, || {
                    i += 1;
                    unit(mix(seed, i)) - 0.3
                })
            };
            let (towards, inside) = (number(5), number(6).mapv(|x| x > -0.2));
            for (pulled, masked) in [(false, false), (true, true)] {
                let run = |threads: usize, swept: bool| {
                    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                    pool.install(|| {
                        let mut prox = prox(shape, g);
                        let (mut ahead, mut x) = (number(1), number(2));
                        for seed in [3, 4] {
                            let mut gradient = number(seed);
                            let update = Update {
                                gradient: gradient.as_slice_mut().unwrap(),
                                ahead: ahead.as_slice_mut().unwrap(),
                                x: x.as_slice_mut().unwrap(),
                                step: 0.7,
                                momentum: 0.4,
                                towards: pulled.then_some((towards.as_slice().unwrap(), 0.2)),
                                inside: masked.then_some(inside.as_slice().unwrap()),
                            };
                            let left = if swept { prox.sweep(update, tau, steps) } else { Some(update) };
                            if let Some(update) = left {
                                update.around(|v, u| prox.apply(v, tau, steps, u));
                            }
                        }
                        (ahead, x, dual(prox))
                    })
                };
                let want = run(1, false);
                assert!(want.1.iter().any(|x| *x > 0.0));
                for threads in [1, 2, 3, 8] {
                    assert!(run(threads, true) == want, "{shape:?} on {threads} threads");
                }
            }
        }
    }

    #[test]
    fn total_variation_is_the_sum_of_slopes() {
        for shape in [[1, 1, 1], [3, 4, 5], [2, 3, 16], [4, 2, 39]] {
            let (x, g) = (noisy(shape), [1.0, 0.7, 1.3]);
            let mut want = 0.0;
            for ((i, j, k), here) in x.indexed_iter() {
                let ahead = [x.get([i + 1, j, k]), x.get([i, j + 1, k]), x.get([i, j, k + 1])];
                let squares = ahead.iter().zip(g).map(|(a, g)| a.map_or(0.0, |a| f64::from(g * (a - here)).powi(2)));
                want += squares.sum::<f64>().sqrt();
            }
            let found = total_variation(x.view(), g, None, None);
            assert!((found - want).abs() <= 1e-5 * want, "{shape:?}: {found} and {want}");
        }
    }

    #[test]
    fn slabs_are_thick_enough_for_what_they_copy() {
        for planes in [1, 7, 64, 256, 1000] {
            for threads in [1, 2, 16, 200] {
                for steps in [0, 1, 4, 100] {
                    let split = Split::new(planes, steps, threads);
                    let bounds = split.bounds(planes);
                    assert!(split.reach <= steps && (steps == 0 || split.reach > 0), "{split:?}");
                    assert_eq!((bounds[0], bounds[split.slabs]), (0, planes));
                    let thin = bounds.windows(2).any(|b| b[1] - b[0] < split.halo());
                    assert!(split.slabs == 1 || !thin, "{split:?} of {planes}");
                }
            }
        }
    }

    /// Attenuation of a micrometre-sized object in 1/mm is large: a weight of 0 must not cause a division by almost 0.
    #[test]
    fn no_weight_leaves_what_is_positive() {
        let v: Vec<f32> = noisy([9, 8, 19]).iter().map(|x| 1e4 * (x - 0.5)).collect();
        for tau in [0.0, 1e-45] {
            let mut u = vec![f32::NAN; v.len()];
            prox([9, 8, 19], [1.0; 3]).apply(&v, tau, 4, &mut u);
            assert!(u.iter().zip(&v).all(|(u, v)| *u == v.max(0.0)), "{tau}");
        }
    }

    #[test]
    fn the_slope_is_the_derivative() {
        let shape = [4, 5, 6];
        let g = [1.0, 0.7, 1.3];
        let mut x = noisy(shape);
        let smooth = |x: &Array3<f32>| {
            let all = x.as_slice().unwrap();
            let mut sum = 0.0;
            for ((i, j, k), &here) in x.indexed_iter() {
                let d = |at: Option<&f32>, g: f32| at.map_or(0.0, |a| f64::from(g * (a - here)));
                let (a, b, c) =
                    (d(x.get([i + 1, j, k]), g[0]), d(x.get([i, j + 1, k]), g[1]), d(x.get([i, j, k + 1]), g[2]));
                sum += (a * a + b * b + c * c + 1e-2).sqrt();
            }
            assert_eq!(all.len(), x.len());
            sum
        };
        for at in [[0, 0, 0], [1, 2, 3], [3, 4, 5], [2, 0, 5]] {
            let found = f64::from(slope(x.as_slice().unwrap(), shape, g, 1.0 / 0.1, at));
            let was = x[at];
            x[at] = was + 2e-3;
            let up = smooth(&x);
            x[at] = was - 2e-3;
            let want = (up - smooth(&x)) / 4e-3;
            x[at] = was;
            assert!((found - want).abs() < 2e-3, "{at:?}: {found} and {want}");
        }
    }
}
