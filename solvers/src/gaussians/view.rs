//! Line integrals of Gaussians for all pixels of a view, and the derivatives of a loss on them.
//!
//! All rays of a view start at its source. With `y` from the source to the centre, and `D` from the source to a pixel,
//! the line integral of `ρ·exp(-½|M(x - c)|²)` along the whole ray is
//!
//! `A = ρ·√(2π)·|D|/√a·exp(-N/2a)`, with `a = |MD|²` and `N = |My × MD|²`.
//!
//! On the detector `D` is linear in row and column, so that `a` and `N` are quadratic polynomials. Relative to the
//! point `(u, v)` where the line through the centre meets the detector, `N` has no constant and no linear part:
//! `N = A·du² + 2B·du·dv + C·dv²`, without cancellation. This is exact for cone beams. Pixels with `N/a` above
//! [`EXTENT`]² get nothing; they lie outside a conic, which gives the columns of each row.
//!
//! The detector is divided into strips of rows, each with an ordered list of the Gaussians that reach it. Strips are
//! independent, and so are Gaussians in the back-projection. Results are bit-identical for any number of threads.

use super::lists::Lists;
use super::shape::{M3, Shape, Slope, V3, apply, cross, dot};
use conefield_core::simd::{self, Op, Real, Select, Simd, SimdBase, SimdFloat, V, WIDEST};
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Cutoff of a Gaussian's line integrals, in standard deviations. The truncated part of the sum over all pixels is
/// `exp(-EXTENT²/2)`, 0.2 %.
pub const EXTENT: f64 = 3.5;
/// Rows per strip.
const STRIP: usize = 16;
/// Gaussians per work item.
const CHUNK: usize = 256;

/// The rays of a view, in the unit cube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Beam {
    /// The source.
    pub source: V3,
    /// From the source to the centre of the pixel in row 0 and column 0.
    pub first: V3,
    /// From one column to the next.
    pub u: V3,
    /// From one row to the next.
    pub v: V3,
    /// Rows and columns.
    pub detector: [usize; 2],
}

/// The footprint of a Gaussian on a view's detector.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Footprint<R> {
    /// Column and row of the point where the line through the centre meets the detector.
    middle: [R; 2],
    /// Coefficients of `N`: of du², du·dv, dv².
    spread: [R; 3],
    /// Coefficients of `a`: of 1, du, dv, du², du·dv, dv².
    square: [R; 6],
    /// Coefficients of the conic `N - EXTENT²·a`: of du², and halved of du·dv and du.
    conic: [R; 3],
    /// `ρ·√(2π)`.
    weight: R,
    /// Rows that it reaches.
    rows: [u32; 2],
}

/// Moments over pixels of `w = dA·a^(-3/2)·exp(-N/2a)` and of `w·(1 - N/a)`: of 1, du, dv, du², du·dv, dv².
#[derive(Debug, Clone, Copy, Default)]
struct Moments {
    plain: [f64; 6],
    less: [f64; 6],
}

impl Beam {
    /// The row stride of an image: it leaves room for a vector beyond the last column.
    fn stride(&self) -> usize {
        self.detector[1] + WIDEST
    }

    /// Numbers in an image of this view, including padding.
    pub fn padded(&self) -> usize {
        self.stride() * self.detector[0]
    }

    /// Multiplies every pixel by `|D|`. Exact lengths enter here, once per pixel.
    fn scaled<R: Real>(&self, image: &mut [R]) {
        let (d, u, v) = (self.first, self.u, self.v);
        image.par_chunks_mut(self.stride()).enumerate().for_each(|(row, line)| {
            let start: V3 = std::array::from_fn(|k| d[k] + row as f64 * v[k]);
            let [c0, c1, c2] = [dot(start, start), 2.0 * dot(start, u), dot(u, u)];
            for (column, x) in line[..self.detector[1]].iter_mut().enumerate() {
                let c = column as f64;
                *x *= R::of(((c2 * c + c1) * c + c0).sqrt());
            }
        });
    }

    /// Where the line from the source through `y` meets the detector: column, row, and the factor from `D` to `y`;
    /// `None` for a point that is not in front of the detector's plane.
    fn meet(&self, y: V3, normal: V3) -> Option<([f64; 2], f64)> {
        let t = dot(y, normal) / dot(self.first, normal);
        if t <= 1e-9 {
            return None;
        }
        let p: V3 = std::array::from_fn(|k| y[k] / t - self.first[k]);
        let (uu, uv, vv) = (dot(self.u, self.u), dot(self.u, self.v), dot(self.v, self.v));
        let (pu, pv) = (dot(p, self.u), dot(p, self.v));
        let det = uu * vv - uv * uv;
        Some(([(pu * vv - pv * uv) / det, (pv * uu - pu * uv) / det], t))
    }

