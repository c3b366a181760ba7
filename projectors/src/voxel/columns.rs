//! Joseph's projector, one detector column at a time.
//!
//! The rays of a detector column lie in a plane and meet a plane of voxels on a straight line (formula in `readers`).
//! If columns run along z, or nearly so as in calibrated scans, they read lines of voxels upwards along z, one vector
//! of rows at a time. The adjoint goes the same way back: every voxel of a line gathers from the rows that are less
//! than a voxel away, with the same hat-shaped weights.

use super::layout::{ColumnMajor, batch, column_major_bytes, main_axis, to_voxels};
use super::readers::{Among, Ends, PAD, Path, Stands, mix, places, read, read_on};
use conefield_core::geometry::{Geometry, Vec3, dot, sub};
use conefield_core::parallel;
use conefield_core::scan::ScanHeader;
use conefield_core::simd::{Op, Real, Simd, SimdBase, SimdFloat, V, WIDEST, run};
use ndarray::{ArrayView3, ArrayViewMut2, ArrayViewMut3, Axis};
use std::ops::Range;

/// Columns per task of [`forward`].
const STRIP: usize = 32;
/// Planes that a strip traverses at once: their part near the strip stays in cache.
const PLANES: usize = 8;
/// Planes per task of [`adjoint`].
const TILE: usize = 4;
/// Most rows per voxel for [`Adjoint::gather`]; with more, [`Adjoint::scatter`] is used.
const TAPS: usize = 8;
/// With fewer rows, vectors of rows stay nearly empty.
const FEWEST: usize = 5;
/// Largest slant of a column: change in lines per rise along z.
const SLANT: f64 = 0.5;

/// Rays of a detector column with the same main axis, x or y, and the same direction along it.
#[derive(Debug, Clone)]
pub struct Column {
    /// Its index on the detector.
    number: usize,
    /// Its rows, counted from below.
    rows: Range<usize>,
    /// The axis whose planes are visited; the other one is `1 - main`.
    main: usize,
    /// The source in voxels.
    source: Vec3,
    /// The row from which q is measured, and the bend of q: see [`places`].
    middle: f64,
    bend: f64,
    /// The ray of that row: its step per plane along the other axis and z, in voxels.
    slope: [f64; 2],
    /// Change of the slope with q.
    drift: [f64; 2],
    /// Whether planes are traversed upwards.
    up: bool,
    /// Square of the distance from source to pixel in mm², divided by that in planes squared: a polynomial in ρ.
    length: [f64; 3],
}

/// The columns of a view, if this module can project it: it has some rows, no ray has z as its main axis, and columns run
/// along z rather than across.
pub fn of(geometry: &Geometry, view: usize) -> Option<Vec<Column>> {
    let (w, grid) = (&geometry.views[view], &geometry.volume);
    let [rows, columns] = geometry.detector;
    if rows < FEWEST {
        return None;
    }
    let downwards = w.v[2] < 0.0;
    let v = if downwards { w.v.map(|x| -x) } else { w.v };
    let lowest = if downwards { rows as f64 - 1.0 } else { 0.0 };
    let voxels = |d: Vec3| -> Vec3 { std::array::from_fn(|k| d[k] / grid.spacing[k]) };
    let source = to_voxels(grid, w.source);
    let mut all = Vec::with_capacity(columns);
    for number in 0..columns {
        let first = sub(w.pixel(geometry.detector, lowest, number as f64), w.source);
        let ray = |row: usize| -> Vec3 { std::array::from_fn(|k| first[k] + row as f64 * v[k]) };
        let heading = |row: usize| {
            let ahead = voxels(ray(row));
            let main = main_axis(ahead);
            (main, ahead[main] > 0.0)
        };
        for (rows, (main, up)) in runs(rows, &heading) {
            if main == 2 {
                return None;
            }
            let middle = (rows.start + rows.end) / 2;
            let d = ray(middle);
            let (ahead, step) = (voxels(d), voxels(v));
            let a = ahead[main];
            let across = [1 - main, 2];
            let drift = across.map(|k| (step[k] * a - step[main] * ahead[k]) / (a * a));
            // If planes are traversed downwards, z decreases with the row relative to the direction of the planes.
            let rise = if up { drift[1] } else { -drift[1] };
            if rise <= 0.0 || drift[0].abs() > SLANT * rise {
                return None;
            }
            all.push(Column {
                number,
                rows,
                main,
                source,
                middle: middle as f64,
                bend: step[main] / a,
                slope: across.map(|k| ahead[k] / a),
                drift,
                up,
                length: [dot(d, d), 2.0 * dot(d, v), dot(v, v)].map(|x| x / (a * a)),
            });
        }
    }
    Some(all)
}

