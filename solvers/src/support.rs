//! Finds the object's support from the views alone: a region through which several views see only air is air.
//!
//! Views are reduced to block means, in which noise is lower and a thin wire is still visible. A block counts as object
//! if it exceeds the air level by three standard deviations of such means; so do its neighbours within a cell's shadow.
//! A cell is removed if at least two views, and at least 15 % of those that see it, show air there: a faint detail that
//! noise hides in some views stays. A view whose borders the object reaches is ignored, because its air level is
//! unknown. Neighbours of remaining cells stay too.

use crate::shadow::{dark_differences, dilated};
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Geometry, Vec3, VoxelGrid, norm};
use conefield_core::parallel;
use conefield_core::scan::Scan;
use conefield_core::support::Support;
use conefield_projectors::voxel::layout::Pinhole;
use ndarray::{Array2, ArrayView1, ArrayView2, Axis};

/// Cells along the longest side of the volume.
const CELLS: f64 = 64.0;
/// Approximate number of blocks along a detector row.
const BLOCKS: usize = 128;
/// Standard deviations above air from which a block counts as object.
const DEVIATIONS: f32 = 3.0;
/// Blocks of a view's border that are tested together.
const TOGETHER: usize = 8;
/// Share of the views that see a cell and must show air there, and their minimum number.
const SHARE: f64 = 0.15;
const VIEWS: usize = 2;

/// Refuses a scan no ray of which meets the volume.
pub(crate) fn meets_the_volume(g: &Geometry) -> Result<()> {
    let (bounds, [rows, columns]) = (g.volume.bounds(), g.detector);
    let meets = |v, p: usize| g.ray(v, p / columns, p % columns).clip(bounds).is_some();
    let met = (0..g.views.len()).any(|v| (0..rows * columns).any(|p| meets(v, p)));
    ensure(met, "scan", "geometry", "rays that all miss the volume", "rays through the volume")
}

/// The result of carving.
pub struct CarvedSupport {
    /// The remaining cells, if any were removed.
    pub support: Option<Support>,
    /// Description for the log.
    pub said: String,
}

/// A scan's views, reduced to block means.
pub(crate) struct Blocks {
    /// Pixels along a block's side.
    size: usize,
    /// Each of so many views has blocks.
    every: usize,
    /// Block means of each view.
    means: Vec<Array2<f32>>,
    /// Standard deviation of their noise.
    deviation: f32,
    /// The largest pixel.
    top: f32,
    /// Block mean in air, if some view shows air.
    air: Option<f32>,
}

impl Blocks {
    /// The blocks of one in `every` views. Views are counted among these.
    pub(crate) fn of(scan: &Scan, every: usize) -> Self {
        let g = &scan.geometry;
        let size = g.detector[1].div_ceil(BLOCKS).max(2);
        let views: Vec<usize> = (0..g.views.len()).step_by(every).collect();
        let means: Vec<Array2<f32>> = parallel::map(&views, |_, &v| block_means(scan.view(v), size));
        let largest = parallel::map(&views, |_, &v| scan.view(v).iter().copied().fold(0.0f32, f32::max));
        let top = largest.into_iter().fold(0.0, f32::max);
        let deviation = deviation(&means, top);
        let air = air(&means, deviation, top);
        Self { size, every, means, deviation, top, air }
    }

    /// The views in which some block shows the object, each with the first column of the object and the one after the
    /// last. Without air, all columns of all views.
    pub(crate) fn columns(&self) -> Vec<(usize, [usize; 2])> {
        let ends = |(i, means): (usize, &Array2<f32>)| {
            let shows = |c: &usize| self.air.is_none_or(|air| reached(means.column(*c), air, self.deviation, self.top));
            let first = (0..means.ncols()).find(shows)?;
            let last = (0..means.ncols()).rev().find(shows)?;
            Some((i * self.every, [first * self.size, (last + 1) * self.size]))
        };
        self.means.iter().enumerate().filter_map(ends).collect()
    }

