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
use super::shape::{M3, Shape, Slope, apply};
use conefield_core::geometry::{Vec3, cross, dot, sub};
use conefield_core::parallel;
use conefield_core::simd::{self, Op, Real, Select, Simd, SimdBase, SimdFloat, V, WIDEST};
use std::f64::consts::TAU;
use std::ops::Range;

/// Cutoff of a Gaussian's line integrals, in standard deviations. The truncated part of the sum over all pixels is
/// `exp(-EXTENT²/2)`, 0.2 %.
pub const EXTENT: f64 = 3.5;
/// `exp(-x/2)` is 2 to the power of this times `x`.
const HALVINGS: f64 = -0.5 * std::f64::consts::LOG2_E;
/// Rows per strip.
const STRIP: usize = 16;
/// Gaussians per work item.
const CHUNK: usize = 256;
/// Rows whose pixels are computed together: each pixel is a long chain of dependent operations, and the chains overlap.
const TOGETHER: usize = 4;
/// Columns looked at beyond the computed ends of a row, because of rounding. Whether a pixel gets something depends on
/// its `N/a` alone, so that both directions decide alike.
const SLACK: f64 = 0.01;

/// The rays of a view, in the unit cube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Beam {
    /// The source.
    pub source: Vec3,
    /// From the source to the centre of the pixel in row 0 and column 0.
    pub first: Vec3,
    /// From one column to the next.
    pub u: Vec3,
    /// From one row to the next.
    pub v: Vec3,
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
        parallel::over(image.chunks_mut(self.stride()), |row, line| {
            let start: Vec3 = std::array::from_fn(|k| d[k] + row as f64 * v[k]);
            let [c0, c1, c2] = [dot(start, start), 2.0 * dot(start, u), dot(u, u)];
            for (column, x) in line[..self.detector[1]].iter_mut().enumerate() {
                let c = column as f64;
                *x *= R::of(((c2 * c + c1) * c + c0).sqrt());
            }
        });
    }

    /// Where the line from the source through `y` meets the detector: column, row, and the factor from `D` to `y`;
    /// `None` for a point that is not in front of the detector's plane.
    fn meet(&self, y: Vec3, normal: Vec3) -> Option<([f64; 2], f64)> {
        let t = dot(y, normal) / dot(self.first, normal);
        if t <= 1e-9 {
            return None;
        }
        let p: Vec3 = std::array::from_fn(|k| y[k] / t - self.first[k]);
        let (uu, uv, vv) = (dot(self.u, self.u), dot(self.u, self.v), dot(self.v, self.v));
        let (pu, pv) = (dot(p, self.u), dot(p, self.v));
        let det = uu * vv - uv * uv;
        Some(([(pu * vv - pv * uv) / det, (pv * uu - pu * uv) / det], t))
    }

    /// The footprint of a Gaussian; `None` if no pixel sees it, or if it reaches the source.
    fn footprint<R: Real>(&self, shape: &Shape, normal: Vec3) -> Option<Footprint<R>> {
        if shape.density == 0.0 {
            return None;
        }
        let y = sub(shape.centre, self.source);
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
    fn slope(&self, shape: &Shape, normal: Vec3, moments: &Moments) -> Slope {
        let y = sub(shape.centre, self.source);
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
                |a: f64, b: f64, c: f64| -> Vec3 { std::array::from_fn(|k| a * d[k] + b * self.u[k] + c * self.v[k]) };
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
        let by: Vec3 = std::array::from_fn(|i| trace * z[i] - (mc[i] * along[0] + mu[i] * along[1] + mv[i] * along[2]));
        let zz = dot(z, z);
        let k = -shape.density * root;
        let across: Vec3 = std::array::from_fn(|j| z[0] * bent[0][j] + z[1] * bent[1][j] + z[2] * bent[2][j]);
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
        parallel::over(image.chunks_mut(STRIP * stride), |i, lines| {
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
        parallel::over(slopes.chunks_mut(CHUNK), |i, slopes| {
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
        parallel::over(self.seen.chunks_mut(CHUNK).zip(shapes.chunks(CHUNK)), |_, (seen, shapes)| {
            for (seen, shape) in seen.iter_mut().zip(shapes) {
                *seen = beam.footprint(shape, normal).unwrap_or_default();
            }
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

/// Up to [`WIDEST`] rows of a footprint: the columns that it reaches, and its polynomials along each.
struct Rows<R> {
    /// First column and the column after the last; no columns if the first is not below it.
    columns: [[R; WIDEST]; 2],
    /// Distance from the row of the footprint's middle.
    dv: [R; WIDEST],
    /// Coefficients of [`HALVINGS`]`·N` and of `a`: of 1 and of du.
    n: [[R; WIDEST]; 2],
    a: [[R; WIDEST]; 2],
}

impl<R: Real> Footprint<R> {
    /// Its rows `rows` on a detector of `columns` columns. Whole groups of [`TOGETHER`] rows are filled; those after
    /// the last row lie outside the footprint.
    #[inline(always)]
    fn rows<S: Simd>(&self, s: S, rows: Range<usize>, columns: usize, out: &mut Rows<R>) {
        let len = V::<S, R>::LEN;
        let (zero, far) = (V::<S, R>::splat(s, R::ZERO), V::<S, R>::splat(s, R::of(-1e30)));
        let halvings = R::of(HALVINGS);
        let extent = V::<S, R>::splat(s, R::of(-EXTENT * EXTENT));
        let count = V::<S, R>::splat(s, R::of(rows.len() as f64));
        let lanes = V::<S, R>::from_fn(s, |i| R::of(i as f64));
        let [_, s12, s22] = self.spread;
        let [a0, a1, a2, _, a12, a22] = self.square;
        let [qa, qb, qd] = self.conic;
        let inverse = V::<S, R>::splat(s, R::ONE / qa);
        let (before, after) = (self.middle[0] - R::of(SLACK), self.middle[0] + R::of(SLACK));
        for k in (0..rows.len().next_multiple_of(TOGETHER)).step_by(len) {
            let lane = lanes + R::of(k as f64);
            let dv = lane + R::of(rows.start as f64) - self.middle[1];
            let n0 = dv * dv * s22;
            let a_ = (dv * a22 + a2).mul_add(dv, V::<S, R>::splat(s, a0));
            let half = dv * qb + qd;
            let disc = half * half - extent.mul_add(a_, n0) * qa;
            let root = disc.max(zero).sqrt();
            let low = (V::<S, R>::splat(s, before) - (half + root) * inverse).ceil().max(zero);
            let high = (V::<S, R>::splat(s, after) - (half - root) * inverse).floor() + R::ONE;
            let high = high.min(V::<S, R>::splat(s, R::of(columns as f64)));
            let inside = lane.simd_lt(count);
            // Rows that the ellipse does not meet have no columns.
            let high = inside.select(disc.simd_ge(zero).select(high, zero), zero);
            low.store_slice(&mut out.columns[0][k..k + len]);
            high.store_slice(&mut out.columns[1][k..k + len]);
            dv.store_slice(&mut out.dv[k..k + len]);
            inside.select(n0 * halvings, far).store_slice(&mut out.n[0][k..k + len]);
            (dv * (s12 * halvings)).store_slice(&mut out.n[1][k..k + len]);
            a_.store_slice(&mut out.a[0][k..k + len]);
            (dv * a12 + a1).store_slice(&mut out.a[1][k..k + len]);
        }
    }

    /// `1/√a` and [`HALVINGS`]`·N/a` in row `i` of `rows`, at the distances `du` from the footprint's middle.
    #[inline(always)]
    fn at<S: Simd>(&self, s: S, rows: &Rows<R>, i: usize, du: V<S, R>) -> [V<S, R>; 2] {
        let [n0, n1] = [rows.n[0][i], rows.n[1][i]];
        let [a0, a1] = [rows.a[0][i], rows.a[1][i]];
        let n2 = V::<S, R>::splat(s, self.spread[0] * R::of(HALVINGS));
        let n = n2.mul_add(du, V::<S, R>::splat(s, n1)).mul_add(du, V::<S, R>::splat(s, n0));
        let a2 = V::<S, R>::splat(s, self.square[3]);
        let a = a2.mul_add(du, V::<S, R>::splat(s, a1)).mul_add(du, V::<S, R>::splat(s, a0));
        let root = R::inverse_root_lanes(s, a);
        [root, n * (root * root)]
    }
}

impl<R: Real> Rows<R> {
    const NONE: Self = Self {
        columns: [[R::ZERO; WIDEST]; 2],
        dv: [R::ZERO; WIDEST],
        n: [[R::ZERO; WIDEST]; 2],
        a: [[R::ZERO; WIDEST]; 2],
    };

    /// The columns that any row of the group at `i` reaches.
    #[inline(always)]
    fn span(&self, i: usize) -> Range<usize> {
        let (mut low, mut high) = (R::of(1e9), R::ZERO);
        for k in i..i + TOGETHER {
            let (first, end) = (self.columns[0][k], self.columns[1][k]);
            if first < end {
                low = if first < low { first } else { low };
                high = if end > high { end } else { high };
            }
        }
        low.count() as usize..high.count() as usize
    }
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
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let len = V::<S, R>::LEN;
        let lanes = V::<S, R>::from_fn(s, |i| R::of(i as f64));
        let (zero, least) = (V::<S, R>::splat(s, R::ZERO), V::<S, R>::splat(s, R::of(HALVINGS * EXTENT * EXTENT)));
        let strip = self.lines.len() / self.stride;
        let mut some = Rows::NONE;
        for &g in self.list {
            let f = &self.seen[g as usize];
            let weight = V::<S, R>::splat(s, f.weight);
            let from = (f.rows[0] as usize).max(self.first);
            let to = (f.rows[1] as usize).min(self.first + strip);
            for start in (from..to).step_by(WIDEST) {
                let rows = start..to.min(start + WIDEST);
                f.rows(s, rows.clone(), self.columns, &mut some);
                for i in (0..rows.len()).step_by(TOGETHER) {
                    for c in some.span(i).step_by(len) {
                        let du = lanes + R::of(c as f64) - f.middle[0];
                        for k in i..i + TOGETHER {
                            let [root, x] = f.at(s, &some, k, du);
                            let value = R::exp2_lanes(s, x) * (root * weight);
                            let value = x.simd_ge(least).select(value, zero);
                            // A row after the last one adds 0 to the last.
                            let at = (start + k.min(rows.len() - 1) - self.first) * self.stride + c;
                            let pixels = &mut self.lines[at..at + len];
                            (V::<S, R>::from_slice(s, pixels) + value).store_slice(pixels);
                        }
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
    normal: Vec3,
    slopes: &'a mut [Slope],
}

impl<R: Real> Op for Gather<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let len = V::<S, R>::LEN;
        let lanes = V::<S, R>::from_fn(s, |i| R::of(i as f64));
        let (zero, one) = (V::<S, R>::splat(s, R::ZERO), V::<S, R>::splat(s, R::ONE));
        let least = V::<S, R>::splat(s, R::of(HALVINGS * EXTENT * EXTENT));
        let per_halving = V::<S, R>::splat(s, R::of(-1.0 / HALVINGS));
        let mut some = Rows::NONE;
        for ((f, shape), slope) in self.seen.iter().zip(self.shapes).zip(self.slopes.iter_mut()) {
            *slope = Slope::default();
            let (from, to) = (f.rows[0] as usize, f.rows[1] as usize);
            if from == to {
                continue;
            }
            let mut all = [[zero; 6]; 2];
            for start in (from..to).step_by(WIDEST) {
                let rows = start..to.min(start + WIDEST);
                f.rows(s, rows.clone(), self.beam.detector[1], &mut some);
                for i in (0..rows.len()).step_by(TOGETHER) {
                    for c in some.span(i).step_by(len) {
                        let du = lanes + R::of(c as f64) - f.middle[0];
                        // Sums over the group of w and of w·(1 - N/a), times 1, dv and dv².
                        let mut sums = [[zero; 3]; 2];
                        for k in i..i + TOGETHER {
                            let [root, x] = f.at(s, &some, k, du);
                            let at = (start + k.min(rows.len() - 1)) * self.stride + c;
                            let d = V::<S, R>::from_slice(s, &self.image[at..at + len]);
                            let w = R::exp2_lanes(s, x) * (root * root * root * d);
                            let w = x.simd_ge(least).select(w, zero);
                            let dv = V::<S, R>::splat(s, some.dv[k]);
                            for (sums, w) in sums.iter_mut().zip([w, w * x.mul_add(per_halving, one)]) {
                                let down = w * dv;
                                sums[0] += w;
                                sums[1] += down;
                                sums[2] = down.mul_add(dv, sums[2]);
                            }
                        }
                        for (all, [flat, down, bent]) in all.iter_mut().zip(sums) {
                            let along = flat * du;
                            all[0] += flat;
                            all[1] += along;
                            all[2] += down;
                            all[3] = along.mul_add(du, all[3]);
                            all[4] = down.mul_add(du, all[4]);
                            all[5] += bent;
                        }
                    }
                }
            }
            let [plain, less] = all.map(|sums| sums.map(|sum| sum.as_slice().iter().map(|x| x.f64()).sum()));
            *slope = self.beam.slope(shape, self.normal, &Moments { plain, less });
        }
    }
}