/// Runs of rows with the same heading. Rays of one heading form a convex cone, so a range with equal ends has it
/// throughout.
fn runs<H: PartialEq + Copy>(rows: usize, heading: &impl Fn(usize) -> H) -> Vec<(Range<usize>, H)> {
    fn split<H: PartialEq + Copy>(
        (low, high): (usize, usize),
        ends: [H; 2],
        heading: &impl Fn(usize) -> H,
        all: &mut Vec<(Range<usize>, H)>,
    ) {
        if ends[0] == ends[1] || high - low == 1 {
            // The last row belongs to the next run.
            match all.last_mut() {
                Some((range, h)) if *h == ends[0] => range.end = high,
                _ => all.push((low..high, ends[0])),
            }
            return;
        }
        let middle = (low + high) / 2;
        let h = heading(middle);
        split((low, middle), [ends[0], h], heading, all);
        split((middle, high), [h, ends[1]], heading, all);
    }
    let Some(last) = rows.checked_sub(1) else { return vec![] };
    let ends = [heading(0), heading(last)];
    let mut all = vec![];
    if last > 0 {
        split((0, last), ends, heading, &mut all);
    }
    match all.last_mut() {
        Some((range, h)) if *h == ends[1] => range.end = rows,
        _ => all.push((last..rows, ends[1])),
    }
    all
}

impl Column {
    /// Where its rays meet plane `plane`, if the plane is in front of the source.
    fn meet(&self, plane: usize) -> Option<Path<f64>> {
        let away = plane as f64 - self.source[self.main];
        if away == 0.0 || (away > 0.0) != self.up {
            return None;
        }
        let of = |k: usize, axis: usize| [self.source[axis] + away * self.slope[k], away * self.drift[k]];
        Some(Path { across: of(0, 1 - self.main), along: of(1, 2) })
    }

    /// Whether it runs along z, with equal spacing in every plane.
    fn is_upright(&self) -> bool {
        self.bend == 0.0 && self.drift[0] == 0.0
    }

    /// `q` of the first and the last of `rows`.
    fn ends(&self, rows: Range<usize>) -> [f64; 2] {
        [rows.start, rows.end - 1].map(|row| {
            let r = row as f64 - self.middle;
            r / (1.0 + self.bend * r)
        })
    }

    /// `q` of the rows from `from` on, which may be negative.
    #[inline(always)]
    fn places<S: Simd, R: Real>(&self, s: S, from: f64, q: &mut [R]) {
        let valid = [self.rows.start as f64, self.rows.end as f64 - 1.0];
        places(s, from, [self.middle, self.bend], valid, q);
    }

    /// Multiplies one number per row by the length in mm of that row's ray between two planes.
    #[inline(always)]
    fn lengthen<R: Real>(&self, numbers: &mut [R]) {
        let [a, b, c] = self.length;
        for (i, x) in numbers.iter_mut().enumerate() {
            let r = (self.rows.start + i) as f64 - self.middle;
            *x *= R::of((a + r * (b + r * c)).sqrt() / (1.0 + self.bend * r));
        }
    }
}

/// The range of nonzero values of a line.
fn occupied<R: Real>(line: &[R]) -> Range<usize> {
    let Some(first) = line.iter().position(|x| *x != R::ZERO) else { return 0..0 };
    first..line.iter().rposition(|x| *x != R::ZERO).unwrap_or(first) + 1
}

fn union(a: &Range<usize>, b: &Range<usize>) -> Range<usize> {
    match (a.is_empty(), b.is_empty()) {
        (true, _) => b.clone(),
        (_, true) => a.clone(),
        _ => a.start.min(b.start)..a.end.max(b.end),
    }
}

/// Line integrals of `volume` for views whose columns [`of`] returned.
pub fn forward<R: Real>(
    geometry: &Geometry,
    views: &[(usize, Vec<Column>)],
    volume: ArrayView3<'_, R>,
    projections: Vec<ArrayViewMut2<'_, R>>,
) {
    let volume = volume.as_standard_layout();
    let Some(voxels) = volume.as_slice() else { return };
    let shape = geometry.volume.shape;
    let [nx, ny, nz] = shape;
    let mut lines = vec![0..0; nx * ny];
    parallel::over(lines.chunks_mut(ny).zip(voxels.chunks(ny * nz)), |_, (ranges, lines)| {
        ranges.iter_mut().zip(lines.chunks(nz)).for_each(|(range, line)| *range = occupied(line));
    });
    let rows = geometry.detector[0];
    parallel::over(projections.into_iter().zip(views), |_, (mut out, (view, columns))| {
        let downwards = geometry.views[*view].v[2] < 0.0;
        parallel::over(out.axis_chunks_iter_mut(Axis(1), STRIP), |n, mut out| {
            let first = n * STRIP;
            let at = |number: usize| columns.partition_point(|c| c.number < number);
            let columns = &columns[at(first)..at(first + STRIP)];
            // The stride is not a power of two: otherwise rows of many columns would share few cache sets.
            let apart = rows.next_multiple_of(WIDEST) + WIDEST;
            let mut sums = vec![R::ZERO; out.ncols() * apart];
            run(ColumnsForward { shape, voxels, occupied: &lines, columns, first, apart, sums: &mut sums });
            for row in 0..rows {
                let mut line = out.row_mut(if downwards { rows - 1 - row } else { row });
                line.iter_mut().zip(sums.chunks(apart)).for_each(|(out, sums)| *out = sums[row]);
            }
        });
    });
}

