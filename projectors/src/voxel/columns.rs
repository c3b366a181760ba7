//! Joseph's projector for upright views, a detector column at a time.
//!
//! All rays of a column share their way in x and y; they differ in z alone, and z is linear in the row. In each plane of
//! voxels across the column's main direction the two lines of voxels beside the way are mixed into one, and that line
//! is read at equal distances, one a row. Both run along z, where voxels are neighbours in memory. The adjoint goes
//! the same way back: rows are gathered into a line with the same hat-shaped weights, and the line is shared out.

use super::layout::{AFTER, BEFORE, ColumnMajor, Upright, batch, column_major_bytes, main_axis};
use conefield_core::geometry::{Geometry, Vec3, VoxelGrid};
use conefield_core::scan::ScanHeader;
use conefield_core::simd::{Op, Real, Simd, SimdBase, SimdFloat, V, load, run, store};
use ndarray::{ArrayView3, ArrayViewMut2, ArrayViewMut3, Axis};
use rayon::prelude::*;
use std::ops::Range;

/// Columns that one task of [`forward`] projects.
const STRIP: usize = 32;
/// Planes that a strip goes through before it turns to the next: what they hold near the strip stays in cache.
const PLANES: usize = 16;
/// Planes that one task of [`adjoint`] owns.
const TILE: usize = 4;
/// Rows that share a voxel at most for [`gather`]; beyond that [`scatter`] is used.
const TAPS: usize = 8;

/// A view that this module projects: upright, and no ray so steep that z would be its main axis.
pub fn fits(geometry: &Geometry, view: usize) -> Option<Upright> {
    let upright = Upright::of(geometry, view)?;
    let [rows, columns] = geometry.detector;
    let spacing = geometry.volume.spacing;
    let highest = upright.first[2] + upright.v * (rows as f64 - 1.0);
    let steepest = upright.first[2].abs().max(highest.abs()) / spacing[2];
    let flat = (0..columns).all(|c| {
        let d = upright.lowest(c);
        steepest <= (d[0] / spacing[0]).abs().max((d[1] / spacing[1]).abs())
    });
    flat.then_some(upright)
}

/// The rays of one detector column.
struct Column {
    source: Vec3,
    /// From the source to the lowest pixel, in voxels.
    ahead: Vec3,
    /// From row to row, in voxels along z.
    v: f64,
    /// The axis, x or y, whose planes are visited; the other one is `1 - main`.
    main: usize,
    /// Square of the pixels' distance from the source within x and y, mm².
    flat: f64,
    /// mm along z from the source to the lowest row, and from row to row.
    rise: [f64; 2],
}

impl Column {
    fn new(view: &Upright, grid: &VoxelGrid, column: usize) -> Self {
        let d = view.lowest(column);
        let ahead: Vec3 = std::array::from_fn(|k| d[k] / grid.spacing[k]);
        Self {
            source: view.source,
            ahead,
            v: view.v / grid.spacing[2],
            main: main_axis([ahead[0], ahead[1], 0.0]),
            flat: d[0] * d[0] + d[1] * d[1],
            rise: [d[2], view.v],
        }
    }

    /// Length in mm of the ray of `row` (from below) between two planes.
    fn step(&self, row: usize) -> f64 {
        let z = self.rise[0] + row as f64 * self.rise[1];
        (self.flat + z * z).sqrt() / self.ahead[self.main].abs()
    }

    /// How the column's rows meet plane `plane`, of which the voxels `z` along z count, and the two lines of voxels
    /// beside the way with their shares; `None` where the column misses them.
    fn meet<R: Real>(
        &self,
        plane: usize,
        rows: usize,
        others: usize,
        z: &Range<usize>,
    ) -> Option<(Meeting<R>, Lines<R>)> {
        let t = (plane as f64 - self.source[self.main]) / self.ahead[self.main];
        if t <= 0.0 {
            return None;
        }
        let other = self.source[1 - self.main] + t * self.ahead[1 - self.main];
        if other <= -1.0 || other >= others as f64 {
            return None;
        }
        let below = other.floor();
        let share = other - below;
        // Neighbours outside count nothing; the one inside is then named twice.
        let low = if below < 0.0 { (0, 0.0) } else { (below as usize, 1.0 - share) };
        let up = below as isize + 1;
        let high = if up as usize >= others { (others - 1, 0.0) } else { (up as usize, share) };
        // Positions count from the zero below the first voxel of `z`.
        let lowest = self.source[2] + t * self.ahead[2] - z.start as f64 + 1.0;
        let step = t * self.v;
        let first = (-lowest / step).ceil().max(0.0);
        let last = ((z.len() as f64 + 1.0 - lowest) / step).floor().min(rows as f64 - 1.0);
        if last < first {
            return None;
        }
        let rows = Meeting {
            first: first as usize,
            count: (last - first) as usize + 1,
            start: R::of(lowest + first * step),
            step: R::of(step),
        };
        Some((rows, [(low.0, R::of(low.1)), (high.0, R::of(high.1))]))
    }
}

