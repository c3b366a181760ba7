//! Values of Gaussians at the points of a grid, and the gradient of a loss with respect to them.
//!
//! The grid is divided into slabs along x, each with the list of the Gaussians that reach it. Along z the exponent is a
//! quadratic polynomial, which gives the Gaussian's end points. Results are bit-identical for any number of threads.

use super::lists::Lists;
use super::shape::{M3, Shape, Slope, apply};
use conefield_core::geometry::{Vec3, dot};
use conefield_core::parallel;
use conefield_core::simd::{self, Op, Real, Select, Simd, SimdBase, SimdFloat, V, load, store};
use conefield_core::stage::UnitGrid;
use std::ops::Range;

/// Cutoff of a Gaussian in standard deviations. The truncated part of its integral is 0.1 %, less than for line
/// integrals, so that the volume matches its projections.
pub const EXTENT: f64 = 4.0;
/// Planes per slab.
const PLANES: usize = 2;
/// Gaussians per work item.
const CHUNK: usize = 64;

/// The Gaussians that reach a grid. Reused from grid to grid to keep its memory.
#[derive(Debug, Default)]
pub struct Grid {
    /// The Gaussians that reach the grid.
    reaching: Vec<Reach>,
    slabs: Lists,
}

/// A Gaussian that reaches a grid, and its range.
#[derive(Debug, Clone)]
struct Reach {
    index: usize,
    points: [Range<usize>; 3],
}

impl Grid {
    /// Finds the `shapes` that reach `grid`.
    pub fn look(&mut self, grid: &UnitGrid, shapes: &[Shape]) {
        let range = |centre: f64, reach: f64, k: usize| -> Range<usize> {
            let at = |x: f64| (x - grid.first[k]) / grid.spacing[k];
            let first = at(centre - reach).ceil().max(0.0) as usize;
            first..((at(centre + reach).floor() + 1.0).max(0.0) as usize).min(grid.shape[k])
        };
        let found = |(index, shape): (usize, &Shape)| {
            if shape.density == 0.0 {
                return None;
            }
            let reach = shape.reach(EXTENT);
            let points: [Range<usize>; 3] = std::array::from_fn(|k| range(shape.centre[k], reach[k], k));
            points.iter().all(|r| !r.is_empty()).then_some(Reach { index, points })
        };
        let parts = parallel::map(shapes.chunks(1024), |n, shapes| {
            (n * 1024..).zip(shapes).filter_map(found).collect::<Vec<_>>()
        });
        self.reaching.clear();
        self.reaching.extend(parts.into_iter().flatten());
        let reaching = &self.reaching;
        self.slabs.fill(grid.shape[0].div_ceil(PLANES), reaching.len(), |i, put| {
            let x = &reaching[i].points[0];
            (x.start / PLANES..x.end.div_ceil(PLANES)).for_each(put);
        });
    }

    /// Overwrites `out` (`[x, y, z]`, z fastest) with the values of the shapes found.
    pub fn values<R: Real>(&self, grid: &UnitGrid, shapes: &[Shape], out: &mut [R]) {
        let plane = grid.shape[1] * grid.shape[2];
        parallel::over(out.chunks_mut(PLANES * plane), |i, out| {
            out.fill(R::ZERO);
            let slab = i * PLANES..i * PLANES + out.len() / plane;
            simd::run(Paint { grid, shapes, reaching: &self.reaching, list: self.slabs.of(i), slab, out });
        });
    }

    /// The derivatives of a loss with respect to each shape found, with its index, from those with respect to the
    /// values of the grid.
    pub fn slopes<R: Real>(&self, grid: &UnitGrid, shapes: &[Shape], by: &[R]) -> Vec<(usize, Slope)> {
        let mut all = vec![(0, Slope::default()); self.reaching.len()];
        parallel::over(all.chunks_mut(CHUNK).zip(self.reaching.chunks(CHUNK)), |_, (out, reaching)| {
            simd::run(Collect { grid, shapes, reaching, by, out });
        });
        all
    }
}

/// A row of the grid along z: the exponent `|M(x - c)|²` is `n[0] + n[1]·dz + n[2]·dz²`.
struct Row<R> {
    n: [R; 3],
    /// Distance of point 0 from the centre.
    start: R,
    points: Range<usize>,
}

impl<R: Real> Row<R> {
    /// The row at distances dx and dy from the centre.
    #[inline(always)]
    fn of(grid: &UnitGrid, shape: &Shape, [dx, dy]: [f64; 2], points: &Range<usize>) -> Self {
        let m = &shape.inverse;
        let across = apply(m, [dx, dy, 0.0]);
        let down: Vec3 = [m[0][2], m[1][2], m[2][2]];
        let (n0, half, n2) = (dot(across, across), dot(across, down), dot(down, down));
        let start = grid.first[2] - shape.centre[2];
        let root = half * half - n2 * (n0 - EXTENT * EXTENT);
        let n = [n0, 2.0 * half, n2].map(R::of);
        if root < 0.0 {
            return Self { n, start: R::of(start), points: 0..0 };
        }
        let at = |dz: f64| (dz - start) / grid.spacing[2];
        let first = at((-half - root.sqrt()) / n2).ceil().max(points.start as f64) as usize;
        let end = (at((-half + root.sqrt()) / n2).floor() + 1.0).clamp(0.0, points.end as f64) as usize;
        Self { n, start: R::of(start), points: first..end }
    }
}

struct Paint<'a, R> {
    grid: &'a UnitGrid,
    shapes: &'a [Shape],
    reaching: &'a [Reach],
    list: &'a [u32],
    slab: Range<usize>,
    out: &'a mut [R],
}