/// Line integrals of a strip of columns.
struct ColumnsForward<'a, R> {
    shape: [usize; 3],
    voxels: &'a [R],
    occupied: &'a [Range<usize>],
    columns: &'a [Column],
    /// The first column.
    first: usize,
    /// Stride between the columns of `sums`.
    apart: usize,
    /// `[column][rows]`, from below.
    sums: &'a mut [R],
}

/// The lines of a plane of voxels that a strip may read, in a [`ColumnsForward`]'s buffer.
struct Plane<R> {
    number: usize,
    /// Position of line −1 in the buffer.
    start: isize,
    among: Among<R>,
}

impl<R> Plane<R> {
    /// Line `l`, counted from line −1.
    #[inline(always)]
    fn line<'a>(&self, shelf: &'a [R], l: usize, stride: usize) -> &'a [R] {
        &shelf[(self.start + (l * stride) as isize) as usize..][..stride]
    }
}

impl<R: Real> Op for ColumnsForward<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let len = V::<S, R>::LEN;
        let stride = stride(self.shape[2]);
        let vectors = self.apart / len;
        let readers: Vec<(Vec<R>, Ends<R>)> = self.columns.iter().map(|c| self.readers(s, c)).collect();
        let mut shelf = vec![];
        let mut mixed = vec![R::ZERO; PLANES * stride];
        let mut stands: [_; PLANES] = std::array::from_fn(|_| Stands::new(vectors));
        let mut parts = vec![R::ZERO; vectors * len];
        for main in 0..2 {
            for from in (0..self.shape[main]).step_by(PLANES) {
                let planes = self.planes(main, from..(from + PLANES).min(self.shape[main]), &mut shelf);
                if planes.is_empty() {
                    continue;
                }
                for (c, (q, ends)) in self.columns.iter().zip(&readers).filter(|(c, _)| c.main == main) {
                    // All rows of an upright column lie between the same two lines, which are interpolated once.
                    let upright = c.is_upright();
                    let mut met: [Option<(Path<R>, &Plane<R>)>; PLANES] = [const { None }; PLANES];
                    let mut count = 0;
                    for plane in &planes {
                        let Some(path) = c.meet(plane.number).map(|path| path.narrow::<R>()) else { continue };
                        if upright {
                            let y = path.across[0];
                            if y <= R::of(-1.0) || y >= plane.among.lines {
                                continue;
                            }
                            let low = y.floor();
                            let first = (low + R::ONE).count() as usize;
                            let [a, b] = [first, first + 1].map(|l| &plane.line(&shelf, l, stride)[PAD..]);
                            mix(s, a, b, y - low, &mut mixed[count * stride..][PAD..stride - PAD]);
                            stands[count].place_along(&path, &plane.among, ends, len);
                        } else {
                            stands[count].place(&path, &plane.among, ends, len);
                        }
                        met[count] = Some((path, plane));
                        count += 1;
                    }
                    // Partial sums over a few planes: two short sums have a smaller rounding error than one long sum.
                    for (i, (q, sums)) in q.chunks_exact(len).zip(parts.chunks_exact_mut(len)).enumerate() {
                        let q = V::<S, R>::from_slice(s, q);
                        let mut part = V::<S, R>::splat(s, R::ZERO);
                        for ((met, stands), mixed) in met.iter().zip(&stands).zip(mixed.chunks(stride)) {
                            let Some((path, plane)) = met else { break };
                            let found = if upright {
                                read_on(s, path, &plane.among, stands, i, q, mixed)
                            } else {
                                read(s, path, &plane.among, stands, i, q, |l| plane.line(&shelf, l, stride))
                            };
                            if let Some(found) = found {
                                part += found;
                            }
                        }
                        part.store_slice(sums);
                    }
                    let sums = &mut self.sums[(c.number - self.first) * self.apart..][c.rows.clone()];
                    sums.iter_mut().zip(&parts).for_each(|(sum, part)| *sum += *part);
                }
            }
        }
        for c in self.columns {
            c.lengthen(&mut self.sums[(c.number - self.first) * self.apart..][c.rows.clone()]);
        }
    }
}