    /// The footprint of a Gaussian; `None` if no pixel sees it, or if it reaches the source.
    fn footprint<R: Real>(&self, shape: &Shape, normal: V3) -> Option<Footprint<R>> {
        if shape.density == 0.0 {
            return None;
        }
        let y: V3 = std::array::from_fn(|k| shape.centre[k] - self.source[k]);
        let (at, t) = self.meet(y, normal)?;
        let m = &shape.inverse;
        let (z, mu, mv) = (apply(m, y), apply(m, self.u), apply(m, self.v));
        let mc = z.map(|x| x / t);
        let (across, down) = (cross(z, mu), cross(z, mv));
        let [sa, sb, sc] = [dot(across, across), dot(across, down), dot(down, down)];
        let [a0, a1, a2] = [dot(mc, mc), dot(mc, mu), dot(mc, mv)];
        let [a11, a12, a22] = [dot(mu, mu), dot(mu, mv), dot(mv, mv)];
        let k = EXTENT * EXTENT;
        // qa·du² + 2(qb·dv + qd)·du + qc·dv² + 2·qe·dv + qf ≤ 0.
        let [qa, qb, qc, qd, qe, qf] = [sa - k * a11, sb - k * a12, sc - k * a22, -k * a1, -k * a2, -k * a0];
        // Rows with real end points: (qb·dv + qd)² ≥ qa·(qc·dv² + 2·qe·dv + qf).
        let [r2, r1, r0] = [qb * qb - qa * qc, qb * qd - qa * qe, qd * qd - qa * qf];
        // Not an ellipse: the Gaussian reaches the plane of the source.
        if qa <= 0.0 || r2 >= 0.0 {
            return None;
        }
        let half = (r1 * r1 - r2 * r0).max(0.0).sqrt();
        let [low, high] = [(r1 - half) / -r2, (r1 + half) / -r2];
        let first = (at[1] + low).ceil().max(0.0);
        let end = ((at[1] + high).floor() + 1.0).min(self.detector[0] as f64);
        // All columns that it reaches.
        let [c2, c1, c0] = [r2, qb * qe - qc * qd, qe * qe - qc * qf];
        let half = (c1 * c1 - c2 * c0).max(0.0).sqrt();
        let [left, right] = [at[0] + (c1 - half) / -c2, at[0] + (c1 + half) / -c2];
        if first >= end || right < 0.0 || left > (self.detector[1] - 1) as f64 {
            return None;
        }
        Some(Footprint {
            middle: at.map(R::of),
            spread: [sa, 2.0 * sb, sc].map(R::of),
            square: [a0, 2.0 * a1, 2.0 * a2, a11, 2.0 * a12, a22].map(R::of),
            conic: [qa, qb, qd].map(R::of),
            weight: R::of(shape.density * TAU.sqrt()),
            rows: [first as u32, end as u32],
        })
    }