impl<R: Real> Op for Paint<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let Self { grid, shapes, reaching, list, slab, out } = self;
        let [_, ny, nz] = grid.shape;
        let len = V::<S, R>::LEN;
        let spacing = R::of(grid.spacing[2]);
        let step = V::<S, R>::from_fn(s, |i| R::of(i as f64)) * spacing;
        let (zero, most) = (V::<S, R>::splat(s, R::ZERO), V::<S, R>::splat(s, R::of(EXTENT * EXTENT)));
        for &i in list {
            let Reach { index, points: [xs, ys, zs] } = &reaching[i as usize];
            let shape = &shapes[*index];
            let density = R::of(shape.density);
            for x in xs.start.max(slab.start)..xs.end.min(slab.end) {
                let dx = grid.first[0] + x as f64 * grid.spacing[0] - shape.centre[0];
                for y in ys.clone() {
                    let dy = grid.first[1] + y as f64 * grid.spacing[1] - shape.centre[1];
                    let row = Row::<R>::of(grid, shape, [dx, dy], zs);
                    let first = ((x - slab.start) * ny + y) * nz;
                    let line = &mut out[first..first + nz];
                    let (n0, n1) = (V::<S, R>::splat(s, row.n[0]), V::<S, R>::splat(s, row.n[1]));
                    let n2 = V::<S, R>::splat(s, row.n[2]);
                    let mut z = row.points.start;
                    while z < row.points.end {
                        let dz = step + (row.start + R::of(z as f64) * spacing);
                        let e = n2.mul_add(dz, n1).mul_add(dz, n0);
                        let value = R::exp_lanes(s, e * R::of(-0.5)) * density;
                        let value = e.simd_le(most).select(value, zero);
                        store::<S, R>(load(s, line, z) + value, line, z);
                        z += len;
                    }
                }
            }
        }
    }
}

struct Collect<'a, R> {
    grid: &'a UnitGrid,
    shapes: &'a [Shape],
    reaching: &'a [Reach],
    by: &'a [R],
    out: &'a mut [(usize, Slope)],
}

impl<R: Real> Op for Collect<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let Self { grid, shapes, reaching, by, out } = self;
        let [_, ny, nz] = grid.shape;
        let len = V::<S, R>::LEN;
        let spacing = R::of(grid.spacing[2]);
        let step = V::<S, R>::from_fn(s, |i| R::of(i as f64)) * spacing;
        let (zero, most) = (V::<S, R>::splat(s, R::ZERO), V::<S, R>::splat(s, R::of(EXTENT * EXTENT)));
        for (Reach { index, points: [xs, ys, zs] }, out) in reaching.iter().zip(out) {
            let shape = &shapes[*index];
            // Σ w of 1, d, and the upper half of d·dᵀ.
            let (mut sum, mut first, mut second) = (0.0, [0.0; 3], [0.0; 6]);
            for x in xs.clone() {
                let dx = grid.first[0] + x as f64 * grid.spacing[0] - shape.centre[0];
                for y in ys.clone() {
                    let dy = grid.first[1] + y as f64 * grid.spacing[1] - shape.centre[1];
                    let row = Row::<R>::of(grid, shape, [dx, dy], zs);
                    if row.points.is_empty() {
                        continue;
                    }
                    let begin = (x * ny + y) * nz;
                    let line = &by[begin..begin + nz];
                    let (n0, n1) = (V::<S, R>::splat(s, row.n[0]), V::<S, R>::splat(s, row.n[1]));
                    let n2 = V::<S, R>::splat(s, row.n[2]);
                    let (mut w0, mut w1, mut w2) = (zero, zero, zero);
                    let mut z = row.points.start;
                    while z < row.points.end {
                        let dz = step + (row.start + R::of(z as f64) * spacing);
                        let e = n2.mul_add(dz, n1).mul_add(dz, n0);
                        let w = R::exp_lanes(s, e * R::of(-0.5)) * load(s, line, z);
                        let w = e.simd_le(most).select(w, zero);
                        let wd = w * dz;
                        w0 += w;
                        w1 += wd;
                        w2 = wd.mul_add(dz, w2);
                        z += len;
                    }
                    let (mut a, mut b, mut c) = (0.0, 0.0, 0.0);
                    for i in 0..len {
                        a += w0.as_slice()[i].f64();
                        b += w1.as_slice()[i].f64();
                        c += w2.as_slice()[i].f64();
                    }
                    sum += a;
                    first = [first[0] + a * dx, first[1] + a * dy, first[2] + b];
                    let more = [a * dx * dx, a * dx * dy, b * dx, a * dy * dy, b * dy, c];
                    for k in 0..6 {
                        second[k] += more[k];
                    }
                }
            }
            *out = (*index, slope(shape, sum, first, second));
        }
    }
}

/// Derivatives with respect to a shape, from `Σ w`, `Σ w·d` and the upper half of `Σ w·d·dᵀ` with `w = dμ·exp(-½|Md|²)`
/// and `d` the displacement from the centre.
pub(super) fn slope(shape: &Shape, sum: f64, first: Vec3, [xx, xy, xz, yy, yz, zz]: [f64; 6]) -> Slope {
    let m = &shape.inverse;
    let spread: M3 = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let moved = apply(m, first);
    Slope {
        centre: std::array::from_fn(|j| shape.density * (0..3).map(|i| m[i][j] * moved[i]).sum::<f64>()),
        inverse: std::array::from_fn(|i| std::array::from_fn(|j| -shape.density * dot(m[i], spread[j]))),
        density: sum,
    }
}
