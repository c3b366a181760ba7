//! Where the object can be, from the views alone: what several views see nothing but air through is air.
//!
//! Views are reduced to means of blocks, in which noise is smaller and a thin wire still shows. A block above the air's
//! own level by three standard deviations of such means counts as object, and so do its neighbours as far as a cell's
//! shadow reaches. A cell is left out where at least two views, and at least 15 % of those that see it, show air there: a
//! faint detail that noise hides from some views stays. A view whose sides the object reaches says nothing: its level of
//! air is not known. Cells beside those that are left stay too.

use crate::shadow::box_filter;
use conefield_core::geometry::{Vec3, VoxelGrid};
use conefield_core::scan::Scan;
use conefield_core::support::Support;
use conefield_projectors::voxel::layout::Pinhole;
use ndarray::{Array2, ArrayView1, ArrayView2, Axis};
use rayon::prelude::*;

/// Cells along the longest side of the volume.
const CELLS: f64 = 64.0;
/// Blocks along a detector row, about.
const BLOCKS: usize = 128;
/// Standard deviations of a block's mean above air from which it counts as object.
const DEVIATIONS: f32 = 3.0;
/// Blocks of a view's side that are looked at together.
const TOGETHER: usize = 8;
/// Share of the views that see a cell which must show air there, and how many at least.
const SHARE: f64 = 0.15;
const VIEWS: usize = 2;

/// What carving came to.
pub struct CarvedSupport {
    /// The cells that are left, if any could be left out.
    pub support: Option<Support>,
    /// In words.
    pub said: String,
}

/// A scan's views, reduced to means of blocks.
pub(crate) struct Blocks {
    /// Pixels along a block's side.
    size: usize,
    /// Of each view.
    means: Vec<Array2<f32>>,
    /// Of their noise.
    deviation: f32,
    /// The largest of all pixels.
    top: f32,
    /// Their level in air, where some view shows air.
    air: Option<f32>,
}

impl Blocks {
    /// Of all views.
    pub(crate) fn of(scan: &Scan) -> Self {
        let g = &scan.geometry;
        let size = g.detector[1].div_ceil(BLOCKS).max(2);
        let means: Vec<Array2<f32>> =
            (0..g.views.len()).into_par_iter().map(|v| block_means(scan.view(v), size)).collect();
        let top = scan.projections.iter().copied().fold(0.0f32, f32::max);
        let deviation = deviation(&means, top);
        let air = air(&means, deviation, top);
        Self { size, means, deviation, top, air }
    }

    /// Whether the object reaches one of the outer lines of a view along `axis`: 0 its first and last row, 1 its first and
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
    let blocks = Blocks::of(scan);
    let &Blocks { size, deviation, top, air, .. } = &blocks;
    let Some(air) = air else { return nothing("as no view shows air") };
    let level = air + DEVIATIONS * deviation + 1e-3 * top;
    let cells = cells(&g.volume);
    // Half a cell's diagonal on the detector, in blocks, where it is magnified most.
    let half = 0.5 * cells.spacing.iter().map(|s| s * s).sum::<f64>().sqrt();
    let views: Vec<ViewShadow> = blocks
        .means
        .par_iter()
        .enumerate()
        .filter_map(|(v, means)| {
            let pinhole = Pinhole::of(g, v);
            let object = means.mapv(|m| m > level);
            let nearest = corners(&cells).into_iter().map(|p| pinhole.project(p).1).fold(f64::INFINITY, f64::min);
            if blocks.cut(v, 1) || nearest <= 0.0 {
                return None;
            }
            let w = &g.views[v];
            let pitch = [w.u, w.v].map(|a| a.iter().map(|x| x * x).sum::<f64>().sqrt());
            let reach = half * pinhole.distance / nearest / (pitch[0].min(pitch[1]) * size as f64);
            let wide = box_filter(object.mapv(|o| f32::from(u8::from(o))), 1 + reach.ceil() as usize, |window| {
                window.iter().copied().fold(0.0, f32::max)
            });
            Some(ViewShadow { pinhole, object: wide.mapv(|x| x > 0.0) })
        })
        .collect();
    if views.len() < VIEWS {
        return nothing("as the object reaches the sides of the views");
    }
    let [nx, ny, nz] = cells.shape;
    let left: Vec<bool> = (0..nx * ny * nz)
        .into_par_iter()
        .map(|i| {
            let p = cells.voxel([i / (ny * nz), i / nz % ny, i % nz]);
            let votes = views.iter().filter_map(|v| v.air(p, g.detector, size));
            let (seen, air) = votes.fold((0, 0), |(seen, air), a| (seen + 1, air + usize::from(a)));
            air < VIEWS || (air as f64) < SHARE * seen as f64
        })
        .collect();
    let share = views.len();
    match Support::new(cells, widened(&left, cells.shape)) {
        None => nothing("as every view shows nothing but air"),
        Some(support) => {
            let box_: f64 = (0..3).map(|k| support.bounds()[1][k] - support.bounds()[0][k]).product();
            let all: f64 = g.volume.size().iter().product();
            let said = format!(
                "{:.0}% of the volume, in a box of {:.0}%, by the air in {share} of {} views",
                100.0 * support.share(),
                100.0 * box_ / all,
                g.views.len()
            );
            CarvedSupport { support: Some(support), said }
        }
    }
}