    /// A mean of pixels that is surely not air: 5 % of the largest pixel above it, or four deviations of a block.
    pub(crate) fn object(&self) -> f32 {
        self.air.unwrap_or(0.0) + (4.0 * self.deviation).max(0.05 * self.top)
    }

    /// Whether the object reaches a border of a view along `axis`: 0 for the first and last row, 1 for the first and
    /// last column.
    pub(crate) fn cut(&self, view: usize, axis: usize) -> bool {
        let means = &self.means[view];
        let Some(air) = self.air else { return self.top > 0.0 };
        [0, means.len_of(Axis(axis)) - 1]
            .iter()
            .any(|&i| reached(means.index_axis(Axis(axis), i), air, self.deviation, self.top))
    }
}

/// Carves the volume of a scan.
pub fn carve(scan: &Scan) -> CarvedSupport {
    let g = &scan.geometry;
    let nothing = |why: &str| CarvedSupport { support: None, said: format!("the whole volume, {why}") };
    let blocks = Blocks::of(scan, 1);
    let &Blocks { size, deviation, top, air, .. } = &blocks;
    let Some(air) = air else { return nothing("as no view shows air") };
    let level = air + DEVIATIONS * deviation + 1e-3 * top;
    let cells = cells(&g.volume);
    // Half a cell's diagonal on the detector, in blocks, at the largest magnification.
    let half = 0.5 * norm(cells.spacing);
    let views: Vec<ViewShadow> = parallel::map(&blocks.means, |v, means| {
        let pinhole = Pinhole::of(g, v);
        let nearest = corners(&cells).into_iter().map(|p| pinhole.project(p).1).fold(f64::INFINITY, f64::min);
        if blocks.cut(v, 1) || nearest <= 0.0 {
            return None;
        }
        let w = &g.views[v];
        let pitch = [w.u, w.v].map(norm);
        let reach = half * pinhole.distance / nearest / (pitch[0].min(pitch[1]) * size as f64);
        Some(ViewShadow { pinhole, object: dilated(means.mapv(|m| m > level), 1 + reach.ceil() as usize) })
    })
    .into_iter()
    .flatten()
    .collect();
    if views.len() < VIEWS {
        return nothing("as the object reaches the sides of the views");
    }
    let [nx, ny, nz] = cells.shape;
    let left: Vec<bool> = parallel::map(0..nx * ny * nz, |_, i| {
        let p = cells.voxel([i / (ny * nz), i / nz % ny, i % nz]);
        let votes = views.iter().filter_map(|v| v.air(p, g.detector, size));
        let (seen, air) = votes.fold((0, 0), |(seen, air), a| (seen + 1, air + usize::from(a)));
        air < VIEWS || (air as f64) < SHARE * seen as f64
    });
    let share = views.len();
    match Support::new(cells, widened(&left, cells.shape)) {
        None => nothing("as every view shows nothing but air"),
        Some(support) => {
            let box_: f64 = (0..3).map(|k| support.bounds()[1][k] - support.bounds()[0][k]).product();
            let all: f64 = g.volume.size().iter().product();
            let said = format!(
                "{:.0}% of the volume, in a box of {:.0}%, from the air in {share} of {} views",
                100.0 * support.share(&g.volume),
                100.0 * box_ / all,
                g.views.len()
            );
            CarvedSupport { support: Some(support), said }
        }
    }
}

/// The object's shadow in a view, dilated by a cell's shadow.
struct ViewShadow {
    pinhole: Pinhole,
    object: Array2<bool>,
}

impl ViewShadow {
    /// Whether the view shows air at `p`; `None` if it does not see `p`.
    fn air(&self, p: Vec3, [rows, columns]: [usize; 2], size: usize) -> Option<bool> {
        let ([row, column], depth) = self.pinhole.project(p);
        let inside =
            depth > 0.0 && row >= -0.5 && column >= -0.5 && row < rows as f64 - 0.5 && column < columns as f64 - 0.5;
        inside.then(|| !self.object[[(row + 0.5) as usize / size, (column + 0.5) as usize / size]])
    }
}

