//! A Gaussian `ρ·exp(-½|M(x - c)|²)` and its eleven parameters.
//!
//! `M = diag(1/s)·Rᵀ` converts a displacement to standard deviations: `R` is the rotation of a quaternion, `s` are the
//! standard deviations along its axes. Lengths are in sides of the unit cube (Zha et al., R²-Gaussian, NeurIPS 2024,
//! eq. 4, with the covariance `R·diag(s²)·Rᵀ`).

use conefield_core::geometry::{Vec3, dot, sub};
use conefield_core::simd::Real;

/// Parameters of a Gaussian: centre (3), logarithms of the standard deviations (3), quaternion (4), density (1).
pub const NUMBERS: usize = 11;
/// Offset of the centre.
pub const CENTRE: usize = 0;
/// Offset of the logarithms of the standard deviations.
pub const SCALE: usize = 3;
/// Offset of the quaternion, real part first. Its norm does not matter.
pub const ROTATION: usize = 6;
/// Offset of the density before softplus.
pub const DENSITY: usize = 10;
/// The density before softplus of a free slot: its softplus is exactly 0.
pub const FREE: f32 = -1000.0;

/// A matrix of three rows.
pub type M3 = [Vec3; 3];

/// `m·x`.
#[inline(always)]
pub fn apply(m: &M3, x: Vec3) -> Vec3 {
    [dot(m[0], x), dot(m[1], x), dot(m[2], x)]
}

/// A Gaussian, decoded from its parameters.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Shape {
    /// Centre, in cube sides.
    pub centre: Vec3,
    /// Maps displacements to standard deviations.
    pub inverse: M3,
    /// Standard deviations along its own axes, in cube sides.
    pub deviations: Vec3,
    /// Value at the centre, at least 0; 0 if the slot is free.
    pub density: f64,
}

impl Shape {
    /// From [`NUMBERS`] parameters.
    #[inline]
    pub fn of<R: Real>(p: &[R]) -> Self {
        let n = |i: usize| p[i].f64();
        let raw = n(DENSITY);
        // A free slot: there is no logarithm to take.
        let density = if raw <= f64::from(FREE) { 0.0 } else { softplus(raw) };
        let deviations = [n(SCALE).exp(), n(SCALE + 1).exp(), n(SCALE + 2).exp()];
        let (turn, _) = rotation([n(ROTATION), n(ROTATION + 1), n(ROTATION + 2), n(ROTATION + 3)]);
        // Row k of M is column k of R over s_k.
        let inverse = std::array::from_fn(|k| [0, 1, 2].map(|j: usize| turn[j][k] / deviations[k]));
        Self { centre: [n(0), n(1), n(2)], inverse, deviations, density }
    }

    /// `ρ·exp(-½|M(x - c)|²)` at `x`; 0 beyond `extent` standard deviations.
    #[inline]
    pub fn value(&self, x: Vec3, extent: f64) -> f64 {
        let m = apply(&self.inverse, sub(x, self.centre));
        let e = dot(m, m);
        if e <= extent * extent { self.density * (-0.5 * e).exp() } else { 0.0 }
    }

    /// The largest standard deviation.
    pub fn longest(&self) -> f64 {
        self.deviations[0].max(self.deviations[1]).max(self.deviations[2])
    }

    /// Half sides of the box around all points within `extent` standard deviations.
    pub fn reach(&self, extent: f64) -> Vec3 {
        // Σ_jj = Σ_k (R_jk s_k)² with R_jk = M_kj s_k.
        std::array::from_fn(|j| {
            let along = |k: usize| self.inverse[k][j] * self.deviations[k] * self.deviations[k];
            extent * (along(0).powi(2) + along(1).powi(2) + along(2).powi(2)).sqrt()
        })
    }
}

/// Derivatives with respect to a [`Shape`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Slope {
    /// With respect to the centre.
    pub centre: Vec3,
    /// With respect to the entries of the matrix.
    pub inverse: M3,
    /// With respect to the density.
    pub density: f64,
}

impl Slope {
    /// Derivatives with respect to the parameters `p` of `shape`.
    pub fn by_parameters<R: Real>(&self, p: &[R], shape: &Shape) -> [f64; NUMBERS] {
        let mut out = [0.0; NUMBERS];
        out[CENTRE..SCALE].copy_from_slice(&self.centre);
        for k in 0..3 {
            out[SCALE + k] = -dot(self.inverse[k], shape.inverse[k]);
        }
        let q = [0, 1, 2, 3].map(|i: usize| p[ROTATION + i].f64());
        let ([w, x, y, z], length) = unit(q);
        // ∂L/∂R_jk = ∂L/∂M_kj / s_k.
        let d = |j: usize, k: usize| self.inverse[k][j] / shape.deviations[k];
        let by = [
            2.0 * (x * (d(2, 1) - d(1, 2)) + y * (d(0, 2) - d(2, 0)) + z * (d(1, 0) - d(0, 1))),
            2.0 * (y * (d(1, 0) + d(0, 1)) + z * (d(2, 0) + d(0, 2)) + w * (d(2, 1) - d(1, 2)))
                - 4.0 * x * (d(1, 1) + d(2, 2)),
            2.0 * (x * (d(1, 0) + d(0, 1)) + z * (d(2, 1) + d(1, 2)) + w * (d(0, 2) - d(2, 0)))
                - 4.0 * y * (d(0, 0) + d(2, 2)),
            2.0 * (x * (d(2, 0) + d(0, 2)) + y * (d(2, 1) + d(1, 2)) + w * (d(1, 0) - d(0, 1)))
                - 4.0 * z * (d(0, 0) + d(1, 1)),
        ];
        // The norm of a quaternion does not matter.
        let n = [w, x, y, z];
        let along: f64 = (0..4).map(|i| by[i] * n[i]).sum();
        for i in 0..4 {
            out[ROTATION + i] = (by[i] - along * n[i]) / length;
        }
        out[DENSITY] = self.density * sigmoid(p[DENSITY].f64());
        out
    }
}

/// The normalized quaternion, and its original norm.
fn unit(q: [f64; 4]) -> ([f64; 4], f64) {
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    if length > 1e-12 { (q.map(|x| x / length), length) } else { ([1.0, 0.0, 0.0, 0.0], 1.0) }
}

/// The rotation of a quaternion of any norm, and that norm.
fn rotation(q: [f64; 4]) -> (M3, f64) {
    let ([w, x, y, z], length) = unit(q);
    let turn = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    (turn, length)
}

fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// The inverse of softplus, for `x` above 0.
pub fn before_softplus(x: f64) -> f64 {
    if x > 20.0 { x } else { x.exp_m1().max(1e-30).ln() }
}