/// Two lines of voxels, counted across the main axis, with their shares.
type Lines<R> = [(usize, R); 2];

/// Where equally distant readers stand along a line of numbers that has a zero before its first.
pub(super) struct Meeting<R> {
    /// The first reader that stands within the line.
    pub first: usize,
    /// Readers from there on.
    pub count: usize,
    /// Where the first of them stands, counted from the zero.
    pub start: R,
    /// Distance of the readers.
    pub step: R,
}

/// For every line of voxels along z where it holds anything but zero.
fn occupied<R: Real>(volume: &[R], lines: usize, nz: usize) -> Vec<Range<usize>> {
    let mut all = vec![0..0; lines];
    all.par_iter_mut().zip(volume.par_chunks(nz)).for_each(|(range, line)| {
        if let Some(first) = line.iter().position(|x| *x != R::ZERO) {
            let last = line.iter().rposition(|x| *x != R::ZERO).unwrap_or(first);
            *range = first..last + 1;
        }
    });
    all
}

/// Line integrals of `volume` for views that [`fits`] took.
pub fn forward<R: Real>(
    geometry: &Geometry,
    views: &[Upright],
    volume: ArrayView3<'_, R>,
    projections: Vec<ArrayViewMut2<'_, R>>,
) {
    let volume = volume.as_standard_layout();
    let Some(voxels) = volume.as_slice() else { return };
    let [nx, ny, nz] = geometry.volume.shape;
    let occupied = occupied(voxels, nx * ny, nz);
    let rows = geometry.detector[0];
    projections.into_par_iter().zip(views).for_each(|(mut out, view)| {
        out.axis_chunks_iter_mut(Axis(1), STRIP).into_par_iter().enumerate().for_each(|(n, mut out)| {
            let columns: Vec<Column> =
                (0..out.shape()[1]).map(|c| Column::new(view, &geometry.volume, n * STRIP + c)).collect();
            let stride = rows + AFTER;
            let mut sums = vec![R::ZERO; columns.len() * stride];
            run(Forward {
                shape: geometry.volume.shape,
                voxels,
                occupied: &occupied,
                columns: &columns,
                rows,
                sums: &mut sums,
            });
            for row in 0..rows {
                let mut line = out.row_mut(view.row(row, rows));
                for ((out, c), sums) in line.iter_mut().zip(&columns).zip(sums.chunks(stride)) {
                    *out = sums[row] * R::of(c.step(row));
                }
            }
        });
    });
}

/// Sums of a strip of columns over all planes, without the length of a step.
struct Forward<'a, R> {
    shape: [usize; 3],
    voxels: &'a [R],
    occupied: &'a [Range<usize>],
    columns: &'a [Column],
    rows: usize,
    /// `[column][rows + AFTER]`.
    sums: &'a mut [R],
}

impl<R: Real> Op for Forward<'_, R> {
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let [_, ny, nz] = self.shape;
        let stride = self.rows + AFTER;
        let mut line = vec![R::ZERO; nz + 2 + AFTER];
        // Sums of a few planes, added up in turn: two short sums round less than one long one.
        let mut part = vec![R::ZERO; stride];
        for main in 0..2 {
            let at = |plane: usize, other: usize| if main == 0 { plane * ny + other } else { other * ny + plane };
            for from in (0..self.shape[main]).step_by(PLANES) {
                let planes = from..(from + PLANES).min(self.shape[main]);
                for (c, sums) in self.columns.iter().zip(self.sums.chunks_mut(stride)).filter(|(c, _)| c.main == main) {
                    let mut touched = 0..0;
                    for plane in planes.clone() {
                        let others = self.shape[1 - main];
                        let Some((_, lines)) = c.meet::<R>(plane, self.rows, others, &(0..nz)) else { continue };
                        let [a, b] = lines.map(|(other, _)| at(plane, other));
                        let z = union(&self.occupied[a], &self.occupied[b]);
                        if z.is_empty() {
                            continue;
                        }
                        let Some((m, _)) = c.meet::<R>(plane, self.rows, others, &z) else { continue };
                        let [a, b] = [a, b].map(|l| &self.voxels[l * nz..][z.clone()]);
                        mix(s, a, b, lines.map(|l| l.1), &mut line);
                        read(s, &line, &m, z.len(), &mut part[m.first..]);
                        touched = union(&touched, &(m.first..m.first + m.count));
                    }
                    for (sum, x) in sums[touched.clone()].iter_mut().zip(&mut part[touched]) {
                        *sum += std::mem::take(x);
                    }
                }
            }
        }
    }
}