    /// Derivatives of a loss with respect to `shape`, from the moments over its pixels.
    fn slope(&self, shape: &Shape, normal: V3, moments: &Moments) -> Slope {
        let y: V3 = std::array::from_fn(|k| shape.centre[k] - self.source[k]);
        let Some((_, t)) = self.meet(y, normal) else { return Slope::default() };
        let m = &shape.inverse;
        let (z, mu, mv) = (apply(m, y), apply(m, self.u), apply(m, self.v));
        let (d, mc) = (y.map(|x| x / t), z.map(|x| x / t));
        let p = &moments.plain;
        let root = TAU.sqrt();
        let density = root
            * (p[0] * dot(mc, mc)
                + 2.0 * (p[1] * dot(mc, mu) + p[2] * dot(mc, mv) + p[4] * dot(mu, mv))
                + p[3] * dot(mu, mu)
                + p[5] * dot(mv, mv));
        // Σ w·D·Dᵀ multiplied by M from the left: rows belong to M, columns to D.
        let spread = |s: &[f64; 6]| -> M3 {
            let part =
                |a: f64, b: f64, c: f64| -> V3 { std::array::from_fn(|k| a * d[k] + b * self.u[k] + c * self.v[k]) };
            let parts = [part(s[0], s[1], s[2]), part(s[1], s[3], s[4]), part(s[2], s[4], s[5])];
            std::array::from_fn(|i| {
                std::array::from_fn(|k| mc[i] * parts[0][k] + mu[i] * parts[1][k] + mv[i] * parts[2][k])
            })
        };
        // Without the constant, which vanishes because `N` has none.
        let free = [0.0, p[1], p[2], p[3], p[4], p[5]];
        let (full, bent) = (spread(&moments.less), spread(&free));
        // With respect to My: Σ w(|MD|²·z - (z·MD)·MD), whose component along z cancels.
        let [zc, zu, zv] = [dot(z, mc), dot(z, mu), dot(z, mv)];
        let trace = 2.0 * (p[1] * dot(mc, mu) + p[2] * dot(mc, mv) + p[4] * dot(mu, mv))
            + p[3] * dot(mu, mu)
            + p[5] * dot(mv, mv);
        let along = [p[1] * zu + p[2] * zv, p[1] * zc + p[3] * zu + p[4] * zv, p[2] * zc + p[4] * zu + p[5] * zv];
        let by: V3 = std::array::from_fn(|i| trace * z[i] - (mc[i] * along[0] + mu[i] * along[1] + mv[i] * along[2]));
        let zz = dot(z, z);
        let k = -shape.density * root;
        let across: V3 = std::array::from_fn(|j| z[0] * bent[0][j] + z[1] * bent[1][j] + z[2] * bent[2][j]);
        let inverse = std::array::from_fn(|i| {
            std::array::from_fn(|j| k * (full[i][j] + zz * bent[i][j] - z[i] * across[j] + by[i] * y[j]))
        });
        let centre = std::array::from_fn(|j| k * (by[0] * m[0][j] + by[1] * m[1][j] + by[2] * m[2][j]));
        Slope { centre, inverse, density }
    }
}

/// The footprints of all Gaussians on a view. Reused from view to view to keep its memory.
#[derive(Debug, Default)]
pub struct Sight<R> {
    seen: Vec<Footprint<R>>,
    /// The Gaussians of each strip.
    strips: Lists,
}

impl<R: Real> Sight<R> {
    /// Bytes per Gaussian: its footprint, and its entries in the lists of usually two strips.
    pub const BYTES: usize = size_of::<Footprint<R>>() + 16;

    /// Overwrites `image` (rows of [`Beam::padded`] length) with the line integrals of `shapes`, in cube sides.
    pub fn project(&mut self, beam: &Beam, shapes: &[Shape], image: &mut [R]) {
        self.look(beam, shapes);
        let (seen, strips, stride) = (&self.seen, &self.strips, beam.stride());
        image.par_chunks_mut(STRIP * stride).enumerate().for_each(|(i, lines)| {
            lines.fill(R::ZERO);
            simd::run(Splat { seen, list: strips.of(i), lines, stride, first: i * STRIP, columns: beam.detector[1] });
        });
        beam.scaled(image);
    }

    /// Overwrites `slopes` with the derivatives of a loss with respect to the shapes, from those with respect to the
    /// pixels of the last projected view in `image`, which is overwritten.
    pub fn backproject(&self, beam: &Beam, shapes: &[Shape], image: &mut [R], slopes: &mut [Slope]) {
        beam.scaled(image);
        let (seen, stride, normal) = (&self.seen, beam.stride(), cross(beam.u, beam.v));
        let image = &*image;
        slopes.par_chunks_mut(CHUNK).enumerate().for_each(|(i, slopes)| {
            let range = i * CHUNK..i * CHUNK + slopes.len();
            simd::run(Gather {
                beam,
                shapes: &shapes[range.clone()],
                seen: &seen[range],
                image,
                stride,
                normal,
                slopes,
            });
        });
    }

    /// Computes the footprint of each shape, and its strips.
    fn look(&mut self, beam: &Beam, shapes: &[Shape]) {
        let normal = cross(beam.u, beam.v);
        self.seen.resize(shapes.len(), Footprint::default());
        self.seen.par_iter_mut().zip(shapes).with_min_len(CHUNK).for_each(|(seen, shape)| {
            *seen = beam.footprint(shape, normal).unwrap_or_default();
        });
        let seen = &self.seen;
        self.strips.fill(beam.detector[0].div_ceil(STRIP), seen.len(), |i, put| {
            let [first, end] = seen[i].rows.map(|row| row as usize);
            if first < end {
                (first / STRIP..end.div_ceil(STRIP)).for_each(put);
            }
        });
    }
}

