//! Voxels with line integrals by Joseph's method (IEEE Trans. Med. Imaging 1(3), 1982) instead of sums over samples.
//!
//! A ray steps through the planes of voxel centres perpendicular to its main axis. On each plane it takes the value
//! interpolated between the four nearest centres, times the distance between planes along the ray. A line integral is
//! linear in the voxels, and its adjoint takes the same walk. Values at points are those of
//! [`voxel_grid`](crate::voxel_grid), without an activation; as there, they are constant within half a voxel of the
//! surface.

use crate::voxel_grid::{Resolution, VoxelGridSettings, VoxelGridStage};
use conefield_core::activation::Activation;
use conefield_core::error::Result;
use conefield_core::settings::LineFieldSpec;
use conefield_core::simd::Real;
use conefield_core::stage::{Field, Grads, Info, Kernel, Lines, Parameter, Reduced, Stage, UnitRay};
use conefield_core::wgsl::Fragment;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Settings of `voxels-joseph`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VoxelsJoseph {
    /// Number of voxels along the unit cube's sides: one number, or three for x, y, z.
    pub resolution: Resolution,
    /// Initial value of every voxel, in the scale of the field.
    pub init: f64,
}

impl Default for VoxelsJoseph {
    fn default() -> Self {
        Self { resolution: Resolution::Cube(128), init: 0.0 }
    }
}

conefield_core::stage_type!(
    LineField,
    "voxels-joseph",
    VoxelsJoseph,
    "voxels with line integrals by Joseph, without an encoder",
    example = r#"{"resolution": [12, 17, 9]}"#
);

#[typetag::serde(name = "voxels-joseph")]
impl LineFieldSpec for VoxelsJoseph {
    fn build(&self) -> Result<Box<dyn Field>> {
        let grid = VoxelGridSettings { resolution: self.resolution, output: Activation::None, init: self.init };
        Ok(Box::new(VoxelsJosephStage { grid: VoxelGridStage::new(&grid, 3)? }))
    }
}

/// Approximate minimum number of voxels in a range summed by one worker.
const SLAB: usize = 1 << 14;

/// The stage that [`VoxelsJoseph`] builds.
#[derive(Debug, Clone, PartialEq)]
pub struct VoxelsJosephStage {
    grid: VoxelGridStage,
}

/// A ray's walk from plane to plane.
struct Walk {
    /// The axis perpendicular to the planes, and the other two.
    axes: [usize; 3],
    /// Planes that the ray crosses.
    planes: Range<usize>,
    /// Position along each of the other axes on plane 0, and its change per plane, in voxels.
    start: [f64; 2],
    step: [f64; 2],
    /// Length between two planes, in cube sides.
    length: f64,
}

impl Walk {
    /// The walk of `ray` through `side` voxels, counting those with an x in `slab`; `None` if it crosses none.
    fn of(ray: &UnitRay, side: [usize; 3], slab: &Range<usize>) -> Option<Self> {
        let [from, to] = ray.inside.map(f64::from);
        if to <= from {
            return None;
        }
        let n = side.map(|n| n as f64);
        let (origin, direction) = (ray.origin.map(f64::from), ray.direction.map(f64::from));
        // Position at t, in voxels: p + t·q; whole numbers are centres.
        let p: [f64; 3] = std::array::from_fn(|k| origin[k] * n[k] - 0.5);
        let q: [f64; 3] = std::array::from_fn(|k| direction[k] * n[k]);
        let across = (0..3).max_by(|&a, &b| q[a].abs().total_cmp(&q[b].abs()))?;
        if q[across] == 0.0 {
            return None;
        }
        let axes = [[0, 1, 2], [1, 0, 2], [2, 0, 1]][across];
        let slope = |k: usize| q[k] / q[across];
        let start = [axes[1], axes[2]].map(|k| p[k] - p[across] * slope(k));
        let step = [axes[1], axes[2]].map(slope);
        let ends = [from, to].map(|t| p[across] + t * q[across]);
        let (mut low, mut high) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
        // Planes on which the ray can reach the slab; a few too many do no harm.
        let open = [slab.start == 0, slab.end == side[0]];
        let within = [
            if open[0] { f64::NEG_INFINITY } else { slab.start as f64 - 1.5 },
            if open[1] { f64::INFINITY } else { slab.end as f64 + 0.5 },
        ];
        if across == 0 {
            (low, high) = (low.max(within[0]), high.min(within[1]));
        } else if step[0].abs() > 1e-9 {
            let reach = within.map(|x| (x - start[0]) / step[0]);
            (low, high) = (low.max(reach[0].min(reach[1]) - 1.0), high.min(reach[0].max(reach[1]) + 1.0));
        }
        let planes = low.ceil().max(0.0) as usize..(high.floor() + 1.0).clamp(0.0, n[across]) as usize;
        (!planes.is_empty()).then(|| Self { axes, planes, start, step, length: 1.0 / q[across].abs() })
    }