fn union(a: &Range<usize>, b: &Range<usize>) -> Range<usize> {
    match (a.is_empty(), b.is_empty()) {
        (true, _) => b.clone(),
        (_, true) => a.clone(),
        _ => a.start.min(b.start)..a.end.max(b.end),
    }
}

/// `line[1..] = shares[0]·a + shares[1]·b`, with a zero before and two after it; what lies beyond is never selected.
#[inline(always)]
pub(super) fn mix<S: Simd, R: Real>(s: S, a: &[R], b: &[R], shares: [R; 2], line: &mut [R]) {
    let len = V::<S, R>::LEN;
    let [wa, wb] = shares.map(|w| V::<S, R>::splat(s, w));
    let mut i = 0;
    while i < a.len() {
        (load(s, a, i) * wa + load(s, b, i) * wb).store_slice(&mut line[1 + i..1 + i + len]);
        i += len;
    }
    line[1 + a.len()..3 + a.len()].fill(R::ZERO);
}

/// Adds what the readers `m` find in a line of `numbers` numbers to `sums`.
#[inline(always)]
pub(super) fn read<S: Simd, R: Real>(s: S, line: &[R], m: &Meeting<R>, numbers: usize, sums: &mut [R]) {
    let len = V::<S, R>::LEN;
    let lanes = V::<S, R>::from_fn(s, |i| R::of(i as f64));
    let (step, start) = (V::<S, R>::splat(s, m.step), V::<S, R>::splat(s, m.start));
    let (zero, end) = (V::<S, R>::splat(s, R::ZERO), V::<S, R>::splat(s, R::of(numbers as f64 + 1.0)));
    let mut i = 0;
    while i < m.count {
        let row = lanes + V::<S, R>::splat(s, R::of(i as f64));
        let z = row.mul_add(step, start).max(zero).min(end);
        let cell = z.floor();
        let [a, b] = R::neighbours::<S, 2>(s, line, cell);
        let sum = (z - cell).mul_add(b - a, a) + load(s, sums, i);
        store::<S, R>(sum, sums, i);
        i += len;
    }
}

/// Bytes that [`adjoint`] takes in single precision for `views` views; [`forward`] takes less.
pub fn scratch(header: &ScanHeader, views: usize) -> u64 {
    let views = views.min(batch::<f32>(header.detector));
    column_major_bytes::<f32>(header.detector, views) + (views * header.detector[1] * size_of::<Column>()) as u64
}

/// Adds the adjoint of [`forward`] to `volume`. `views` are the uprights of `indices`.
pub fn adjoint<R: Real>(
    geometry: &Geometry,
    views: &[Upright],
    indices: &[usize],
    projections: ArrayView3<'_, R>,
    volume: &mut ArrayViewMut3<'_, R>,
) {
    let size = batch::<R>(geometry.detector);
    for from in (0..views.len()).step_by(size) {
        let part = from..(from + size).min(views.len());
        let views = &views[part.clone()];
        let columns: Vec<Vec<Column>> = views
            .iter()
            .map(|v| (0..geometry.detector[1]).map(|c| Column::new(v, &geometry.volume, c)).collect())
            .collect();
        let rows = geometry.detector[0];
        let pixels = ColumnMajor::new(
            geometry,
            &indices[part.clone()],
            projections.slice_axis(Axis(0), part.into()),
            |n, row, column, x| x * R::of(columns[n][column].step(views[n].row(row, rows))),
        );
        for main in 0..2 {
            let mut order = [main, 1 - main, 2];
            if main == 0 {
                order = [0, 1, 2];
            }
            let mut turned = volume.view_mut().permuted_axes(order);
            turned.axis_chunks_iter_mut(Axis(0), TILE).into_par_iter().enumerate().for_each(|(n, planes)| {
                run(Adjoint { main, first: n * TILE, planes, columns: &columns, pixels: &pixels, rows });
            });
        }
    }
}

/// What some planes of voxels gather from all columns that cross them.
struct Adjoint<'a, R> {
    main: usize,
    /// The first plane.
    first: usize,
    /// `[plane, other, z]`.
    planes: ArrayViewMut3<'a, R>,
    columns: &'a [Vec<Column>],
    pixels: &'a ColumnMajor<R>,
    rows: usize,
}

