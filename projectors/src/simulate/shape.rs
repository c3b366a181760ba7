//! Solids with signed distances: the parts of phantoms.
//!
//! Coordinates are relative to the phantom's cube, -1 to 1 along each axis.

use conefield_core::geometry::{Vec3, dot, norm, sub};

/// A solid body.
#[derive(Debug, Clone, Copy)]
pub(super) enum Solid {
    /// Half axes along the (rotated) axes.
    Ellipsoid { center: Vec3, radii: Vec3 },
    /// Half sides along the (rotated) axes.
    Box { center: Vec3, half: Vec3 },
    /// A tube with round ends whose radius changes linearly from one value to the other.
    Tube { from: Vec3, to: Vec3, radii: [f64; 2] },
}

/// The rows are the axes of a rotated body.
pub(super) type Turn = [Vec3; 3];

/// No rotation.
pub(super) const UPRIGHT: Turn = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

/// Rotation by these angles in degrees, first about x, then y, then z.
pub(super) fn turn(degrees: Vec3) -> Turn {
    let about = |v: Vec3, axis: usize| {
        let (s, c) = degrees[axis].to_radians().sin_cos();
        let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
        let mut out = v;
        out[a] = c * v[a] - s * v[b];
        out[b] = s * v[a] + c * v[b];
        out
    };
    UPRIGHT.map(|v| (0..3).fold(v, about))
}

impl Solid {
    /// Distance to the surface, negative inside; exact at the surface, with the right sign everywhere.
    pub(super) fn distance(&self, turn: &Turn, p: Vec3) -> f64 {
        match self {
            Self::Ellipsoid { center, radii } => {
                let local = turned(turn, sub(p, *center));
                let unit: Vec3 = std::array::from_fn(|k| local[k] / radii[k]);
                let slope: Vec3 = std::array::from_fn(|k| unit[k] / radii[k]);
                let (r, s) = (norm(unit), norm(slope));
                // The centre itself has no nearest direction: the smallest half axis serves.
                if s == 0.0 { -radii.iter().copied().fold(f64::INFINITY, f64::min) } else { r * (r - 1.0) / s }
            }
            Self::Box { center, half } => {
                let local = turned(turn, sub(p, *center));
                let out: Vec3 = std::array::from_fn(|k| local[k].abs() - half[k]);
                let inside = out[0].max(out[1]).max(out[2]).min(0.0);
                norm(out.map(|x| x.max(0.0))) + inside
            }
            Self::Tube { from, to, radii } => {
                let (axis, p) = (sub(*to, *from), sub(p, *from));
                let t = (dot(p, axis) / dot(axis, axis).max(1e-12)).clamp(0.0, 1.0);
                norm(sub(p, axis.map(|x| x * t))) - (radii[0] + t * (radii[1] - radii[0]))
            }
        }
    }

    /// Lower and upper corner of a box around the solid.
    pub(super) fn bounds(&self, turn: &Turn) -> [Vec3; 2] {
        let around = |center: &Vec3, half: Vec3| {
            [std::array::from_fn(|k| center[k] - half[k]), std::array::from_fn(|k| center[k] + half[k])]
        };
        match self {
            Self::Ellipsoid { center, radii } => {
                around(center, std::array::from_fn(|k| norm(std::array::from_fn(|a| turn[a][k] * radii[a]))))
            }
            Self::Box { center, half } => {
                around(center, std::array::from_fn(|k| (0..3).map(|a| (turn[a][k] * half[a]).abs()).sum()))
            }
            Self::Tube { from, to, radii } => {
                let r = radii[0].max(radii[1]);
                [std::array::from_fn(|k| from[k].min(to[k]) - r), std::array::from_fn(|k| from[k].max(to[k]) + r)]
            }
        }
    }
}

fn turned(turn: &Turn, p: Vec3) -> Vec3 {
    turn.map(|axis| dot(axis, p))
}

/// Smooth noise between -1 and 1 that varies over lengths of `1/frequency`: random values on a lattice, blended.
pub(super) fn smooth_noise(p: Vec3, frequency: f64, seed: u64) -> f64 {
    let q = p.map(|x| x * frequency);
    let cell = q.map(f64::floor);
    let blend: Vec3 = std::array::from_fn(|k| {
        let t = q[k] - cell[k];
        t * t * (3.0 - 2.0 * t)
    });
    let corner = |i: usize, j: usize, k: usize| {
        let at = [i, j, k];
        let mut h = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        for (&at, &cell) in at.iter().zip(&cell) {
            // Mixed after every coordinate, so that neighbours are independent.
            h = (h ^ (cell as i64).wrapping_add(at as i64) as u64).wrapping_mul(0xff51_afd7_ed55_8ccd);
            h = (h ^ (h >> 33)).wrapping_mul(0xc4ce_b9fe_1a85_ec53);
            h ^= h >> 33;
        }
        (h >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    let mix = |a: f64, b: f64, t: f64| a + t * (b - a);
    let along_z = |i, j| mix(corner(i, j, 0), corner(i, j, 1), blend[2]);
    let along_y = |i| mix(along_z(i, 0), along_z(i, 1), blend[1]);
    mix(along_y(0), along_y(1), blend[0])
}
