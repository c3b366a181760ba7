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
use conefield_core::simd::{Op, Simd, SimdBase, SimdFloat, SimdInt, WIDEST, f32x4, i32x4, load, pairs, run};
use ndarray::Array3;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Side of the blocks of cells that are skipped if empty.
const BLOCK: usize = 8;
/// Rows that one task processes together: neighbours along z read the same cache lines.
const BAND: usize = 16;
/// The numbers of lanes.
const LANES: [f32; WIDEST] = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0];

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
            run(Band { sampler: &sampler, geometry, view, first: band * BAND, pixels });
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
    /// Lines along z per plane across x.
    lines: i32,
    /// Largest coordinate of a sample along each axis.
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
            lines: padded[1] as i32,
            last: grid.shape.map(|n| n as f32 + 0.999),
            occupied,
            blocks: [blocks[1], blocks[2]],
            bounds: grid.bounds(),
            spacing: grid.spacing,
            step: grid.spacing.into_iter().fold(f64::INFINITY, f64::min) / per_voxel_samples,
        })
    }

    #[inline(always)]
    fn integral<S: Simd>(&self, s: S, geometry: &Geometry, [view, row, column]: [usize; 3]) -> f32 {
        let ray = geometry.ray(view, row, column);
        let Some([near, far]) = ray.clip(self.bounds) else { return 0.0 };
        let count = ((far - near) / self.step).ceil().max(1.0);
        let step = (far - near) / count;
        // In voxels of the padded volume: the first sample and the step to the next.
        let first = ray.at(near + 0.5 * step);
        let start: [f32; 3] = std::array::from_fn(|k| ((first[k] - self.bounds[0][k]) / self.spacing[k] + 0.5) as f32);
        let ahead: [f32; 3] = std::array::from_fn(|k| (ray.direction[k] * step / self.spacing[k]) as f32);
        (self.sum(s, start, ahead, count as usize) * step) as f32
    }

    /// Sum of `count` samples at `start + n·ahead`.
    #[inline(always)]
    fn sum<S: Simd>(&self, s: S, start: [f32; 3], ahead: [f32; 3], count: usize) -> f64 {
        // Along x, y, z, and once more along z.
        let four = |v: [f32; 3]| f32x4::from_slice(s, &[v[0], v[1], v[2], v[2]]);
        let slow = four(ahead.map(|a| if a == 0.0 { f32::INFINITY } else { 1.0 / a.abs() }));
        let upper = four(ahead.map(|a| if a > 0.0 { 1.0 } else { 0.0 }));
        let (first, apart, last) = (four(start), four(ahead), four(self.last));
        let mut sum = 0.0;
        let mut n = 0;
        while n < count {
            // The block of sample `n`, and the number of samples before the ray leaves it.
            let at = (first + apart * (n as i32 as f32)).max(f32x4::splat(s, 0.0)).min(last);
            let block = (at * (1.0 / BLOCK as f32)).floor();
            let walls = ((block + upper) * BLOCK as f32 - at).abs() * slow;
            let stay = walls.as_slice().iter().fold(f32::INFINITY, |a, &b| if b < a { b } else { a });
            let block = block.to_int::<i32x4<S>>();
            let [i, j, k, _] = *block.as_slice() else { unreachable!("four lanes") };
            let [i, j, k] = [i, j, k].map(|n| n as usize);
            let stay = (stay.ceil().max(1.0) as i32 as usize).min(count - n);
            if self.occupied[(i * self.blocks[0] + j) * self.blocks[1] + k] {
                let mut part = 0.0;
                for from in (0..stay).step_by(S::f32s::LEN) {
                    // One after another: the sum does not depend on the length of the vectors.
                    let samples = self.samples(s, start, ahead, n + from);
                    samples.as_slice().iter().take(stay - from).for_each(|x| part += x);
                }
                sum += f64::from(part);
            }
            n += stay;
        }
        sum
    }

    /// The trilinear interpolation at sample `n` and those after it, one per lane. Samples are clamped to the padded
    /// volume.
    #[inline(always)]
    fn samples<S: Simd>(&self, s: S, start: [f32; 3], ahead: [f32; 3], n: usize) -> S::f32s {
        let number = |x: f32| S::f32s::splat(s, x);
        let n = load::<S, f32>(s, &LANES, 0) + number(n as f32);
        let (mut cells, mut f) = ([S::i32s::splat(s, 0); 3], [number(0.0); 3]);
        for k in 0..3 {
            let at = (number(start[k]) + n * number(ahead[k])).max(number(0.0)).min(number(self.last[k]));
            cells[k] = at.to_int();
            f[k] = at - cells[k].to_float::<S::f32s>();
        }
        let [lines, z] = [cells[0] * self.lines + cells[1], cells[2]];
        let mut at = [0; WIDEST];
        for ((at, &line), &z) in at.iter_mut().zip(lines.as_slice()).zip(z.as_slice()) {
            *at = line as usize * self.stride[1] + z as usize;
        }
        // The interpolation along z, then y, then x.
        let mut on_x = [f[0]; 2];
        for (x, on_x) in on_x.iter_mut().enumerate() {
            let mut on_y = [f[0]; 2];
            for (y, on_y) in on_y.iter_mut().enumerate() {
                let [a, b] = pairs(s, &self.data[x * self.stride[0] + y * self.stride[1]..], &at);
                *on_y = a + f[2] * (b - a);
            }
            *on_x = on_y[0] + f[1] * (on_y[1] - on_y[0]);
        }
        on_x[0] + f[0] * (on_x[1] - on_x[0])
    }
}

/// The line integrals of some rows of a view.
struct Band<'a> {
    sampler: &'a Sampler,
    geometry: &'a Geometry,
    view: usize,
    /// Its first row.
    first: usize,
    pixels: &'a mut [f32],
}

impl Op for Band<'_> {
    type Number = f32;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let columns = self.geometry.detector[1];
        for column in 0..columns {
            for (r, row) in self.pixels.chunks_mut(columns).enumerate() {
                row[column] = self.sampler.integral(s, self.geometry, [self.view, self.first + r, column]);
            }
        }
    }
}