impl<R: Real> Op for Adjoint<'_, R> {
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(mut self, s: S) {
        let (count, others, nz) = self.planes.dim();
        let mut line = vec![R::ZERO; nz + 2 + AFTER];
        for (view, columns) in self.columns.iter().enumerate() {
            for (c, column) in columns.iter().enumerate().filter(|(_, c)| c.main == self.main) {
                let pixels = self.pixels.column(view, c);
                for p in 0..count {
                    let found = column.meet::<R>(self.first + p, self.rows, others, &(0..nz));
                    let Some((m, lines)) = found else { continue };
                    let z = spread(s, pixels, &m, nz, &mut line);
                    let mut plane = self.planes.index_axis_mut(Axis(0), p);
                    for (other, share) in lines {
                        if share == R::ZERO {
                            continue;
                        }
                        if let Some(voxels) = plane.index_axis_mut(Axis(0), other).into_slice() {
                            add(s, &line[1..], share, &mut voxels[..z.end], z.start);
                        }
                    }
                }
            }
        }
    }
}

/// `voxels[from..] += share·line[from..]`.
#[inline(always)]
fn add<S: Simd, R: Real>(s: S, line: &[R], share: R, voxels: &mut [R], from: usize) {
    let share = V::<S, R>::splat(s, share);
    let mut i = from;
    while i < voxels.len() {
        let sum = V::<S, R>::from_slice(s, &line[i..i + V::<S, R>::LEN]).mul_add(share, load(s, voxels, i));
        store::<S, R>(sum, voxels, i);
        i += V::<S, R>::LEN;
    }
}

/// The adjoint of [`read`]: what each voxel of the line is given, in `line[1..]`, and which voxels those are.
#[inline(always)]
fn spread<S: Simd, R: Real>(s: S, pixels: &[R], m: &Meeting<R>, nz: usize, line: &mut [R]) -> Range<usize> {
    let start = m.start.f64();
    let end = start + (m.count - 1) as f64 * m.step.f64();
    // Voxel z stands at z + 1.
    let z = ((start - 1.0).ceil().max(1.0) as usize - 1)..((end + 1.0).floor().min(nz as f64) as usize);
    match (2.0 / m.step.f64()).ceil() as usize {
        0..=2 => gather::<S, R, 2>(s, pixels, m, &z, line),
        3 => gather::<S, R, 3>(s, pixels, m, &z, line),
        4 => gather::<S, R, 4>(s, pixels, m, &z, line),
        5..=6 => gather::<S, R, 6>(s, pixels, m, &z, line),
        7..=TAPS => gather::<S, R, TAPS>(s, pixels, m, &z, line),
        _ => scatter(pixels, m, line),
    }
    z
}

/// Every voxel sums over the rows that are less than a voxel away: at most `K` of them.
#[inline(always)]
fn gather<S: Simd, R: Real, const K: usize>(s: S, pixels: &[R], m: &Meeting<R>, z: &Range<usize>, line: &mut [R]) {
    let number = |x: f64| V::<S, R>::splat(s, R::of(x));
    let lanes = V::<S, R>::from_fn(s, |i| R::of(i as f64));
    let (step, start) = (V::<S, R>::splat(s, m.step), V::<S, R>::splat(s, m.start));
    let reach = number(1.0 / m.step.f64());
    let (zero, one) = (number(0.0), number(1.0));
    // Rows count from `first`; in `pixels` that one stands here. Past the last row are zeros.
    let offset = (BEFORE + m.first) as f64;
    let most = number((pixels.len() - AFTER) as f64);
    let mut i = z.start;
    while i < z.end {
        let place = lanes + number(i as f64 + 1.0);
        let at = (((place - start) * reach - reach).floor() + number(offset + 1.0)).max(zero).min(most);
        let mut row = at - number(offset);
        let mut sum = zero;
        for x in R::neighbours::<S, K>(s, pixels, at) {
            let weight = (one - (row.mul_add(step, start) - place).abs()).max(zero);
            sum = weight.mul_add(x, sum);
            row += one;
        }
        sum.store_slice(&mut line[1 + i..1 + i + V::<S, R>::LEN]);
        i += V::<S, R>::LEN;
    }
}

/// Every row gives to the two voxels beside it: for detectors with many rows a voxel.
#[inline(always)]
fn scatter<R: Real>(pixels: &[R], m: &Meeting<R>, line: &mut [R]) {
    line.fill(R::ZERO);
    for i in 0..m.count {
        let z = R::of(i as f64) * m.step + m.start;
        let cell = z.floor();
        let at = cell.int().max(0) as usize;
        let x = pixels[BEFORE + m.first + i];
        line[at] += (cell + R::ONE - z) * x;
        line[at + 1] += (z - cell) * x;
    }
}