/// Means of blocks of `size` × `size` pixels; the last blocks of a line may be smaller.
fn block_means(view: ArrayView2<'_, f32>, size: usize) -> Array2<f32> {
    let (rows, columns) = view.dim();
    Array2::from_shape_fn((rows.div_ceil(size), columns.div_ceil(size)), |(r, c)| {
        let block =
            view.slice(ndarray::s![r * size..((r + 1) * size).min(rows), c * size..((c + 1) * size).min(columns)]);
        block.sum() / block.len() as f32
    })
}

/// Whether the object reaches a border of a view: the mean of some adjacent blocks exceeds air by more than chance in a
/// scan.
fn reached(side: ArrayView1<'_, f32>, air: f32, deviation: f32, top: f32) -> bool {
    side.axis_chunks_iter(Axis(0), TOGETHER).any(|part| {
        let n = part.len() as f32;
        part.sum() / n > air + 4.0 * deviation / n.sqrt() + 1e-3 * top
    })
}

/// The standard deviation of block means in air, from the median difference of dark neighbours, which edges hardly
/// change. Block means are nearly normal even if noise was clipped at 0.
fn deviation(blocks: &[Array2<f32>], top: f32) -> f32 {
    let mut all: Vec<f32> = blocks.iter().flat_map(|b| dark_differences(b.view(), top)).collect();
    if all.is_empty() {
        return 0.0;
    }
    let k = all.len() / 2;
    // The median of |a − b| of two normals with deviation s is 0.954·s.
    *all.select_nth_unstable_by(k, f32::total_cmp).1 / 0.954
}

/// The air level of block means, if there is air: the median of the values close to the lowest one.
fn air(blocks: &[Array2<f32>], deviation: f32, top: f32) -> Option<f32> {
    let mut all: Vec<f32> = blocks.iter().flatten().copied().collect();
    let k = all.len() / 20;
    let low = *all.select_nth_unstable_by(k, f32::total_cmp).1;
    // Noise clipped at 0 has a mean above 0, but well below its standard deviation over single pixels.
    if !(low.is_finite() && top > 0.0) || low > 2.0 * deviation + 0.01 * top {
        return None;
    }
    let mut close: Vec<f32> = all.into_iter().filter(|m| *m <= low + 4.0 * deviation + 1e-3 * top).collect();
    let k = close.len() / 2;
    Some(*close.select_nth_unstable_by(k, f32::total_cmp).1)
}

/// Nearly cubic cells that fill the volume.
fn cells(volume: &VoxelGrid) -> VoxelGrid {
    let size = volume.size();
    let side = size.into_iter().fold(0.0, f64::max) / CELLS;
    let shape: [usize; 3] =
        std::array::from_fn(|k| ((size[k] / side).ceil() as usize).clamp(1, volume.shape[k].max(1)));
    VoxelGrid { shape, spacing: std::array::from_fn(|k| size[k] / shape[k] as f64), center: volume.center }
}

/// Corners of a grid.
pub(crate) fn corners(grid: &VoxelGrid) -> [Vec3; 8] {
    let [low, high] = grid.bounds();
    std::array::from_fn(|c| std::array::from_fn(|k| if c >> k & 1 == 0 { low[k] } else { high[k] }))
}

/// Cells and all their neighbours.
fn widened(cells: &[bool], [nx, ny, nz]: [usize; 3]) -> Vec<bool> {
    let near = |i: usize, n: usize| i.saturating_sub(1)..(i + 2).min(n);
    let plane = |x: usize| -> Vec<bool> {
        let near_x = |y: usize, z: usize| near(x, nx).any(|x| cells[(x * ny + y) * nz + z]);
        let of = |i: usize| near(i / nz, ny).any(|y| near(i % nz, nz).any(|z| near_x(y, z)));
        (0..ny * nz).map(of).collect()
    };
    parallel::map(0..nx, |_, x| plane(x)).concat()
}
