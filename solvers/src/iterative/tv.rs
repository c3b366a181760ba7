//! Total variation of a volume: `Σ_j √(Σ_k (g_k·(x_{j+k} − x_j))²)` over voxels j and axes k, where differences across
//! voxels of different sides count by `g_k = h/h_k` with h the sides' geometric mean. At the far faces differences are 0.

use super::{flat, flat_mut};
use conefield_core::geometry::VoxelGrid;
use conefield_core::simd::{Op, Simd, SimdBase, SimdFloat, load, run, store};
use conefield_core::space::Space;
use ndarray::{Array3, ArrayView3};
use rayon::prelude::*;

/// Differences count by these, along x, y, z.
pub fn anisotropy(grid: &VoxelGrid) -> [f32; 3] {
    let h = grid.spacing.iter().product::<f64>().cbrt();
    grid.spacing.map(|s| (h / s) as f32)
}

/// The total variation of `x` itself.
pub fn total_variation(x: ArrayView3<'_, f32>, g: [f32; 3]) -> f64 {
    let (nx, ny, nz) = x.dim();
    let planes: Vec<f64> = (0..nx)
        .into_par_iter()
        .map(|i| {
            let mut sum = 0.0;
            for j in 0..ny {
                for k in 0..nz {
                    let here = x[[i, j, k]];
                    let d = |far: bool, at: [usize; 3], g: f32| if far { 0.0 } else { g * (x[at] - here) };
                    let (a, b) = (
                        d(i + 1 == nx, [(i + 1).min(nx - 1), j, k], g[0]),
                        d(j + 1 == ny, [i, (j + 1).min(ny - 1), k], g[1]),
                    );
                    let c = d(k + 1 == nz, [i, j, (k + 1).min(nz - 1)], g[2]);
                    sum += f64::from(a * a + b * b + c * c).sqrt();
                }
            }
            sum
        })
        .collect();
    planes.iter().sum()
}

/// The proximal map of total variation with `x ≥ 0`, by gradient steps on its dual, which starts where it ended before.
///
/// `argmin_{u ≥ 0} ½‖u − v‖² + τ·TV(u)`, with `u = max(0, v − τ·∇ᵀp)` and `|p_j| ≤ 1` (Beck and Teboulle, IEEE Trans. Image
/// Process. 18(11), 2009; without their momentum, which a warm start does not need).
pub struct TvProx {
    shape: [usize; 3],
    g: [f32; 3],
    /// The dual variable along x, y and z.
    dual: [Array3<f32>; 3],
}

impl TvProx {
    /// For volumes of `shape`, from a dual of 0.
    pub fn new(shape: [usize; 3], g: [f32; 3], space: &Space) -> Self {
        Self { shape, g, dual: std::array::from_fn(|_| space.array(shape)) }
    }

    /// The dual along x, y and z, for a checkpoint.
    pub fn state(&mut self) -> [&mut [f32]; 3] {
        self.dual.each_mut().map(flat_mut)
    }

    /// Overwrites `u` with the proximal map of `v` after `steps` dual steps. Without a weight only what is below 0 goes.
    pub fn apply(&mut self, v: &[f32], tau: f32, steps: usize, u: &mut [f32]) {
        if tau < f32::MIN_POSITIVE {
            return u.par_iter_mut().zip(v).for_each(|(u, v)| *u = v.max(0.0));
        }
        for _ in 0..steps {
            self.primal(v, tau, u);
            self.ascend(u, tau);
        }
        self.primal(v, tau, u);
    }

    /// `u = max(0, v − τ·∇ᵀp)`.
    fn primal(&self, v: &[f32], tau: f32, u: &mut [f32]) {
        let [_, ny, nz] = self.shape;
        let plane = ny * nz;
        let [px, py, pz] = self.dual.each_ref().map(flat);
        u.par_chunks_mut(plane).enumerate().for_each(|(i, u)| {
            let at = i * plane;
            let before = (i > 0).then(|| &px[at - plane..at]);
            run(Primal {
                v: &v[at..at + plane],
                before,
                p: [&px[at..at + plane], &py[at..at + plane], &pz[at..at + plane]],
                scale: self.g.map(|g| g * tau),
                nz,
                u,
            });
        });
    }

