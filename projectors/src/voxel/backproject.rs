//! The voxel-driven, distance-weighted back-projection of FDK (Feldkamp, Davis and Kress, JOSA A 1(6), 1984).
//!
//! Every voxel receives `Σ_i s_i/U_i²·p_i(u, v)`: `U_i` is its depth in view `i`, `p_i` is interpolated bilinearly
//! where the ray through the voxel's centre meets the detector; pixels outside the detector are 0. The voxels of a line
//! along z project to a line on the detector and read columns of pixels as described in `readers`; those that run along
//! the columns are faster, as described in `upright`.

use super::layout::{ColumnMajor, Pinhole};
use super::readers::{Among, Ends, PAD, Path, Stands, places, read};
use super::upright::{Blend, Upright};
use conefield_core::geometry::Geometry;
use conefield_core::parallel;
use conefield_core::simd::{Op, Real, Simd, SimdBase, SimdFloat, V, WIDEST, run};
use conefield_core::voxel::VoxelView;
use ndarray::{ArrayViewMut3, Axis, s};

/// Lines of voxels per task, along x and along y. A tile of 512 voxels along z, and the columns of pixels that it meets in
/// a view, take a quarter of a MiB and stay in a core's cache while all views are added.
pub const TILE: usize = 8;
/// Largest slant of a line of voxels: change in columns per change in rows. Steeper lines are processed voxel by voxel.
const SLANT: f64 = 0.5;

/// Adds the views `views` of `geometry`, with the pixels `pixels` and the scales `s_i` in `scales` (mm²), to `slab`:
/// planes of the volume along x, from plane `first` on. The result does not depend on the slabs.
pub fn backproject(
    geometry: &Geometry,
    views: &[usize],
    pixels: &ColumnMajor<f32>,
    scales: &[f64],
    slab: ArrayViewMut3<'_, f32>,
    first: usize,
) {
    backproject_in(geometry, views, pixels, scales, slab, first);
}

/// [`backproject`] with numbers of any precision. Whoever calls it compiles its kernel anew.
pub(super) fn backproject_in<R: Real>(
    geometry: &Geometry,
    views: &[usize],
    pixels: &ColumnMajor<R>,
    scales: &[f64],
    mut slab: ArrayViewMut3<'_, R>,
    first: usize,
) {
    let seen = |(&v, &scale): (&usize, &f64)| Pinhole::of(geometry, v).voxels(&geometry.volume, scale);
    let all: Vec<VoxelView> = views.iter().zip(scales).map(seen).collect();
    let shape = geometry.volume.shape;
    let zeros = vec![R::ZERO; geometry.detector[0] + 2 * PAD];
    let mut tiles = vec![];
    for (i, mut rest) in slab.axis_chunks_iter_mut(Axis(0), TILE).enumerate() {
        let ny = rest.dim().1;
        for y in (0..ny).step_by(TILE) {
            let (lines, after) = rest.split_at(Axis(1), TILE.min(ny - y));
            tiles.push(([first + i * TILE, y], lines));
            rest = after;
        }
    }
    parallel::over(tiles, |_, (first, lines)| {
        run(Tile { detector: geometry.detector, pixels, zeros: &zeros, views: &all, shape, first, lines });
    });
}

/// A tile of lines of voxels along z, in all views.
struct Tile<'a, R> {
    detector: [usize; 2],
    pixels: &'a ColumnMajor<R>,
    /// A column of pixels outside the detector.
    zeros: &'a [R],
    views: &'a [VoxelView],
    /// Shape of the volume.
    shape: [usize; 3],
    /// Its first line.
    first: [usize; 2],
    lines: ArrayViewMut3<'a, R>,
}

impl<R: Real> Op for Tile<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let Self { detector, pixels, zeros, views, shape, first, mut lines } = self;
        let (nx, ny, nz) = lines.dim();
        let mut q = vec![R::ZERO; nz.next_multiple_of(V::<S, R>::LEN)];
        let (mut stands, mut ends) = (Stands::new(q.len() / V::<S, R>::LEN), Ends::default());
        let mut blend = Blend::default();
        for (index, view) in views.iter().enumerate() {
            let image = Image { view, detector, pixels, index, zeros };
            let upright = Upright::of(&image, shape, V::<S, R>::LEN);
            // Successive lines read nearby columns, which are then still in the nearest cache.
            let along_x = view.column[1].abs() < view.column[2].abs();
            for i in 0..nx * ny {
                let [x, y] = if along_x { [i % nx, i / nx] } else { [i / ny, i % ny] };
                let Some(voxels) = lines.slice_mut(s![x, y, ..]).into_slice() else { continue };
                let at = [first[0] + x, first[1] + y];
                if let Some(view) = &upright {
                    view.add(s, at, voxels, &mut blend);
                } else if let Some(line) = Line::of(&image, at, nz) {
                    image.add(s, &line, &mut q, (&mut ends, &mut stands), voxels);
                } else {
                    image.add_one_by_one(at, voxels);
                }
            }
        }
    }
}

/// A line of voxels along z on the detector of a view.
struct Line {
    /// The voxel from which q is measured, and the bend of q.
    middle: f64,
    bend: f64,
    /// Columns across, rows from below along them.
    path: Path<f64>,
    /// Weight of a pixel for the middle voxel.
    weight: f64,
}

