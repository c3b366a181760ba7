//! The voxel-driven, distance-weighted back-projection of FDK (Feldkamp, Davis and Kress, JOSA A 1(6), 1984).
//!
//! Every voxel receives `Σ_i s_i/U_i²·p_i(u, v)`: `U_i` is its depth in view `i`, `p_i` is read by bilinear
//! interpolation where the ray through the voxel's centre meets the detector, and outside the detector nothing is
//! added. In an upright view all voxels of a line along z share column and depth, and rows are linear in z.

use super::columns::{Meeting, mix, read};
use super::layout::{AFTER, BEFORE, ColumnMajor, Pinhole, Upright};
use conefield_core::geometry::{Geometry, Vec3, VoxelGrid, dot, sub};
use conefield_core::simd::{Op, Real, Simd, run};
use ndarray::{ArrayViewMut3, Axis};
use rayon::prelude::*;

/// Planes of voxels that one task owns.
const TILE: usize = 4;

/// Adds the views `views` of `geometry`, whose pixels are `pixels` and whose scales `s_i` are `scales` in mm², to
/// `volume`.
pub fn backproject<R: Real>(
    geometry: &Geometry,
    views: &[usize],
    pixels: &ColumnMajor<R>,
    scales: &[f64],
    mut volume: ArrayViewMut3<'_, R>,
) {
    let all: Vec<(Pinhole, Option<Lines>)> =
        views.iter().map(|&v| (Pinhole::of(geometry, v), Lines::of(geometry, v))).collect();
    volume.axis_chunks_iter_mut(Axis(0), TILE).into_par_iter().enumerate().for_each(|(n, mut planes)| {
        for (i, (pinhole, lines)) in all.iter().enumerate() {
            let view = ViewPixels { geometry, pixels, index: i, scale: scales[i] };
            match lines {
                Some(lines) => run(ByLine { view, lines, first: n * TILE, planes: planes.view_mut() }),
                None => view.by_voxel(pinhole, n * TILE, planes.view_mut()),
            }
        }
    });
}

struct ViewPixels<'a, R> {
    geometry: &'a Geometry,
    pixels: &'a ColumnMajor<R>,
    index: usize,
    scale: f64,
}

/// Column, depth and rows of the voxel lines along z in an upright view: numerators linear in x and y.
struct Lines {
    /// `depth = d[0] + d[1]·x + d[2]·y`, in mm for x and y in voxels.
    depth: Vec3,
    /// The column times depth, likewise.
    column: Vec3,
    /// Source to detector, mm.
    distance: f64,
    /// From the source to the lowest voxel's centre and from voxel to voxel, mm.
    rise: [f64; 2],
    /// From the source to the lowest row and from row to row, mm.
    rows: [f64; 2],
}

impl Lines {
    fn of(geometry: &Geometry, view: usize) -> Option<Self> {
        let upright = Upright::of(geometry, view)?;
        let w = &geometry.views[view];
        let grid: &VoxelGrid = &geometry.volume;
        let (normal, distance) = w.normal();
        let corner = sub(grid.voxel([0; 3]), w.source);
        let linear = |axis: Vec3| [dot(axis, corner), axis[0] * grid.spacing[0], axis[1] * grid.spacing[1]];
        let depth = linear(normal);
        // The column is (hit − first)·u/|u|², where hit = d·distance/depth.
        let square = dot(w.u, w.u);
        let along = linear(w.u.map(|x| x * distance / square));
        let offset = dot(upright.first, w.u) / square;
        Some(Self {
            depth,
            column: std::array::from_fn(|k| along[k] - offset * depth[k]),
            distance,
            rise: [corner[2], grid.spacing[2]],
            rows: [upright.first[2], upright.v],
        })
    }
}

struct ByLine<'a, R> {
    view: ViewPixels<'a, R>,
    lines: &'a Lines,
    first: usize,
    planes: ArrayViewMut3<'a, R>,
}

impl<R: Real> Op for ByLine<'_, R> {
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(mut self, s: S) {
        let (count, ny, nz) = self.planes.dim();
        let [rows, columns] = self.view.geometry.detector;
        let mut line = vec![R::ZERO; rows + 2 + AFTER];
        let l = self.lines;
        for y in 0..ny {
            for x in 0..count {
                let at = |n: &Vec3| n[0] + n[1] * (self.first + x) as f64 + n[2] * y as f64;
                let depth = at(&l.depth);
                if depth <= 0.0 {
                    continue;
                }
                let column = at(&l.column) / depth;
                if column <= -1.0 || column >= columns as f64 {
                    continue;
                }
                let left = column.floor();
                let share = column - left;
                let weight = self.view.scale / (depth * depth);
                let low = if left < 0.0 { (0, 0.0) } else { (left as usize, (1.0 - share) * weight) };
                let up = (left + 1.0) as usize;
                let high = if up >= columns { (columns - 1, 0.0) } else { (up, share * weight) };
                // Rows of the lowest voxel and from voxel to voxel.
                let magnified = l.distance / depth;
                let step = l.rise[1] * magnified / l.rows[1];
                let lowest = (l.rise[0] * magnified - l.rows[0]) / l.rows[1];
                let first = ((-1.0 - lowest) / step).ceil().max(0.0);
                let last = ((rows as f64 - lowest) / step).floor().min(nz as f64 - 1.0);
                if last < first {
                    continue;
                }
                // The rows that are read, and one more for rounding.
                let from = (lowest + first * step).floor().max(0.0) as usize;
                let to = ((lowest + last * step).floor() as usize + 3).min(rows);
                let [a, b] = [low.0, high.0].map(|c| &self.view.pixels.column(self.view.index, c)[BEFORE..][from..to]);
                mix(s, a, b, [R::of(low.1), R::of(high.1)], &mut line);
                let (first, last) = (first as usize, last as usize);
                let start = R::of(lowest + first as f64 * step - from as f64 + 1.0);
                let m = Meeting { first, count: last - first + 1, start, step: R::of(step) };
                let mut plane = self.planes.index_axis_mut(Axis(0), x);
                if let Some(voxels) = plane.index_axis_mut(Axis(0), y).into_slice() {
                    read(s, &line, &m, to - from, &mut voxels[first..=last]);
                }
            }
        }
    }
}

impl<R: Real> ViewPixels<'_, R> {
    /// Voxel by voxel, for tilted views.
    fn by_voxel(&self, pinhole: &Pinhole, first: usize, mut planes: ArrayViewMut3<'_, R>) {
        let [rows, columns] = self.geometry.detector;
        for ((x, y, z), voxel) in planes.indexed_iter_mut() {
            let ([row, column], depth) = pinhole.project(self.geometry.volume.voxel([first + x, y, z]));
            if depth > 0.0 && row > -1.0 && column > -1.0 && row < rows as f64 && column < columns as f64 {
                *voxel += R::of(self.scale / (depth * depth) * self.bilinear(row, column));
            }
        }
    }

    /// The pixels around a place on the detector; those outside are 0.
    fn bilinear(&self, row: f64, column: f64) -> f64 {
        let (r, c) = (row.floor(), column.floor());
        let (fr, fc) = (row - r, column - c);
        let pixel = |dr: f64, dc: f64| self.pixels.pixel(self.index, (r + dr) as isize, (c + dc) as isize).f64();
        (1.0 - fr) * ((1.0 - fc) * pixel(0.0, 0.0) + fc * pixel(0.0, 1.0))
            + fr * ((1.0 - fc) * pixel(1.0, 0.0) + fc * pixel(1.0, 1.0))
    }
}