/// Length of a padded line of `nz` numbers: whole vectors.
fn stride(nz: usize) -> usize {
    nz.next_multiple_of(WIDEST) + 2 * PAD
}

impl<R: Real> ColumnsForward<'_, R> {
    /// q of the rows of a column, and of the ends of its vectors.
    #[inline(always)]
    fn readers<S: Simd>(&self, s: S, c: &Column) -> (Vec<R>, Ends<R>) {
        let len = V::<S, R>::LEN;
        let mut q = vec![R::ZERO; c.rows.len().next_multiple_of(len)];
        c.places(s, c.rows.start as f64, &mut q);
        let mut ends = Ends::default();
        ends.find(&q, len);
        (q, ends)
    }

    /// Copies the lines of the planes `planes` that the strip may read into a contiguous, zero-padded buffer: in place
    /// they would share few cache sets. Skips empty planes.
    fn planes(&self, main: usize, planes: Range<usize>, shelf: &mut Vec<R>) -> Vec<Plane<R>> {
        let [_, ny, nz] = self.shape;
        let (others, stride) = (self.shape[1 - main] as f64, stride(nz));
        shelf.clear();
        let mut all = vec![];
        for number in planes {
            let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
            for c in self.columns.iter().filter(|c| c.main == main) {
                let Some(path) = c.meet(number) else { continue };
                for at in c.ends(c.rows.clone()).map(|q| path.across(q)) {
                    (low, high) = (low.min(at), high.max(at));
                }
            }
            // One more line on either side, for rounding.
            let (low, high) = ((low - 1.0).floor().max(-1.0), (high + 2.0).floor().min(others));
            if low > high {
                continue;
            }
            let (low, high) = (low as isize, high as isize);
            let at = |other: isize| {
                let other = other as usize;
                if main == 0 { number * ny + other } else { other * ny + number }
            };
            let inside = low.max(0)..(high + 1).min(others as isize);
            let z = inside.clone().fold(0..0, |z, other| union(&z, &self.occupied[at(other)]));
            if z.is_empty() {
                continue;
            }
            let start = shelf.len() as isize - (low + 1) * stride as isize;
            for other in low..=high {
                let begin = shelf.len();
                shelf.resize(begin + stride, R::ZERO);
                if inside.contains(&other) {
                    let line = &self.voxels[at(other) * nz..][z.clone()];
                    shelf[begin + PAD + z.start..][..z.len()].copy_from_slice(line);
                }
            }
            let span = [R::of(z.start as f64 - 1.0), R::of(z.end as f64)];
            let among = Among { lines: R::of(others), numbers: R::of(nz as f64), span };
            all.push(Plane { number, start, among });
        }
        all
    }
}

/// Bytes that [`adjoint`] needs in single precision for `views` views; [`forward`] needs less.
pub fn scratch(header: &ScanHeader, views: usize) -> u64 {
    let [nx, ny, nz] = header.volume;
    let [rows, columns] = header.detector;
    let at_once = views.min(batch::<f32>(header.detector));
    let tile = TILE * (nx.max(ny) + 2) * (nz + 2 * PAD) + 3 * (rows + 2 * PAD);
    let tiles = rayon::current_num_threads().min(nx.max(ny).div_ceil(TILE)) * tile * size_of::<f32>();
    column_major_bytes::<f32>(header.detector, at_once)
        + (views * columns * (size_of::<Column>() + size_of::<Range<usize>>()) + tiles) as u64
}