impl Line {
    /// The line of `nz` voxels at `x` and `y`; `None` unless it runs along the columns, upwards and in front of the
    /// source.
    fn of<R: Real>(image: &Image<'_, R>, [x, y]: [usize; 2], nz: usize) -> Option<Self> {
        let view = image.view;
        let middle = (nz / 2) as f64;
        let at = |n: &[f64; 4]| n[0] + n[1] * x as f64 + n[2] * y as f64 + n[3] * middle;
        let (depth, deeper) = (at(&view.depth), view.depth[3]);
        let ends = [depth - deeper * middle, depth + deeper * (nz as f64 - 1.0 - middle)];
        let reach = 1.0 / depth;
        // (a + b·ρ)/(depth + c·ρ) = a/depth + drift·q.
        let place = |n: &[f64; 4]| {
            let middle = at(n) * reach;
            [middle, (n[3] - deeper * middle) * reach]
        };
        let (mut along, across) = (place(&view.row), place(&view.column));
        if image.pixels.downwards(image.index) {
            along = [image.detector[0] as f64 - 1.0 - along[0], -along[1]];
        }
        let fits = ends[0] > 0.0 && ends[1] > 0.0 && along[1] > 0.0 && across[1].abs() <= SLANT * along[1];
        let weight = view.scale * reach * reach;
        fits.then_some(Self { middle, bend: deeper * reach, path: Path { across, along }, weight })
    }
}

/// The pixels of a view.
pub(super) struct Image<'a, R> {
    pub view: &'a VoxelView,
    pub detector: [usize; 2],
    pub pixels: &'a ColumnMajor<R>,
    /// Its index in `pixels`.
    pub index: usize,
    /// A column of pixels outside the detector.
    zeros: &'a [R],
}

impl<'a, R: Real> Image<'a, R> {
    /// A column of pixels, counted from column −1.
    #[inline(always)]
    pub fn column(&self, column: usize) -> &'a [R] {
        match column.checked_sub(1) {
            Some(c) if c < self.detector[1] => self.pixels.column(self.index, c),
            _ => self.zeros,
        }
    }

    /// Adds to `voxels` the values that they read on their line; `q`, `ends` and `stands` are buffers.
    #[inline(always)]
    fn add<S: Simd>(
        &self,
        s: S,
        line: &Line,
        q: &mut [R],
        (ends, stands): (&mut Ends<R>, &mut Stands<R>),
        voxels: &mut [R],
    ) {
        let len = V::<S, R>::LEN;
        let [rows, columns] = self.detector;
        let among = Among {
            lines: R::of(columns as f64),
            numbers: R::of(rows as f64),
            span: [R::of(-1.0), R::of(rows as f64)],
        };
        places(s, 0.0, [line.middle, line.bend], [0.0, voxels.len() as f64 - 1.0], q);
        let path = line.path.narrow();
        ends.find(q, len);
        stands.place(&path, &among, ends, len);
        let weight = V::<S, R>::splat(s, R::of(line.weight));
        let (bend, one) = (V::<S, R>::splat(s, R::of(-line.bend)), V::<S, R>::splat(s, R::ONE));
        // The end of a line that does not fill a vector is processed in a separate buffer.
        let (whole, rest) = voxels.split_at_mut(voxels.len() - voxels.len() % len);
        let mut tail = [R::ZERO; WIDEST];
        tail[..rest.len()].copy_from_slice(rest);
        for (i, q) in q.chunks_exact(len).enumerate() {
            let q = V::<S, R>::from_slice(s, q);
            let Some(found) = read(s, &path, &among, stands, i, q, |c| self.column(c)) else { continue };
            let voxels = if i * len < whole.len() { &mut whole[i * len..(i + 1) * len] } else { &mut tail[..len] };
            // The ratio of the middle's depth to the voxel's is 1/(1 + bend·ρ) = 1 − bend·q.
            let nearer = q.mul_add(bend, one);
            let sum = (found * weight).mul_add(nearer * nearer, V::<S, R>::from_slice(s, voxels));
            sum.store_slice(voxels);
        }
        rest.copy_from_slice(&tail[..rest.len()]);
    }

    /// The same voxel by voxel, for any geometry.
    fn add_one_by_one(&self, [x, y]: [usize; 2], voxels: &mut [R]) {
        let [rows, columns] = self.detector.map(|n| n as f64);
        for (z, voxel) in voxels.iter_mut().enumerate() {
            let at = |n: &[f64; 4]| n[0] + n[1] * x as f64 + n[2] * y as f64 + n[3] * z as f64;
            let depth = at(&self.view.depth);
            let [row, column] = [at(&self.view.row) / depth, at(&self.view.column) / depth];
            if depth > 0.0 && row > -1.0 && column > -1.0 && row < rows && column < columns {
                *voxel += R::of(self.view.scale / (depth * depth) * self.bilinear(row, column));
            }
        }
    }

    /// Bilinear interpolation on the detector; pixels outside are 0.
    fn bilinear(&self, row: f64, column: f64) -> f64 {
        let (r, c) = (row.floor(), column.floor());
        let (fr, fc) = (row - r, column - c);
        let pixel = |dr: f64, dc: f64| self.pixels.pixel(self.index, (r + dr) as isize, (c + dc) as isize).f64();
        (1.0 - fr) * ((1.0 - fc) * pixel(0.0, 0.0) + fc * pixel(0.0, 1.0))
            + fr * ((1.0 - fc) * pixel(1.0, 0.0) + fc * pixel(1.0, 1.0))
    }
}
