//! Geometry in voxel coordinates, and projections stored column by column.

use super::readers::PAD;
use conefield_core::geometry::{Geometry, Vec3, VoxelGrid, cross, dot, sub};
use conefield_core::parallel;
use conefield_core::simd::Real;
use conefield_core::voxel::VoxelView;
use ndarray::{ArrayView3, Axis};

/// A world position in voxel coordinates: integers are voxel centres.
pub fn to_voxels(grid: &VoxelGrid, p: Vec3) -> Vec3 {
    let lower = grid.bounds()[0];
    std::array::from_fn(|k| (p[k] - lower[k]) / grid.spacing[k] - 0.5)
}

/// The axis along which the ray meets most planes of voxels.
pub fn main_axis(ahead: Vec3) -> usize {
    let a = ahead.map(f64::abs);
    if a[0] >= a[1] && a[0] >= a[2] {
        0
    } else if a[1] >= a[2] {
        1
    } else {
        2
    }
}

/// Some views with the pixels of each detector column contiguous, from below, between `PAD` zeros.
pub struct ColumnMajor<R> {
    /// `[view][column][PAD + rows + PAD]`.
    data: Vec<R>,
    rows: usize,
    columns: usize,
    /// Whether the first row of a view's projections is its highest.
    downwards: Vec<bool>,
}

impl<R: Real> ColumnMajor<R> {
    /// The views `views` of `geometry`, with one image each in `projections`.
    pub fn new(geometry: &Geometry, views: &[usize], projections: ArrayView3<'_, R>) -> Self {
        let [rows, columns] = geometry.detector;
        let stride = rows + 2 * PAD;
        let mut data = vec![R::ZERO; views.len() * columns * stride];
        let downwards: Vec<bool> = views.iter().map(|&v| geometry.views[v].v[2] < 0.0).collect();
        parallel::over(data.chunks_mut((columns * stride).max(1)).zip(&downwards), |n, (out, &downwards)| {
            let view = projections.index_axis(Axis(0), n);
            // Strips of columns: each row's numbers are read contiguously and written to lines that stay in cache.
            const STRIP: usize = 16;
            for left in (0..columns).step_by(STRIP) {
                for row in 0..rows {
                    let from_below = if downwards { rows - 1 - row } else { row };
                    for column in left..(left + STRIP).min(columns) {
                        out[column * stride + PAD + from_below] = view[[row, column]];
                    }
                }
            }
        });
        Self { data, rows, columns, downwards }
    }

    /// A column with its padding; row 0 is at `PAD`.
    pub fn column(&self, view: usize, column: usize) -> &[R] {
        let stride = self.rows + 2 * PAD;
        let at = (view * self.columns + column) * stride;
        &self.data[at..at + stride]
    }

    /// The numbers of every view, column by column, each with its padding.
    pub fn views_mut(&mut self) -> impl Iterator<Item = &mut [R]> {
        self.data.chunks_mut((self.columns * (self.rows + 2 * PAD)).max(1))
    }

    /// Whether the first row of a view's projections is its highest.
    pub fn downwards(&self, view: usize) -> bool {
        self.downwards[view]
    }

    /// The pixel at a row (as in the projections) and column; 0 outside the detector.
    pub fn pixel(&self, view: usize, row: isize, column: isize) -> R {
        let (Ok(row), Ok(column)) = (usize::try_from(row), usize::try_from(column)) else { return R::ZERO };
        if row >= self.rows || column >= self.columns {
            return R::ZERO;
        }
        let from_below = if self.downwards[view] { self.rows - 1 - row } else { row };
        self.column(view, column)[PAD + from_below]
    }
}

/// Number of views to hold column by column at once: a few MiB, which stay in the last-level cache.
pub fn batch<R>(detector: [usize; 2]) -> usize {
    views_within::<R>(detector, 12 << 20)
}

/// Number of views of which [`ColumnMajor`] fits into `bytes`, 1 to 64.
pub fn views_within<R>(detector: [usize; 2], bytes: u64) -> usize {
    (bytes / column_major_bytes::<R>(detector, 1).max(1)).clamp(1, 64) as usize
}

/// Bytes of [`ColumnMajor`] for `views` views.
pub fn column_major_bytes<R>([rows, columns]: [usize; 2], views: usize) -> u64 {
    (views * columns * (rows + 2 * PAD) * size_of::<R>()) as u64
}

/// Maps world positions to detector coordinates of a view, tilted or not: `u`, `v` in pixels and the depth.
#[derive(Debug, Clone, Copy)]
pub struct Pinhole {
    source: Vec3,
    /// Unit normal of the detector, pointing away from the source.
    pub normal: Vec3,
    /// Distance between source and detector along the normal, mm.
    pub distance: f64,
    /// From the source to the pixel (0, 0), mm.
    corner: Vec3,
    /// Dual basis of the pixel axes within the detector.
    dual: [Vec3; 2],
}

impl Pinhole {
    /// View `view` of `geometry`.
    pub fn of(geometry: &Geometry, view: usize) -> Self {
        let w = &geometry.views[view];
        let (normal, distance) = w.normal();
        let n = cross(w.u, w.v);
        let square = dot(n, n);
        let dual = [cross(w.v, n), cross(n, w.u)].map(|d| d.map(|x| x / square));
        let corner = sub(w.pixel(geometry.detector, 0.0, 0.0), w.source);
        Self { source: w.source, normal, distance, corner, dual }
    }

    /// The same map for the voxel indices of `grid`, for a view with the weight `scale`.
    pub fn voxels(&self, grid: &VoxelGrid, scale: f64) -> VoxelView {
        let corner = sub(grid.voxel([0; 3]), self.source);
        let linear = |axis: Vec3| {
            let along: Vec3 = std::array::from_fn(|k| axis[k] * grid.spacing[k]);
            [dot(axis, corner), along[0], along[1], along[2]]
        };
        let depth = linear(self.normal);
        let place = |dual: Vec3| {
            let along = linear(dual.map(|x| x * self.distance));
            let offset = dot(dual, self.corner);
            std::array::from_fn(|k| along[k] - offset * depth[k])
        };
        VoxelView { depth, row: place(self.dual[1]), column: place(self.dual[0]), scale }
    }

    /// Row and column (integers are pixel centres) where the ray through `p` meets the detector, and the depth of `p`:
    /// its distance from the source along the normal in mm.
    pub fn project(&self, p: Vec3) -> ([f64; 2], f64) {
        let d = sub(p, self.source);
        let depth = dot(self.normal, d);
        let hit: Vec3 = std::array::from_fn(|k| d[k] * self.distance / depth - self.corner[k]);
        ([dot(self.dual[1], hit), dot(self.dual[0], hit)], depth)
    }
}