/// A view's object, widened by a cell's shadow.
struct ViewShadow {
    pinhole: Pinhole,
    object: Array2<bool>,
}

impl ViewShadow {
    /// Whether the view shows air at `p`; `None` where it does not see it.
    fn air(&self, p: Vec3, [rows, columns]: [usize; 2], size: usize) -> Option<bool> {
        let ([row, column], depth) = self.pinhole.project(p);
        let inside =
            depth > 0.0 && row >= -0.5 && column >= -0.5 && row < rows as f64 - 0.5 && column < columns as f64 - 0.5;
        inside.then(|| !self.object[[(row + 0.5) as usize / size, (column + 0.5) as usize / size]])
    }
}

/// Means of blocks of `size` × `size` pixels; the last ones of a line may be smaller.
fn block_means(view: ArrayView2<'_, f32>, size: usize) -> Array2<f32> {
    let (rows, columns) = view.dim();
    Array2::from_shape_fn((rows.div_ceil(size), columns.div_ceil(size)), |(r, c)| {
        let block =
            view.slice(ndarray::s![r * size..((r + 1) * size).min(rows), c * size..((c + 1) * size).min(columns)]);
        block.sum() / block.len() as f32
    })
}

/// Whether the object reaches a side of a view: some of its blocks next to each other are above air in their mean, by
/// more than chance does in a scan.
fn reached(side: ArrayView1<'_, f32>, air: f32, deviation: f32, top: f32) -> bool {
    side.axis_chunks_iter(Axis(0), TOGETHER).any(|part| {
        let n = part.len() as f32;
        part.sum() / n > air + 4.0 * deviation / n.sqrt() + 1e-3 * top
    })
}

/// The standard deviation of block means in air: by the median difference of dark neighbours, which edges hardly move.
/// Means of blocks are near enough to normal even where noise was cut off at 0.
fn deviation(blocks: &[Array2<f32>], top: f32) -> f32 {
    let dark = |x: f32| x < 0.1 * top;
    let pairs = blocks.iter().flat_map(|b| b.rows()).flat_map(|row| {
        let next = row.to_vec();
        row.into_iter().copied().zip(next.into_iter().skip(1)).collect::<Vec<_>>()
    });
    let mut all: Vec<f32> = pairs.filter(|&(a, b)| dark(a) && dark(b)).map(|(a, b)| (a - b).abs()).collect();
    if all.is_empty() {
        return 0.0;
    }
    let k = all.len() / 2;
    let (_, middle, _) = all.select_nth_unstable_by(k, f32::total_cmp);
    // The median of |a − b| for two normals of deviation s is 0.954·s.
    *middle / 0.954
}

/// The level of air in block means, if there is air: the median of what lies close to the lowest of them.
fn air(blocks: &[Array2<f32>], deviation: f32, top: f32) -> Option<f32> {
    let mut all: Vec<f32> = blocks.iter().flatten().copied().collect();
    let k = all.len() / 20;
    let (_, low, _) = all.select_nth_unstable_by(k, f32::total_cmp);
    let low = *low;
    // Noise that is cut off at 0 has a mean above 0, but well below its deviation over single pixels.
    if !(low.is_finite() && top > 0.0) || low > 2.0 * deviation + 0.01 * top {
        return None;
    }
    let mut close: Vec<f32> = all.into_iter().filter(|m| *m <= low + 4.0 * deviation + 1e-3 * top).collect();
    let k = close.len() / 2;
    let (_, middle, _) = close.select_nth_unstable_by(k, f32::total_cmp);
    Some(*middle)
}

/// Cells of about the same side along every axis that fill the volume.
fn cells(volume: &VoxelGrid) -> VoxelGrid {
    let size = volume.size();
    let side = size.into_iter().fold(0.0, f64::max) / CELLS;
    let shape: [usize; 3] =
        std::array::from_fn(|k| ((size[k] / side).ceil() as usize).clamp(1, volume.shape[k].max(1)));
    VoxelGrid { shape, spacing: std::array::from_fn(|k| size[k] / shape[k] as f64), center: volume.center }
}

/// Corners of a grid.
fn corners(grid: &VoxelGrid) -> [Vec3; 8] {
    let [low, high] = grid.bounds();
    std::array::from_fn(|c| std::array::from_fn(|k| if c >> k & 1 == 0 { low[k] } else { high[k] }))
}

/// Cells and all their neighbours.
fn widened(cells: &[bool], [nx, ny, nz]: [usize; 3]) -> Vec<bool> {
    let near = |i: usize, n: usize| i.saturating_sub(1)..(i + 2).min(n);
    (0..cells.len())
        .into_par_iter()
        .map(|i| {
            let [x, y, z] = [i / (ny * nz), i / nz % ny, i % nz];
            near(x, nx).any(|x| near(y, ny).any(|y| near(z, nz).any(|z| cells[(x * ny + y) * nz + z])))
        })
        .collect()
}