/// Adds the adjoint of [`forward`] to `volume`. `projections` has one image per view of `views`.
pub fn adjoint<R: Real>(
    geometry: &Geometry,
    views: &[(usize, &[Column])],
    projections: ArrayView3<'_, R>,
    volume: &mut ArrayViewMut3<'_, R>,
) {
    let size = batch::<R>(geometry.detector);
    for from in (0..views.len()).step_by(size) {
        let part = from..(from + size).min(views.len());
        let views = &views[part.clone()];
        let numbers: Vec<usize> = views.iter().map(|v| v.0).collect();
        let images = projections.slice_axis(Axis(0), part.into());
        let mut pixels = ColumnMajor::new(geometry, &numbers, images);
        // The nonzero rows of each column: zeros, as the residual of air in an empty volume, are not gathered.
        let of_view = |_, (view, (_, columns)): (&mut [R], &(usize, &[Column]))| -> Vec<Range<usize>> {
            let rows = |c: &Column| {
                let start = c.number * (geometry.detector[0] + 2 * PAD) + PAD;
                let pixels = &mut view[start + c.rows.start..start + c.rows.end];
                run(Lengthen(c, pixels));
                let found = occupied(pixels);
                c.rows.start + found.start..c.rows.start + found.end
            };
            columns.iter().map(rows).collect()
        };
        let occupied = parallel::map(pixels.views_mut().zip(views), of_view);
        for main in 0..2 {
            let mut turned = volume.view_mut().permuted_axes([main, 1 - main, 2]);
            parallel::over(turned.axis_chunks_iter_mut(Axis(0), TILE), |n, mut planes| {
                let (count, lines, nz) = planes.dim();
                let stride = nz + 2 * PAD;
                let mut gathered = vec![R::ZERO; count * (lines + 2) * stride];
                let first = n * TILE;
                let (occupied, pixels) = (&occupied, &pixels);
                run(Adjoint { main, first, lines, nz, gathered: &mut gathered, views, occupied, pixels });
                for (mut plane, found) in planes.outer_iter_mut().zip(gathered.chunks((lines + 2) * stride)) {
                    for (mut line, found) in plane.outer_iter_mut().zip(found.chunks(stride).skip(1)) {
                        let found = &found[PAD..];
                        match line.as_slice_mut() {
                            Some(line) => line.iter_mut().zip(found).for_each(|(voxel, x)| *voxel += *x),
                            None => line.iter_mut().zip(found).for_each(|(voxel, x)| *voxel += *x),
                        }
                    }
                }
            });
        }
    }
}

struct Lengthen<'a, R>(&'a Column, &'a mut [R]);

impl<R: Real> Op for Lengthen<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, _: S) {
        self.0.lengthen(self.1);
    }
}

/// Planes of voxels that gather from all columns crossing them.
struct Adjoint<'a, R> {
    main: usize,
    /// The first plane.
    first: usize,
    /// Lines per plane and numbers per line.
    lines: usize,
    nz: usize,
    /// `[plane][1 + lines + 1][PAD + nz + PAD]`: the lines before the first and after the last are ignored.
    gathered: &'a mut [R],
    views: &'a [(usize, &'a [Column])],
    /// The nonzero rows of each column.
    occupied: &'a [Vec<Range<usize>>],
    pixels: &'a ColumnMajor<R>,
}

impl<R: Real> Op for Adjoint<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let (stride, lines) = (self.nz + 2 * PAD, self.lines + 2);
        let count = self.gathered.len() / (lines * stride);
        let (mut alone, mut q) = (vec![], vec![]);
        let mut windows = Windows::default();
        for (view, ((_, columns), occupied)) in self.views.iter().zip(self.occupied).enumerate() {
            for (c, occupied) in columns.iter().zip(occupied).filter(|(c, _)| c.main == self.main) {
                if occupied.is_empty() {
                    continue;
                }
                let mut pixels = self.pixels.column(view, c.number);
                let rows = pixels.len() - 2 * PAD;
                if c.rows != (0..rows) {
                    // The other columns have another main axis.
                    alone.clear();
                    alone.resize(pixels.len(), R::ZERO);
                    let own = PAD + c.rows.start..PAD + c.rows.end;
                    alone[own.clone()].copy_from_slice(&pixels[own]);
                    pixels = &alone;
                }
                let ends = c.ends(occupied.clone());
                let mut placed = false;
                for p in 0..count {
                    let Some(path) = c.meet(self.first + p) else { continue };
                    let Some(hit) = Hit::of(c, ends, path, self.lines, self.nz) else { continue };
                    if !placed && !c.is_upright() {
                        q.resize(pixels.len(), R::ZERO);
                        c.places(s, -(PAD as f64), &mut q);
                        placed = true;
                    }
                    let plane = &mut self.gathered[p * lines * stride..(p + 1) * lines * stride];
                    let from = [pixels, &q];
                    if hit.taps > TAPS {
                        q.resize(pixels.len(), R::ZERO);
                        c.places(s, -(PAD as f64), &mut q);
                        hit.scatter([pixels, &q], plane, stride);
                        continue;
                    }
                    // Double precision checks the arithmetic: compiled once, for the largest number of rows.
                    if const { size_of::<R>() == size_of::<f64>() } {
                        if c.is_upright() {
                            hit.gather_upright::<S, R, TAPS>(s, pixels, plane, stride, &mut windows);
                        } else {
                            hit.gather::<S, R, TAPS>(s, from, plane, stride, &mut windows);
                        }
                        continue;
                    }
                    match (hit.taps, c.is_upright()) {
                        (0..=2, true) => hit.gather_upright::<S, R, 2>(s, pixels, plane, stride, &mut windows),
                        (3, true) => hit.gather_upright::<S, R, 3>(s, pixels, plane, stride, &mut windows),
                        (4, true) => hit.gather_upright::<S, R, 4>(s, pixels, plane, stride, &mut windows),
                        (5..=6, true) => hit.gather_upright::<S, R, 6>(s, pixels, plane, stride, &mut windows),
                        (_, true) => hit.gather_upright::<S, R, TAPS>(s, pixels, plane, stride, &mut windows),
                        (0..=2, _) => hit.gather::<S, R, 2>(s, from, plane, stride, &mut windows),
                        (3, _) => hit.gather::<S, R, 3>(s, from, plane, stride, &mut windows),
                        (4, _) => hit.gather::<S, R, 4>(s, from, plane, stride, &mut windows),
                        (5..=6, _) => hit.gather::<S, R, 6>(s, from, plane, stride, &mut windows),
                        _ => hit.gather::<S, R, TAPS>(s, from, plane, stride, &mut windows),
                    }
                }
            }
        }
    }
}

