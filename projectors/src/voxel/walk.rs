//! The voxels along a ray and the millimetres in each.

use super::{Siddon, Trilinear};
use conefield_core::geometry::{Geometry, Ray, Vec3, VoxelGrid, norm, sub};
use std::ops::Range;

/// A ray in voxel coordinates: `source + t·ahead`, where `t = 1` is the pixel.
#[derive(Debug, Clone, Copy)]
pub struct VoxelRay {
    /// The source in voxel coordinates; integers are voxel centres.
    pub source: Vec3,
    /// From the source to the pixel, in voxels.
    pub ahead: Vec3,
    /// The length from `t = 0` to `t = 1` in mm.
    pub length: f64,
}

impl VoxelRay {
    /// The ray of a pixel.
    pub fn of(geometry: &Geometry, view: usize, row: usize, column: usize) -> Self {
        let w = &geometry.views[view];
        let d = sub(w.pixel(geometry.detector, row as f64, column as f64), w.source);
        let h = geometry.volume.spacing;
        Self {
            source: super::layout::to_voxels(&geometry.volume, w.source),
            ahead: std::array::from_fn(|k| d[k] / h[k]),
            length: norm(d),
        }
    }

    pub(super) fn at(&self, k: usize, t: f64) -> f64 {
        self.source[k] + t * self.ahead[k]
    }

    /// The range of `t`, from the source on, in which `lower ≤ position ≤ upper` on every axis; `None` if it is empty.
    pub(super) fn clip(&self, lower: Vec3, upper: Vec3) -> Option<[f64; 2]> {
        Ray { origin: self.source, direction: self.ahead }.clip([lower, upper])
    }
}

/// Enumerates the voxels `(x, y, z)` along a ray with their weights in mm.
pub trait Walk: Sync {
    /// Visits the voxels with `x` in `slab`. A voxel's weight must not depend on the slab except by rounding.
    fn walk(&self, ray: &VoxelRay, grid: &VoxelGrid, slab: &Range<usize>, visit: impl FnMut([usize; 3], f64));
}

/// The exact length of the ray inside each voxel (Siddon, Med. Phys. 12(2), 1985), traversed voxel by voxel (Amanatides
/// and Woo, Eurographics 1987).
impl Walk for Siddon {
    fn walk(&self, ray: &VoxelRay, grid: &VoxelGrid, slab: &Range<usize>, mut visit: impl FnMut([usize; 3], f64)) {
        let n = grid.shape;
        let lower = [slab.start as f64 - 0.5, -0.5, -0.5];
        let upper = [slab.end as f64 - 0.5, n[1] as f64 - 0.5, n[2] as f64 - 0.5];
        let Some([near, far]) = ray.clip(lower, upper) else { return };
        // A ray within the plane between two slabs is in both: it counts in the one that begins there.
        if ray.ahead[0] == 0.0 && !slab.contains(&((ray.source[0] + 0.5).floor().max(0.0) as usize).min(n[0] - 1)) {
            return;
        }
        let first = [slab.start, 0, 0];
        let last = [slab.end - 1, n[1] - 1, n[2] - 1];
        // Just inside, so that rounding cannot put the first voxel outside.
        let start = near + 1e-9 * (far - near);
        let mut voxel: [usize; 3] =
            std::array::from_fn(|k| ((ray.at(k, start) + 0.5).floor().max(0.0) as usize).clamp(first[k], last[k]));
        let wall = |k: usize, voxel: usize| {
            let side = if ray.ahead[k] > 0.0 { 0.5 } else { -0.5 };
            if ray.ahead[k] == 0.0 { f64::INFINITY } else { (voxel as f64 + side - ray.source[k]) / ray.ahead[k] }
        };
        let mut next: Vec3 = std::array::from_fn(|k| wall(k, voxel[k]));
        let mut t = near;
        loop {
            let k = (0..3).min_by(|&a, &b| next[a].total_cmp(&next[b])).unwrap_or(0);
            let end = next[k].min(far);
            if end > t {
                visit(voxel, (end - t) * ray.length);
                t = end;
            }
            if next[k] >= far {
                return;
            }
            let up = ray.ahead[k] > 0.0;
            if voxel[k] == if up { last[k] } else { first[k] } {
                return;
            }
            voxel[k] = if up { voxel[k] + 1 } else { voxel[k] - 1 };
            next[k] = wall(k, voxel[k]);
        }
    }
}

/// Trilinear interpolation at the midpoints of equal steps inside the box of the voxels; in its outer half voxel the
/// outermost values are constant.
impl Walk for Trilinear {
    fn walk(&self, ray: &VoxelRay, grid: &VoxelGrid, slab: &Range<usize>, mut visit: impl FnMut([usize; 3], f64)) {
        let n = grid.shape;
        let Some([near, far]) = ray.clip([-0.5; 3], n.map(|n| n as f64 - 0.5)) else { return };
        let side = grid.spacing.into_iter().fold(f64::INFINITY, f64::min);
        let count = ((far - near) * ray.length * self.samples() / side).ceil().max(1.0);
        let step = (far - near) / count;
        // Samples that may touch the slab.
        let (lo, hi) = (slab.start as f64 - 1.0, slab.end as f64);
        let mut from = 0.0;
        let mut to = count;
        if ray.ahead[0] == 0.0 {
            if ray.source[0] < lo || ray.source[0] > hi {
                return;
            }
        } else {
            let index = |x: f64| ((x - ray.source[0]) / ray.ahead[0] - near) / step;
            let (a, b) = (index(lo), index(hi));
            from = (a.min(b) - 1.0).floor().max(0.0);
            to = (a.max(b) + 1.0).ceil().min(count);
        }
        let mut i = from;
        while i < to {
            let t = near + (i + 0.5) * step;
            let mut ends = [[(0usize, 0.0); 2]; 3];
            for k in 0..3 {
                let p = ray.at(k, t).clamp(0.0, n[k] as f64 - 1.0);
                let cell = (p.floor() as usize).min(n[k].saturating_sub(2));
                let f = p - cell as f64;
                ends[k] = [(cell, 1.0 - f), ((cell + 1).min(n[k] - 1), f)];
            }
            for (x, wx) in ends[0].into_iter().filter(|(x, _)| slab.contains(x)) {
                for (y, wy) in ends[1] {
                    for (z, wz) in ends[2] {
                        visit([x, y, z], wx * wy * wz * step * ray.length);
                    }
                }
            }
            i += 1.0;
        }
    }
}