/// A few rows of a footprint, as many as a vector has lanes: the columns that it reaches, and its polynomials along
/// each.
struct Rows<R> {
    /// First column and the column after the last.
    columns: [[R; WIDEST]; 2],
    /// Distance from the row of the footprint's middle.
    dv: [R; WIDEST],
    /// Coefficients of `N` and of `a`: of 1 and of du.
    n: [[R; WIDEST]; 2],
    a: [[R; WIDEST]; 2],
}

impl<R: Real> Footprint<R> {
    /// Its rows from `row` on, on a detector of `columns` columns.
    #[inline(always)]
    fn rows<S: Simd>(&self, s: S, row: usize, columns: usize, out: &mut Rows<R>) {
        let len = V::<S, R>::LEN;
        let zero = V::<S, R>::splat(s, R::ZERO);
        let extent = V::<S, R>::splat(s, R::of(-EXTENT * EXTENT));
        let [_, s12, s22] = self.spread;
        let [a0, a1, a2, _, a12, a22] = self.square;
        let [qa, qb, qd] = self.conic;
        let dv = V::<S, R>::from_fn(s, |i| R::of(i as f64)) + (R::of(row as f64) - self.middle[1]);
        let n0 = dv * dv * s22;
        let a_ = (dv * a22 + a2).mul_add(dv, V::<S, R>::splat(s, a0));
        let half = dv * qb + qd;
        let disc = half * half - extent.mul_add(a_, n0) * qa;
        let root = disc.max(zero).sqrt();
        let inverse = V::<S, R>::splat(s, R::ONE / qa);
        let middle = V::<S, R>::splat(s, self.middle[0]);
        let low = (middle - (half + root) * inverse).ceil().max(zero);
        let high = (middle - (half - root) * inverse).floor() + R::ONE;
        let high = high.max(zero).min(V::<S, R>::splat(s, R::of(columns as f64)));
        // Rows beyond its ends have no columns.
        let high = disc.simd_ge(zero).select(high, zero);
        low.store_slice(&mut out.columns[0][..len]);
        high.store_slice(&mut out.columns[1][..len]);
        dv.store_slice(&mut out.dv[..len]);
        n0.store_slice(&mut out.n[0][..len]);
        (dv * s12).store_slice(&mut out.n[1][..len]);
        a_.store_slice(&mut out.a[0][..len]);
        (dv * a12 + a1).store_slice(&mut out.a[1][..len]);
    }
}

impl<R: Real> Rows<R> {
    const NONE: Self = Self {
        columns: [[R::ZERO; WIDEST]; 2],
        dv: [R::ZERO; WIDEST],
        n: [[R::ZERO; WIDEST]; 2],
        a: [[R::ZERO; WIDEST]; 2],
    };
}

/// Sums the Gaussians of `list` into the rows of an image.
struct Splat<'a, R> {
    seen: &'a [Footprint<R>],
    list: &'a [u32],
    lines: &'a mut [R],
    stride: usize,
    first: usize,
    columns: usize,
}

impl<R: Real> Op for Splat<'_, R> {
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let len = V::<S, R>::LEN;
        let step = V::<S, R>::from_fn(s, |i| R::of(i as f64));
        let (zero, most) = (V::<S, R>::splat(s, R::ZERO), V::<S, R>::splat(s, R::of(EXTENT * EXTENT)));
        let rows = self.lines.len() / self.stride;
        let mut some = Rows::NONE;
        for &g in self.list {
            let f = &self.seen[g as usize];
            let weight = V::<S, R>::splat(s, f.weight);
            let (n2, a2) = (V::<S, R>::splat(s, f.spread[0]), V::<S, R>::splat(s, f.square[3]));
            let from = (f.rows[0] as usize).max(self.first);
            let to = (f.rows[1] as usize).min(self.first + rows);
            for start in (from..to).step_by(len) {
                f.rows(s, start, self.columns, &mut some);
                for i in 0..len.min(to - start) {
                    let first = (start + i - self.first) * self.stride;
                    let (mut c, end) = (some.columns[0][i].count() as usize, some.columns[1][i].count() as usize);
                    let (n0, n1) = (V::<S, R>::splat(s, some.n[0][i]), V::<S, R>::splat(s, some.n[1][i]));
                    let (a0, a1) = (V::<S, R>::splat(s, some.a[0][i]), V::<S, R>::splat(s, some.a[1][i]));
                    while c < end {
                        let du = step + (R::of(c as f64) - f.middle[0]);
                        let n = n2.mul_add(du, n1).mul_add(du, n0);
                        let a = a2.mul_add(du, a1).mul_add(du, a0);
                        let root = R::inverse_root_lanes(s, a);
                        let e = n * (root * root);
                        let value = R::exp_lanes(s, e * R::of(-0.5)) * (root * weight);
                        let value = e.simd_le(most).select(value, zero);
                        let at = &mut self.lines[first + c..first + c + len];
                        (V::<S, R>::from_slice(s, at) + value).store_slice(at);
                        c += len;
                    }
                }
            }
        }
    }
}