/// The rows and lines from which vectors of voxels on one line gather: common to all voxels of a vector, and computed
/// for many vectors at a time.
#[derive(Default)]
struct Windows<R> {
    /// The first row that may contribute to a voxel of the vector, in a zero-padded column.
    first: Vec<u32>,
    /// Distance from there to the first voxel's first such row, in rows, plus one row: the start value of the lanes.
    from: Vec<R>,
    /// Rows per voxel.
    apart: Vec<R>,
    /// Distance of the first voxel from q = 0, in voxels; for an upright column, that row's distance from the voxel.
    off: Vec<R>,
    /// The first line, counted from line −1, and one after the last; or [`Windows::NONE`], or [`Windows::PAIR`].
    low: Vec<u32>,
    until: Vec<u32>,
    /// Distance of the first voxel's position from the first line, in lines.
    across: Vec<R>,
}

impl<R: Real> Windows<R> {
    /// No lines. Otherwise `until` is at least 2.
    const NONE: u32 = 1;
    /// The same two lines for all voxels.
    const PAIR: u32 = 0;

    /// Resizes to `n` vectors.
    #[inline(always)]
    fn resize(&mut self, n: usize) {
        for numbers in [&mut self.first, &mut self.low, &mut self.until] {
            numbers.resize(n, 0);
        }
        for numbers in [&mut self.from, &mut self.apart, &mut self.off, &mut self.across] {
            numbers.resize(n, R::ZERO);
        }
    }
}

/// The intersection of a column with a plane of voxels.
struct Hit<'a> {
    column: &'a Column,
    path: Path<f64>,
    /// Lines per plane.
    lines: f64,
    numbers: usize,
    /// Voxels along z that its rows affect.
    z: Range<usize>,
    /// q per voxel along z.
    per_z: f64,
    /// Largest distance, in rows, of a row that contributes to a voxel.
    reach: f64,
    /// Most rows that contribute to a voxel.
    taps: usize,
}

impl<'a> Hit<'a> {
    fn of(column: &'a Column, ends: [f64; 2], path: Path<f64>, lines: usize, numbers: usize) -> Option<Self> {
        let lines = lines as f64;
        let [a, b] = ends.map(|q| path.across(q));
        let [low, high] = ends.map(|q| path.along(q));
        if a.max(b) <= -1.0 || a.min(b) >= lines || high <= -1.0 || low >= numbers as f64 {
            return None;
        }
        let z = (low - 1.0).ceil().max(0.0) as usize..((high + 1.0).floor().min(numbers as f64 - 1.0) as usize + 1);
        // Rows are closest where q rises least. Within a vector they are treated as equally spaced; the error is at
        // most `bow`.
        let half = 0.5 * column.rows.len() as f64 + 1.0;
        let per_z = 1.0 / path.along[1];
        let reach = (1.0 + column.bend.abs() * half).powi(2) * per_z;
        let bow = column.bend.abs() * (16.0 * reach).powi(2) / 4.0;
        let reach = reach + bow + 1e-3;
        let taps = (2.0 * reach).ceil() as usize;
        (!z.is_empty()).then_some(Self { column, path, lines, numbers, z, per_z, reach, taps })
    }

    /// The (fractional) row that meets position `z` along the lines.
    fn row(&self, z: f64) -> f64 {
        let q = (z - self.path.along[0]) * self.per_z;
        self.column.middle + q / (1.0 - self.column.bend * q)
    }

