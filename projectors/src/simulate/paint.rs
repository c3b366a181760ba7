//! Paints solids into voxels, one over the other.

use super::shape::{Solid, Turn, UPRIGHT, smooth_noise, turn};
use conefield_core::geometry::{Vec3, dot};
use conefield_core::parallel;
use ndarray::Array3;

/// A solid filled with a value.
#[derive(Debug, Clone)]
pub(super) struct Paint {
    solid: Solid,
    turn: Turn,
    value: f64,
    /// Half spaces that clip the solid: `normal · p > offset`.
    cuts: Vec<(Vec3, f64)>,
    /// Amplitude, frequency and seed of the surface's waves.
    wave: Option<(f64, f64, u64)>,
    texture: Texture,
}

#[derive(Debug, Clone, Copy)]
enum Texture {
    Even,
    /// Smooth variation of this amplitude and frequency.
    Smooth(f64, f64, u64),
    /// Thin winding clefts of another value, down to a depth below the surface.
    Clefts {
        value: f64,
        frequency: f64,
        width: f64,
        depth: f64,
    },
}

pub(super) fn ellipsoid(center: Vec3, radii: Vec3, value: f64) -> Paint {
    Paint::new(Solid::Ellipsoid { center, radii }, value)
}

pub(super) fn ball(center: Vec3, radius: f64, value: f64) -> Paint {
    ellipsoid(center, [radius; 3], value)
}

pub(super) fn block(center: Vec3, half: Vec3, value: f64) -> Paint {
    Paint::new(Solid::Box { center, half }, value)
}

pub(super) fn tube(from: Vec3, to: Vec3, radius: f64, value: f64) -> Paint {
    cone(from, to, [radius; 2], value)
}

pub(super) fn cone(from: Vec3, to: Vec3, radii: [f64; 2], value: f64) -> Paint {
    Paint::new(Solid::Tube { from, to, radii }, value)
}

/// Tubes from point to point.
pub(super) fn path(points: &[Vec3], radius: f64, value: f64) -> Vec<Paint> {
    points.windows(2).map(|p| tube(p[0], p[1], radius, value)).collect()
}

/// Makes a part on the right (-x) and on the left.
pub(super) fn both(make: impl Fn(f64) -> Vec<Paint>) -> Vec<Paint> {
    [make(-1.0), make(1.0)].concat()
}

impl Paint {
    fn new(solid: Solid, value: f64) -> Self {
        Self { solid, turn: UPRIGHT, value, cuts: Vec::new(), wave: None, texture: Texture::Even }
    }

    /// Rotates by degrees about x, y, z.
    pub(super) fn turned(mut self, degrees: Vec3) -> Self {
        self.turn = turn(degrees);
        self
    }

    /// Clips to `normal · p > offset`.
    pub(super) fn above(mut self, normal: Vec3, offset: f64) -> Self {
        self.cuts.push((normal, offset));
        self
    }

    /// Makes the surface wavy by `amplitude`.
    pub(super) fn wavy(mut self, amplitude: f64, frequency: f64, seed: u64) -> Self {
        self.wave = Some((amplitude, frequency, seed));
        self
    }

    /// Varies the values smoothly by `amplitude`.
    pub(super) fn textured(mut self, amplitude: f64, frequency: f64, seed: u64) -> Self {
        self.texture = Texture::Smooth(amplitude, frequency, seed);
        self
    }

    /// Adds clefts of `value`, as between the gyri of a brain.
    pub(super) fn cleft(mut self, value: f64, frequency: f64, width: f64, depth: f64) -> Self {
        self.texture = Texture::Clefts { value, frequency, width, depth };
        self
    }

    fn distance(&self, p: Vec3) -> f64 {
        let mut d = self.solid.distance(&self.turn, p);
        if let Some((amplitude, frequency, seed)) = self.wave
            // Waves matter near the surface only.
            && d.abs() < 4.0 * amplitude
        {
            d += amplitude * smooth_noise(p, frequency, seed);
        }
        for (normal, offset) in &self.cuts {
            d = d.max(offset - dot(*normal, p));
        }
        d
    }

    fn value(&self, p: Vec3, distance: f64) -> f64 {
        match self.texture {
            Texture::Even => self.value,
            Texture::Smooth(amplitude, frequency, seed) => {
                let coarse = smooth_noise(p, frequency, seed);
                self.value + amplitude * (0.65 * coarse + 0.35 * smooth_noise(p, 2.3 * frequency, seed.wrapping_add(1)))
            }
            Texture::Clefts { value, frequency, width, depth } => {
                let deep = -distance / depth;
                if deep > 1.0 {
                    return self.value;
                }
                // A winding surface lies where a smooth noise crosses zero; it thins out downwards.
                let width = width * (1.0 - deep.max(0.0));
                let n = smooth_noise(p, frequency, 71) + 0.5 * smooth_noise(p, 1.9 * frequency, 72);
                let open = (1.0 - n.abs() / width.max(1e-9)).clamp(0.0, 1.0);
                self.value + open * (value - self.value)
            }
        }
    }
}

/// Paints the solids in order into a cube of `n³` voxels, later ones over earlier ones. At an edge, a voxel's coverage
/// is the share of 3³ points inside. Values are clipped to 0 to 1.
pub(super) fn paint(n: usize, paints: &[Paint]) -> Array3<f32> {
    const POINTS: usize = 3;
    let voxel = 2.0 / n as f64;
    let center = |i: usize| (i as f64 + 0.5) * voxel - 1.0;
    // Bounds in voxels, with room for waves.
    let reach: Vec<[[usize; 2]; 3]> = paints
        .iter()
        .map(|paint| {
            let [low, high] = paint.solid.bounds(&paint.turn);
            let margin = voxel + paint.wave.map_or(0.0, |w| w.0);
            let index = |x: f64| ((x + 1.0) / voxel).clamp(0.0, n as f64);
            std::array::from_fn(|k| [index(low[k] - margin).floor() as usize, index(high[k] + margin).ceil() as usize])
        })
        .collect();
    let mut out = Array3::<f32>::zeros((n, n, n));
    parallel::over(out.axis_iter_mut(ndarray::Axis(0)), |i, mut plane| {
        for (paint, reach) in paints.iter().zip(&reach) {
            if i < reach[0][0] || i >= reach[0][1] {
                continue;
            }
            for j in reach[1][0]..reach[1][1] {
                for k in reach[2][0]..reach[2][1] {
                    let p = [i, j, k].map(center);
                    let d = paint.distance(p);
                    if d > 1.5 * voxel {
                        continue;
                    }
                    let covered = if d < -1.5 * voxel {
                        1.0
                    } else {
                        let shift = |s: usize| ((s as f64 + 0.5) / POINTS as f64 - 0.5) * voxel;
                        let inside = (0..POINTS.pow(3))
                            .filter(|s| {
                                let s = [s % POINTS, s / POINTS % POINTS, s / (POINTS * POINTS)].map(shift);
                                paint.distance(std::array::from_fn(|k| p[k] + s[k])) < 0.0
                            })
                            .count();
                        inside as f64 / POINTS.pow(3) as f64
                    };
                    if covered > 0.0 {
                        let under = f64::from(plane[[j, k]]);
                        plane[[j, k]] = (under + covered * (paint.value(p, d) - under)) as f32;
                    }
                }
            }
        }
        plane.mapv_inplace(|x| x.clamp(0.0, 1.0));
    });
    out
}