    /// `p ← p + ∇u/(L·τ)`, then back into the unit ball; L bounds `‖∇‖²`.
    fn ascend(&mut self, u: &[f32], tau: f32) {
        let [nx, ny, nz] = self.shape;
        let plane = ny * nz;
        let bound = 4.0 * self.g.iter().map(|g| g * g).sum::<f32>();
        let scale = self.g.map(|g| g / (bound * tau));
        let [px, py, pz] = self.dual.each_mut().map(flat_mut);
        px.par_chunks_mut(plane).zip(py.par_chunks_mut(plane)).zip(pz.par_chunks_mut(plane)).enumerate().for_each(
            |(i, ((px, py), pz))| {
                let at = i * plane;
                let after = (i + 1 < nx).then(|| &u[at + plane..at + 2 * plane]);
                run(Ascend { u: &u[at..at + plane], after, p: [px, py, pz], scale, nz });
            },
        );
    }
}

/// One plane of [`TvProx::primal`].
struct Primal<'a> {
    v: &'a [f32],
    /// The dual along x one plane before.
    before: Option<&'a [f32]>,
    p: [&'a [f32]; 3],
    scale: [f32; 3],
    nz: usize,
    u: &'a mut [f32],
}

impl Op for Primal<'_> {
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let len = S::f32s::LEN;
        let nz = self.nz;
        let scale = self.scale.map(|x| S::f32s::splat(s, x));
        let zero = S::f32s::splat(s, 0.0);
        let mut line = vec![0.0; nz + 1 + len];
        for (j, u) in self.u.chunks_mut(nz).enumerate() {
            let row = |x| -> &[f32] {
                let x: &[f32] = x;
                &x[j * nz..(j + 1) * nz]
            };
            let (v, px, py, pz) = (row(self.v), row(self.p[0]), row(self.p[1]), row(self.p[2]));
            let bx = self.before.map(row);
            let by = (j > 0).then(|| &self.p[1][(j - 1) * nz..j * nz]);
            // The dual along z one voxel on, so that the voxel before is read at the same index.
            line[1..=nz].copy_from_slice(pz);
            let mut k = 0;
            while k < nz {
                let behind = |b: Option<&[f32]>| b.map_or(zero, |b| load(s, b, k));
                let dx = behind(bx) - load(s, px, k);
                let dy = behind(by) - load(s, py, k);
                let dz = S::f32s::from_slice(s, &line[k..k + len]) - load(s, pz, k);
                let turn = dx * scale[0] + dy * scale[1] + dz * scale[2];
                store::<S, f32>((load(s, v, k) - turn).max(zero), u, k);
                k += len;
            }
        }
    }
}

/// One plane of [`TvProx::ascend`].
struct Ascend<'a> {
    u: &'a [f32],
    /// The next plane.
    after: Option<&'a [f32]>,
    p: [&'a mut [f32]; 3],
    scale: [f32; 3],
    nz: usize,
}

impl Op for Ascend<'_> {
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let len = S::f32s::LEN;
        let nz = self.nz;
        let ny = self.u.len() / nz;
        let scale = self.scale.map(|x| S::f32s::splat(s, x));
        let (zero, one) = (S::f32s::splat(s, 0.0), S::f32s::splat(s, 1.0));
        let mut line = vec![0.0; nz + 1 + len];
        let [px, py, pz] = self.p;
        for j in 0..ny {
            let at = j * nz..(j + 1) * nz;
            let u = &self.u[at.clone()];
            let nx = self.after.map(|a| &a[at.clone()]);
            let ny = (j + 1 < ny).then(|| &self.u[at.end..at.end + nz]);
            line[..nz].copy_from_slice(u);
            // No difference across the far face.
            line[nz] = u[nz - 1];
            let (px, py, pz) = (&mut px[at.clone()], &mut py[at.clone()], &mut pz[at]);
            let mut k = 0;
            while k < nz {
                let here = load(s, u, k);
                let ahead = |b: Option<&[f32]>| b.map_or(zero, |b| load(s, b, k) - here);
                let x = ahead(nx).mul_add(scale[0], load(s, px, k));
                let y = ahead(ny).mul_add(scale[1], load(s, py, k));
                let dz = S::f32s::from_slice(s, &line[k + 1..k + 1 + len]) - here;
                let z = dz.mul_add(scale[2], load(s, pz, k));
                let length = x.mul_add(x, y.mul_add(y, z * z)).sqrt();
                let shrink = one / length.max(one);
                store::<S, f32>(x * shrink, px, k);
                store::<S, f32>(y * shrink, py, k);
                store::<S, f32>(z * shrink, pz, k);
                k += len;
            }
        }
    }
}

