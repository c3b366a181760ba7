//! Rays that pass beside the volume but are attenuated: the object is larger than the volume.

use crate::geometry::{Ray, VoxelGrid, norm, sub};
use crate::parallel;
use crate::scan::Scan;
use serde::Serialize;

/// Views that are examined, and blocks along each side of the detector.
const VIEWS: usize = 90;
const BLOCKS: usize = 48;
/// Share of the attenuated rays beside the volume that lie beyond its ends along an axis, from which it is too short there.
const ALONG: f64 = 0.1;

/// What rays beside the volume measure.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Outside {
    /// Share of the examined views in which several blocks of such rays exceed the level.
    pub views: f64,
    /// The largest mean of a block.
    pub most: f32,
    /// The axes along which the object extends beyond the volume.
    pub along: [bool; 3],
}

impl Outside {
    /// Looks in evenly spaced views for blocks of pixels whose rays all pass beside the volume and whose mean exceeds
    /// `level`. One block may be noise or a bad pixel.
    pub fn of(scan: &Scan, level: f32) -> Self {
        let g = &scan.geometry;
        let [rows, columns] = g.detector;
        // A ray that grazes the volume shows what lies just inside of it.
        let grid = grown(&g.volume);
        let size = |n: usize| n.div_ceil(BLOCKS).max(1);
        let (tall, wide) = (size(rows), size(columns));
        let views: Vec<usize> = (0..g.views.len()).step_by(g.views.len().div_ceil(VIEWS).max(1)).collect();
        let found: Vec<(usize, f32, [usize; 3])> = parallel::map(&views, |_, &view| {
            let image = scan.view(view);
            let (mut blocks, mut most, mut along) = (0, 0.0f32, [0; 3]);
            for row in (0..rows).step_by(tall) {
                for column in (0..columns).step_by(wide) {
                    let ends = [(row + tall).min(rows), (column + wide).min(columns)];
                    let [r, c] = [(row + ends[0]) as f64 / 2.0 - 0.5, (column + ends[1]) as f64 / 2.0 - 0.5];
                    let v = &g.views[view];
                    let to = sub(v.pixel(g.detector, r, c), v.source);
                    let ray = Ray { origin: v.source, direction: to.map(|x| x / norm(to)) };
                    if ray.clip(grid.bounds()).is_some() {
                        continue;
                    }
                    let part = image.slice(ndarray::s![row..ends[0], column..ends[1]]);
                    let mean = part.mean().unwrap_or(0.0);
                    if mean > level {
                        blocks += 1;
                        most = most.max(mean);
                        along[farthest(&ray, &grid)] += 1;
                    }
                }
            }
            (blocks, most, along)
        });
        let shown = found.iter().filter(|f| f.0 > 2).count();
        let all: usize = found.iter().map(|f| f.0).sum();
        let sum = |k: usize| found.iter().map(|f| f.2[k]).sum::<usize>();
        Self {
            views: shown as f64 / views.len().max(1) as f64,
            most: found.iter().fold(0.0, |m, f| m.max(f.1)),
            along: [0, 1, 2].map(|k| all > 0 && sum(k) as f64 > ALONG * all as f64),
        }
    }

    /// Whether more than single views show it.
    pub fn is_seen(&self) -> bool {
        self.views > 0.02
    }
}

/// The grid with a voxel more on every side.
fn grown(grid: &VoxelGrid) -> VoxelGrid {
    VoxelGrid { shape: grid.shape.map(|n| n + 2), ..*grid }
}

/// The axis along which a ray that misses `grid` is farthest beyond it, where it is nearest to the centre.
fn farthest(ray: &Ray, grid: &VoxelGrid) -> usize {
    let to = sub(grid.center, ray.origin);
    let t: f64 = (0..3).map(|k| to[k] * ray.direction[k]).sum();
    let size = grid.size();
    let beyond = |k: usize| (t * ray.direction[k] - to[k]).abs() - size[k] / 2.0;
    (0..3).max_by(|&a, &b| beyond(a).total_cmp(&beyond(b))).unwrap_or(2)
}
