//! Line integrals of a voxel volume.
//!
//! The volume is the trilinear interpolation of its voxel centres. In the outer half voxel, between the outermost
//! centres and the box of the voxels, the outermost values are constant. Outside the box there is nothing. A ray is
//! clipped to the box and sampled at the midpoints of equal steps.

use conefield_core::error::{Error, Result, ensure};
use conefield_core::finite::stray;
use conefield_core::geometry::Geometry;
use conefield_core::parallel;
use conefield_core::scan::Volume;
use ndarray::Array3;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Side of the blocks of cells that are skipped if empty.
const BLOCK: usize = 8;
/// Rows that one task processes together: neighbours along z read the same cache lines.
const BAND: usize = 16;

/// Line integrals `[view, row, column]` of `volume` (positioned by its own grid) for every pixel of `geometry`.
///
/// Values are per mm: a projection is Σ value · mm. `per_voxel_samples` is the minimum number of samples per smallest
/// voxel side, at least 2: the step is at most half a voxel. Positions are computed in `f64`, sampled in `f32` and
/// summed in `f64` block by block. The result does not depend on the number of threads.
pub fn project(volume: &Volume, geometry: &Geometry, per_voxel_samples: f64) -> Result<Array3<f32>> {
    project_with(volume, geometry, per_voxel_samples, &|_| {})
}

/// As [`project`]; calls `progress` with the share of finished views after each.
pub(super) fn project_with(
    volume: &Volume,
    geometry: &Geometry,
    per_voxel_samples: f64,
    progress: &(dyn Fn(f64) + Sync),
) -> Result<Array3<f32>> {
    geometry.validate("projection")?;
    volume.grid.validate("projection")?;
    ensure(
        (2.0..=256.0).contains(&per_voxel_samples),
        "projection",
        "samples per voxel",
        per_voxel_samples,
        "a number from 2 to 256",
    )?;
    let sampler = Sampler::new(volume, per_voxel_samples)?;
    let [rows, columns] = geometry.detector;
    let views = geometry.views.len();
    let count = geometry.measurements().unwrap_or(usize::MAX);
    let mut pixels = Vec::<f32>::new();
    if pixels.try_reserve_exact(count).is_err() {
        let found = format!("{views} views of {rows} x {columns}");
        return Err(Error::invalid("projection", "detector", found, "projections that fit in memory"));
    }
    pixels.resize(count, 0.0);
    let finished = AtomicUsize::new(0);
    parallel::over(pixels.chunks_mut(rows * columns), |view, pixels| {
        parallel::over(pixels.chunks_mut(BAND * columns), |band, pixels| {
            for column in 0..columns {
                for (r, row) in pixels.chunks_mut(columns).enumerate() {
                    row[column] = sampler.integral(geometry, view, band * BAND + r, column);
                }
            }
        });
        progress((finished.fetch_add(1, Ordering::Relaxed) + 1) as f64 / views as f64);
    });
    Array3::from_shape_vec((views, rows, columns), pixels)
        .map_err(|e| Error::invalid("projection", "detector", e, "as many pixels as the shape has"))
}

/// The volume padded by one voxel of the outermost values, so that every sample inside the box has eight neighbours.
struct Sampler {
    data: Vec<f32>,
    /// Strides in `data` along x and y (along z it is 1).
    stride: [usize; 2],
    /// Largest lower corner of a cell along each axis.
    last: [f32; 3],
    /// Whether a block of cells, or a neighbouring cell, has a nonzero value.
    occupied: Vec<bool>,
    /// Blocks along y and z.
    blocks: [usize; 2],
    bounds: [[f64; 3]; 2],
    spacing: [f64; 3],
    step: f64,
}