    /// The windows for the vectors of voxels of an upright column.
    #[inline(always)]
    fn windows_upright<R: Real>(&self, n: usize, len: usize, windows: &mut Windows<R>) {
        windows.resize(n);
        let Windows { first, from, off, .. } = windows;
        let (first, starts, off) = (&mut first[..n], &mut from[..n], &mut off[..n]);
        for i in 0..n {
            let z = (self.z.start + i * len) as f64;
            let from = self.column.middle + (z - self.path.along[0]) * self.per_z - self.reach;
            let base = from.floor();
            first[i] = (base + (1.0 + PAD as f64)).count();
            starts[i] = R::of(from - base);
            let q = base + 1.0 - self.column.middle;
            off[i] = R::of(q.mul_add(self.path.along[1], self.path.along[0] - z));
        }
    }

    /// The windows for the vectors of voxels of any column.
    #[inline(always)]
    fn windows<R: Real>(&self, n: usize, len: usize, windows: &mut Windows<R>) {
        windows.resize(n);
        let Windows { first, from, apart, off, low, until, across } = windows;
        let (first, starts, apart, off) = (&mut first[..n], &mut from[..n], &mut apart[..n], &mut off[..n]);
        let (low, until, across) = (&mut low[..n], &mut until[..n], &mut across[..n]);
        let per_z = self.path.across[1] * self.per_z;
        for i in 0..n {
            let z = self.z.start + i * len;
            let next = (z + len).min(self.z.end);
            let (row, after) = (self.row(z as f64), self.row(next as f64));
            let from = row - self.reach;
            let base = from.floor();
            first[i] = (base + (1.0 + PAD as f64)).count();
            starts[i] = R::of(from - base);
            apart[i] = R::of((after - row) / (next - z) as f64);
            off[i] = R::of(self.path.along[0] - z as f64);
            // Besides the rows that affect this vector: the lines that they cross.
            let y = self.path.across[0] + per_z * (z as f64 - self.path.along[0]);
            let (a, b) = (y - per_z, y + per_z * len as f64);
            let (lowest, highest) = (a.min(b).floor(), a.max(b).floor());
            let line = lowest.max(-1.0);
            low[i] = (line + 1.0).count();
            until[i] = if highest < -1.0 || lowest >= self.lines {
                Windows::<R>::NONE
            } else if lowest == highest && lowest >= -1.0 {
                Windows::<R>::PAIR
            } else {
                ((highest + 1.0).min(self.lines) + 2.0).count()
            };
            across[i] = R::of(y - line);
        }
    }

    /// Every voxel sums over the rows less than a voxel away: at most `K` of them. `from` are pixels and their q.
    #[inline(always)]
    fn gather<S: Simd, R: Real, const K: usize>(
        &self,
        s: S,
        [pixels, q]: [&[R]; 2],
        plane: &mut [R],
        stride: usize,
        windows: &mut Windows<R>,
    ) {
        let len = V::<S, R>::LEN;
        let number = |x: R| V::<S, R>::splat(s, x);
        let lanes = V::<S, R>::from_fn(s, |i| R::of(i as f64));
        let (zero, one) = (number(R::ZERO), number(R::ONE));
        let rise = number(R::of(self.path.along[1]));
        let slant = number(R::of(self.path.across[1] * self.per_z));
        let near = R::of((2 * len) as f64 - 1.5 - K as f64);
        let most = number(R::of((pixels.len() - K - 1) as f64));
        let vectors = self.z.len().div_ceil(len);
        self.windows(vectors, len, windows);
        for i in 0..vectors {
            let (low, until) = (windows.low[i] as usize, windows.until[i]);
            if until == Windows::<R>::NONE {
                continue;
            }
            let apart = windows.apart[i];
            let at = lanes.mul_add(number(apart), number(windows.from[i])).floor();
            let first = windows.first[i] as usize;
            let (pixels, q) = if apart * R::of((len - 1) as f64) <= near {
                let from = first..first + 2 * len;
                (R::window::<S, K, 2>(s, &pixels[from.clone()], at), R::window::<S, K, 2>(s, &q[from], at))
            } else {
                let at = (at + number(R::of(first as f64))).min(most);
                (R::neighbours::<S, K>(s, pixels, at), R::neighbours::<S, K>(s, q, at))
            };
            let up = number(windows.off[i]) - lanes;
            let mut shares = [zero; K];
            let mut away = [zero; K];
            let (mut sum, mut moment) = (zero, zero);
            for k in 0..K {
                let d = q[k].mul_add(rise, up);
                let share = (one - d.abs()).max(zero) * pixels[k];
                sum += share;
                moment = share.mul_add(d, moment);
                (shares[k], away[k]) = (share, d);
            }
            // The column's position at each voxel's own z, in lines from `low`.
            let y = lanes.mul_add(slant, number(windows.across[i]));
            let to = PAD + self.z.start + i * len;
            if until == Windows::<R>::PAIR {
                // All between the same two lines: the weight of the upper one is linear.
                let upper = y.mul_add(sum, moment * slant);
                add::<S, R>(s, plane, low * stride + to, sum - upper);
                add::<S, R>(s, plane, (low + 1) * stride + to, upper);
                continue;
            }
            let mut off = y;
            for l in low..until as usize {
                let mut sum = zero;
                for k in 0..K {
                    let off = away[k].mul_add(slant, off);
                    sum = (one - off.abs()).max(zero).mul_add(shares[k], sum);
                }
                add::<S, R>(s, plane, l * stride + to, sum);
                off -= one;
            }
        }
    }