    /// Calls `take` with every voxel that the ray crosses, and its weight (a length).
    fn visit(&self, side: [usize; 3], mut take: impl FnMut(usize, f64)) {
        let strides = [side[1] * side[2], side[2], 1];
        let [a, b, c] = self.axes;
        for plane in self.planes.clone() {
            let at: [f64; 2] = std::array::from_fn(|k| {
                (self.start[k] + self.step[k] * plane as f64).clamp(0.0, (side[self.axes[k + 1]] - 1) as f64)
            });
            let (low, rest) = (at.map(|x| x as usize), at.map(f64::fract));
            for (i, wi) in [(low[0], 1.0 - rest[0]), (low[0] + 1, rest[0])] {
                for (j, wj) in [(low[1], 1.0 - rest[1]), (low[1] + 1, rest[1])] {
                    if wi * wj > 0.0 {
                        take(plane * strides[a] + i * strides[b] + j * strides[c], wi * wj * self.length);
                    }
                }
            }
        }
    }
}

impl<R: Real> Lines<R> for VoxelsJosephStage {
    fn project(&self, params: &[R], rays: &[UnitRay], out: &mut [R]) {
        let side = self.grid.side();
        for (ray, out) in rays.iter().zip(out) {
            let mut sum = 0.0;
            if let Some(walk) = Walk::of(ray, side, &(0..side[0])) {
                walk.visit(side, |voxel, length| sum += params[voxel].f64() * length);
            }
            *out = R::of(sum);
        }
    }

    fn backproject(&self, _: &[R], rays: &[UnitRay], dlines: &[R], grads: Grads<'_, R>) {
        let side = self.grid.side();
        let plane = side[1] * side[2];
        let Range { start, end } = grads.range;
        let slab = start / plane..end.div_ceil(plane);
        for (ray, dline) in rays.iter().zip(dlines) {
            let Some(walk) = Walk::of(ray, side, &slab) else { continue };
            walk.visit(side, |voxel, length| {
                if (start..end).contains(&voxel) {
                    grads.values[voxel - start] += R::of(length * dline.f64());
                }
            });
        }
    }
}

impl Stage for VoxelsJosephStage {
    fn info(&self) -> Info {
        self.grid.info()
    }

    fn parameters(&self) -> Vec<Parameter> {
        self.grid.parameters()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        self.grid.init(seed, params);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self.grid.kernel()
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        self.grid.reference()
    }

    fn partition(&self) -> Vec<Range<usize>> {
        self.grid.slabs(SLAB)
    }

    fn wgsl(&self) -> Option<Fragment> {
        self.grid.wgsl()
    }

    fn describe(&self) -> String {
        let [x, y, z] = self.grid.side();
        format!("voxels-joseph: {x} x {y} x {z} voxels, line integrals by Joseph")
    }
}

impl Field for VoxelsJosephStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        let Reduced { params, channels, .. } = self.grid.keep_inputs(keep)?;
        Ok(Reduced { stage: Box::new(self.clone()), params, channels })
    }

    fn lines(&self) -> Option<&dyn Lines<f32>> {
        Some(self)
    }

    fn lines_reference(&self) -> Option<&dyn Lines<f64>> {
        Some(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray(origin: [f32; 3], direction: [f32; 3]) -> UnitRay {
        UnitRay { origin, direction, inside: [0.0, 3.0], published: [0.0, 3.0], per_mm: 1.0 }
    }

    fn line(side: [u32; 3], params: &[f64], ray: UnitRay) -> f64 {
        let grid = VoxelGridSettings { resolution: Resolution::Axes(side), output: Activation::None, init: 0.0 };
        let stage = VoxelsJosephStage { grid: VoxelGridStage::new(&grid, 3).unwrap() };
        let mut out = [f64::NAN];
        stage.project(params, &[ray], &mut out);
        out[0]
    }

    #[test]
    fn a_ray_sums_what_it_meets() {
        let params: Vec<f64> = (0..24).map(f64::from).collect();
        // Along z through the centres of x = 1 of 2, y = 0 of 3.
        let along = ray([0.75, 1.0 / 6.0, -1.0], [0.0, 0.0, 1.0]);
        assert!((line([2, 3, 4], &params, along) - (12.0 + 13.0 + 14.0 + 15.0) / 4.0).abs() < 1e-6);
        // Between two columns it takes half of both, at the surface one.
        let between = ray([0.5, 1.0 / 6.0, -1.0], [0.0, 0.0, 1.0]);
        assert!((line([2, 3, 4], &params, between) - (1.5 + 13.5) / 2.0).abs() < 1e-6);
        let rim = ray([1.0, 1.0 / 6.0, -1.0], [0.0, 0.0, 1.0]);
        assert!((line([2, 3, 4], &params, rim) - 13.5).abs() < 1e-6);
        // The opposite direction gives the same line.
        let back = ray([0.75, 1.0 / 6.0, 2.0], [0.0, 0.0, -1.0]);
        assert_eq!(line([2, 3, 4], &params, back), line([2, 3, 4], &params, along));
    }

    #[test]
    fn constant_voxels_give_the_length_of_a_slanted_ray() {
        let n = 1.0 / 3f32.sqrt();
        let length = line([16; 3], &[2.0; 4096], ray([-0.1; 3], [n; 3]));
        assert!((length / (2.0 * 3f64.sqrt()) - 1.0).abs() < 1e-5, "{length}");
    }
}