impl Sampler {
    fn new(volume: &Volume, per_voxel_samples: f64) -> Result<Self> {
        let grid = &volume.grid;
        ensure(
            volume.data.shape() == grid.shape,
            "projection",
            "volume.data",
            format!("{:?}", volume.data.shape()),
            format!("{:?}, the shape of its grid", grid.shape),
        )?;
        if let Some(((i, j, k), x)) = stray(&volume.data) {
            return Err(Error::invalid("projection", format!("volume[{i}, {j}, {k}]"), x, "a finite value"));
        }
        let [nx, ny, nz] = grid.shape;
        let padded = [nx + 2, ny + 2, nz + 2];
        let mut data = Vec::with_capacity(padded[0] * padded[1] * padded[2]);
        for i in 0..padded[0] {
            for j in 0..padded[1] {
                let row = |k: usize| volume.data[[i.clamp(1, nx) - 1, j.clamp(1, ny) - 1, k]];
                data.push(row(0));
                data.extend((0..nz).map(row));
                data.push(row(nz - 1));
            }
        }
        let blocks = padded.map(|n| n.div_ceil(BLOCK));
        let mut occupied = vec![false; blocks.iter().product()];
        let stride = [padded[1] * padded[2], padded[2]];
        for (at, _) in data.iter().enumerate().filter(|(_, x)| **x != 0.0) {
            // A voxel is a corner of the cells on both of its sides. One more cell on each side covers positions that
            // rounding moves across the boundary of a block.
            let voxel = [at / stride[0], at % stride[0] / stride[1], at % stride[1]];
            let low = voxel.map(|v| v.saturating_sub(2) / BLOCK);
            let high: [usize; 3] = std::array::from_fn(|k| ((voxel[k] + 1) / BLOCK).min(blocks[k] - 1));
            for i in low[0]..=high[0] {
                for j in low[1]..=high[1] {
                    for k in low[2]..=high[2] {
                        occupied[(i * blocks[1] + j) * blocks[2] + k] = true;
                    }
                }
            }
        }
        Ok(Self {
            data,
            stride,
            last: grid.shape.map(|n| n as f32),
            occupied,
            blocks: [blocks[1], blocks[2]],
            bounds: grid.bounds(),
            spacing: grid.spacing,
            step: grid.spacing.into_iter().fold(f64::INFINITY, f64::min) / per_voxel_samples,
        })
    }

    fn integral(&self, geometry: &Geometry, view: usize, row: usize, column: usize) -> f32 {
        let ray = geometry.ray(view, row, column);
        let Some([near, far]) = ray.clip(self.bounds) else { return 0.0 };
        let count = ((far - near) / self.step).ceil().max(1.0);
        let step = (far - near) / count;
        // In voxels of the padded volume: the first sample and the step to the next.
        let first = ray.at(near + 0.5 * step);
        let start: [f32; 3] = std::array::from_fn(|k| ((first[k] - self.bounds[0][k]) / self.spacing[k] + 0.5) as f32);
        let ahead: [f32; 3] = std::array::from_fn(|k| (ray.direction[k] * step / self.spacing[k]) as f32);
        (self.sum(start, ahead, count as usize) * step) as f32
    }

    /// Sum of `count` samples at `start + n·ahead`.
    fn sum(&self, start: [f32; 3], ahead: [f32; 3], count: usize) -> f64 {
        let slow = ahead.map(|a| if a == 0.0 { f32::INFINITY } else { 1.0 / a.abs() });
        let mut sum = 0.0;
        let mut n = 0;
        while n < count {
            // The block of sample `n`, and the number of samples before the ray leaves it.
            let mut block = [0usize; 3];
            let mut stay = f32::INFINITY;
            for k in 0..3 {
                let x = self.along(start, ahead, n, k);
                block[k] = x as usize / BLOCK;
                let wall = (block[k] + usize::from(ahead[k] > 0.0)) * BLOCK;
                stay = stay.min((wall as f32 - x).abs() * slow[k]);
            }
            let stay = (stay.ceil().max(1.0) as usize).min(count - n);
            if self.occupied[(block[0] * self.blocks[0] + block[1]) * self.blocks[1] + block[2]] {
                let mut part = 0.0;
                for n in n..n + stay {
                    part += self.sample(std::array::from_fn(|k| self.along(start, ahead, n, k)));
                }
                sum += f64::from(part);
            }
            n += stay;
        }
        sum
    }

    /// Coordinate of sample `n`, clamped to the padded volume.
    #[inline(always)]
    fn along(&self, start: [f32; 3], ahead: [f32; 3], n: usize, k: usize) -> f32 {
        (start[k] + n as f32 * ahead[k]).max(0.0).min(self.last[k] + 0.999)
    }

    /// The trilinear interpolation at a point of the padded volume.
    #[inline(always)]
    fn sample(&self, at: [f32; 3]) -> f32 {
        // Via i32: the conversion is a single instruction.
        let cell = at.map(|x| x as i32);
        let f: [f32; 3] = std::array::from_fn(|k| at[k] - cell[k] as f32);
        let at = cell[0] as usize * self.stride[0] + cell[1] as usize * self.stride[1] + cell[2] as usize;
        let along_z = |at: usize| match self.data.get(at..at + 2) {
            Some(&[a, b]) => a + f[2] * (b - a),
            _ => 0.0,
        };
        let along_y = |at: usize| {
            let (a, b) = (along_z(at), along_z(at + self.stride[1]));
            a + f[1] * (b - a)
        };
        let (a, b) = (along_y(at), along_y(at + self.stride[0]));
        a + f[0] * (b - a)
    }
}