    /// [`Hit::gather`] for an upright column: its rows are equally spaced, between the same two lines.
    #[inline(always)]
    fn gather_upright<S: Simd, R: Real, const K: usize>(
        &self,
        s: S,
        pixels: &[R],
        plane: &mut [R],
        stride: usize,
        windows: &mut Windows<R>,
    ) {
        let len = V::<S, R>::LEN;
        let number = |x: f64| V::<S, R>::splat(s, R::of(x));
        let lanes = V::<S, R>::from_fn(s, |i| R::of(i as f64));
        let (zero, one) = (number(0.0), number(1.0));
        let y = self.path.across[0];
        let low = y.floor();
        if low < -1.0 || low >= self.lines {
            return;
        }
        let (upper, lower) = (number(y - low), number(1.0 - (y - low)));
        let rise = number(self.path.along[1]);
        let near = self.per_z * (len - 1) as f64 + 1.0 + K as f64 <= 2.0 * len as f64 - 0.5;
        let most = number((pixels.len() - K - 1) as f64);
        let apart = lanes * number(self.per_z);
        let vectors = self.z.len().div_ceil(len);
        self.windows_upright(vectors, len, windows);
        let (below, above) = plane[(low + 1.0).count() as usize * stride..].split_at_mut(stride);
        let (below, above) = (&mut below[PAD + self.z.start..], &mut above[PAD + self.z.start..]);
        for i in 0..vectors {
            let cell = (apart + V::<S, R>::splat(s, windows.from[i])).floor();
            let first = windows.first[i] as usize;
            let pixels = if near {
                R::window::<S, K, 2>(s, &pixels[first..first + 2 * len], cell)
            } else {
                R::neighbours::<S, K>(s, pixels, (cell + number(first as f64)).min(most))
            };
            // Distance of the first of those rows from each voxel, in voxels.
            let mut d = cell.mul_add(rise, V::<S, R>::splat(s, windows.off[i]) - lanes);
            let mut sum = zero;
            for x in pixels {
                sum = (one - d.abs()).max(zero).mul_add(x, sum);
                d += rise;
            }
            add::<S, R>(s, below, i * len, lower * sum);
            add::<S, R>(s, above, i * len, upper * sum);
        }
    }

    /// Every row contributes to its neighbouring voxels: for detectors with many rows per voxel.
    #[inline(always)]
    fn scatter<R: Real>(&self, [pixels, q]: [&[R]; 2], plane: &mut [R], stride: usize) {
        let path: Path<R> = self.path.narrow();
        let rows = PAD + self.column.rows.start..PAD + self.column.rows.end;
        for (&pixel, &q) in pixels[rows.clone()].iter().zip(&q[rows]) {
            let (y, z) = (path.across(q), path.along(q));
            let (line, cell) = (y.floor(), z.floor());
            let inside = |x: R, n: f64| x >= R::of(-1.0) && x < R::of(n);
            if !inside(line, self.lines) || !inside(cell, self.numbers as f64) {
                continue;
            }
            let at = (line.int() + 1) as usize * stride + (cell.int() + PAD as i64) as usize;
            let (low, high) = ((line + R::ONE - y) * pixel, (y - line) * pixel);
            let shares = [cell + R::ONE - z, z - cell];
            for (k, share) in shares.into_iter().enumerate() {
                plane[at + k] += low * share;
                plane[at + k + stride] += high * share;
            }
        }
    }
}

/// Adds `x` to the numbers from `at` on.
#[inline(always)]
fn add<S: Simd, R: Real>(s: S, numbers: &mut [R], at: usize, x: V<S, R>) {
    let numbers = &mut numbers[at..at + V::<S, R>::LEN];
    (V::<S, R>::from_slice(s, numbers) + x).store_slice(numbers);
}