/// Moments over the pixels of an image, and derivatives from them.
struct Gather<'a, R> {
    beam: &'a Beam,
    shapes: &'a [Shape],
    seen: &'a [Footprint<R>],
    image: &'a [R],
    stride: usize,
    normal: V3,
    slopes: &'a mut [Slope],
}

impl<R: Real> Op for Gather<'_, R> {
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let len = V::<S, R>::LEN;
        let step = V::<S, R>::from_fn(s, |i| R::of(i as f64));
        let (zero, one) = (V::<S, R>::splat(s, R::ZERO), V::<S, R>::splat(s, R::ONE));
        let most = V::<S, R>::splat(s, R::of(EXTENT * EXTENT));
        let mut some = Rows::NONE;
        for ((f, shape), slope) in self.seen.iter().zip(self.shapes).zip(self.slopes.iter_mut()) {
            *slope = Slope::default();
            let (from, to) = (f.rows[0] as usize, f.rows[1] as usize);
            if from == to {
                continue;
            }
            let (n2, a2) = (V::<S, R>::splat(s, f.spread[0]), V::<S, R>::splat(s, f.square[3]));
            let (mut plain, mut less) = ([zero; 6], [zero; 6]);
            for start in (from..to).step_by(len) {
                f.rows(s, start, self.beam.detector[1], &mut some);
                for i in 0..len.min(to - start) {
                    let first = (start + i) * self.stride;
                    let (mut c, end) = (some.columns[0][i].count() as usize, some.columns[1][i].count() as usize);
                    let (n0, n1) = (V::<S, R>::splat(s, some.n[0][i]), V::<S, R>::splat(s, some.n[1][i]));
                    let (a0, a1) = (V::<S, R>::splat(s, some.a[0][i]), V::<S, R>::splat(s, some.a[1][i]));
                    let (mut p0, mut p1, mut q0, mut q1) = (zero, zero, zero, zero);
                    while c < end {
                        let du = step + (R::of(c as f64) - f.middle[0]);
                        let n = n2.mul_add(du, n1).mul_add(du, n0);
                        let a = a2.mul_add(du, a1).mul_add(du, a0);
                        let root = R::inverse_root_lanes(s, a);
                        let inverse = root * root;
                        let e = n * inverse;
                        let d = V::<S, R>::from_slice(s, &self.image[first + c..first + c + len]);
                        let w = R::exp_lanes(s, e * R::of(-0.5)) * (root * inverse * d);
                        let w = e.simd_le(most).select(w, zero);
                        let x = w * (one - e);
                        let (wd, xd) = (w * du, x * du);
                        p0 += w;
                        p1 += wd;
                        plain[3] = wd.mul_add(du, plain[3]);
                        q0 += x;
                        q1 += xd;
                        less[3] = xd.mul_add(du, less[3]);
                        c += len;
                    }
                    let dv = V::<S, R>::splat(s, some.dv[i]);
                    for (all, (row0, row1)) in [(&mut plain, (p0, p1)), (&mut less, (q0, q1))] {
                        let down = row0 * dv;
                        all[0] += row0;
                        all[1] += row1;
                        all[2] += down;
                        all[4] = row1.mul_add(dv, all[4]);
                        all[5] = down.mul_add(dv, all[5]);
                    }
                }
            }
            let mut moments = Moments::default();
            for k in 0..6 {
                moments.plain[k] = plain[k].as_slice().iter().map(|x| x.f64()).sum();
                moments.less[k] = less[k].as_slice().iter().map(|x| x.f64()).sum();
            }
            *slope = self.beam.slope(shape, self.normal, &moments);
        }
    }
}