/// Adds `−step·∇TV/‖∇TV‖` of the smoothed total variation to `x`: a step of ASD-POCS. `work` is scratch of `x`'s length.
/// Differences are counted in `smoothing`, so that their squares are of order one whatever the unit of `x`.
pub fn descend(x: &mut [f32], shape: [usize; 3], g: [f32; 3], step: f64, smoothing: f32, work: &mut [f32]) {
    let [nx, ny, nz] = shape;
    if !smoothing.is_normal() {
        return;
    }
    let unit = 1.0 / smoothing;
    let plane = ny * nz;
    let squares: Vec<f64> = work
        .par_chunks_mut(plane)
        .enumerate()
        .map(|(i, out)| {
            let mut sum = 0.0;
            for j in 0..ny {
                for k in 0..nz {
                    let grad = slope(x, shape, g, unit, [i, j, k]);
                    out[j * nz + k] = grad;
                    sum += f64::from(grad) * f64::from(grad);
                }
            }
            sum
        })
        .collect();
    let norm = squares.iter().sum::<f64>().sqrt();
    if norm > 0.0 {
        let factor = (step / norm) as f32;
        x.par_chunks_mut(plane).zip(work.par_chunks(plane)).for_each(|(x, d)| {
            x.iter_mut().zip(d).for_each(|(x, d)| *x -= factor * d);
        });
    }
    debug_assert_eq!(nx * plane, x.len());
}

/// Derivative of the smoothed total variation by one voxel; differences times `unit` are held against 1.
#[inline(always)]
fn slope(x: &[f32], shape: [usize; 3], g: [f32; 3], unit: f32, at: [usize; 3]) -> f32 {
    let stride = [shape[1] * shape[2], shape[2], 1];
    let index = at[0] * stride[0] + at[1] * stride[1] + at[2];
    // Forward differences at a voxel and what they are in length.
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
    use conefield_core::random::{mix, unit};
    use conefield_core::scan::ScanHeader;

    fn prox(shape: [usize; 3], g: [f32; 3]) -> TvProx {
        TvProx::new(shape, g, &Space::new(ScanHeader { views: 0, detector: [0; 2], volume: shape }))
    }

    fn noisy(shape: [usize; 3]) -> Array3<f32> {
        let mut i = 0;
        Array3::from_shape_fn(shape, |(x, _, _)| {
            i += 1;
            f32::from(u8::from(x > shape[0] / 2)) + 0.3 * (unit(mix(5, i)) - 0.5)
        })
    }

    /// Primal and dual objective of the proximal problem meet, which proves both right.
    #[test]
    fn the_duality_gap_closes() {
        let shape = [9, 8, 19];
        let (g, tau) = ([1.0, 0.7, 1.3], 0.15f32);
        let v = noisy(shape);
        let mut prox = prox(shape, g);
        let mut u = Array3::zeros(shape);
        let gap = |u: &Array3<f32>| {
            // P(u) = ½‖u − v‖² + τTV(u); D(p) = ½‖v‖² − ½‖max(0, v − τ∇ᵀp)‖², and u is that maximum.
            let half = |a: f64| 0.5 * a;
            let distance: f64 = u.iter().zip(&v).map(|(a, b)| f64::from(a - b).powi(2)).sum();
            let primal = half(distance) + f64::from(tau) * total_variation(u.view(), g);
            let square = |x: &Array3<f32>| x.iter().map(|&a| f64::from(a).powi(2)).sum::<f64>();
            let dual = half(square(&v)) - half(square(u));
            (primal - dual) / primal
        };
        let mut gaps = vec![];
        for steps in [5, 20, 400] {
            prox.apply(v.as_slice().unwrap(), tau, steps, u.as_slice_mut().unwrap());
            gaps.push(gap(&u));
        }
        assert!(gaps[2] < 2e-3 && gaps[2] > -1e-5 && gaps[0] > gaps[1] && gaps[1] > gaps[2], "{gaps:?}");
        assert!(total_variation(u.view(), g) < 0.5 * total_variation(v.view(), g));
    }

    /// Attenuation of a micrometre's object in 1/mm is large: without a weight nothing may be divided by next to nothing.
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
