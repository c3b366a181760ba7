//! Where the object can be: found or given before a reconstruction starts.

use crate::error::{Error, Result, ensure};
use crate::geometry::{Ray, Vec3, VoxelGrid};
use ndarray::{Array3, ArrayView3};
use serde::{Deserialize, Serialize};

/// A region that may contain the object; all else is air.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub struct Support {
    shape: Shape,
    /// The bounding box of the region, mm.
    bounds: [Vec3; 2],
}

#[derive(Debug, Clone, PartialEq)]
enum Shape {
    /// The occupied cells of a grid.
    Cells(Cells),
    /// The bounding box.
    Cuboid,
    /// The part of a cylinder along z in the bounding box.
    Cylinder(Cylinder),
}

/// A circle in the plane of x and y, and all points above and below it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cylinder {
    /// x and y of the axis, mm.
    pub center: [f64; 2],
    /// mm.
    pub radius: f64,
}

impl Cylinder {
    fn holds(&self, p: Vec3) -> bool {
        (p[0] - self.center[0]).hypot(p[1] - self.center[1]) <= self.radius
    }

    /// Range (mm along the ray) inside; `None` if the ray misses it.
    pub fn clip(&self, ray: &Ray) -> Option<[f64; 2]> {
        let [dx, dy, _] = ray.direction;
        let from = [ray.origin[0] - self.center[0], ray.origin[1] - self.center[1]];
        let square = dx * dx + dy * dy;
        if square == 0.0 {
            return self.holds(ray.origin).then_some([f64::NEG_INFINITY, f64::INFINITY]);
        }
        let middle = -(from[0] * dx + from[1] * dy) / square;
        let half = (self.radius.powi(2) - (from[0] * dy - from[1] * dx).powi(2) / square) / square;
        (half > 0.0).then(|| [middle - half.sqrt(), middle + half.sqrt()])
    }
}

/// Cells of a regular grid.
#[derive(Debug, Clone, PartialEq)]
struct Cells {
    grid: VoxelGrid,
    /// `[x][y][z]`.
    occupied: Vec<bool>,
}

/// File format.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Written {
    Cells(WrittenCells),
    Shape(WrittenShape),
}

/// Lengths of runs of cells, starting with empty ones.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenCells {
    grid: VoxelGrid,
    runs: Vec<u32>,
}

/// A box, or the part of a cylinder in it.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenShape {
    bounds: [Vec3; 2],
    #[serde(default, skip_serializing_if = "Option::is_none")]
    cylinder: Option<Cylinder>,
}

impl From<Support> for Written {
    fn from(s: Support) -> Self {
        let bounds = s.bounds;
        let Cells { grid, occupied } = match s.shape {
            Shape::Cells(cells) => cells,
            Shape::Cuboid => return Self::Shape(WrittenShape { bounds, cylinder: None }),
            Shape::Cylinder(cylinder) => return Self::Shape(WrittenShape { bounds, cylinder: Some(cylinder) }),
        };
        let mut runs = vec![];
        if occupied.first() == Some(&true) {
            runs.push(0);
        }
        runs.extend(occupied.chunk_by(|a, b| a == b).map(|run| run.len() as u32));
        Self::Cells(WrittenCells { grid, runs })
    }
}

impl TryFrom<Written> for Support {
    type Error = Error;
    fn try_from(w: Written) -> Result<Self> {
        let w = match w {
            Written::Cells(w) => w,
            Written::Shape(WrittenShape { bounds, cylinder }) => return Self::from_shape(bounds, cylinder),
        };
        w.grid.validate("support")?;
        let cells = w.grid.shape.iter().try_fold(1usize, |n, &k| n.checked_mul(k)).filter(|&n| n <= MOST);
        let total: u64 = w.runs.iter().map(|&n| u64::from(n)).sum();
        let fits = cells.filter(|&n| n as u64 == total);
        let expected = || format!("as many as the grid's {:?} cells, at most {MOST}", w.grid.shape);
        fits.ok_or_else(|| Error::invalid("support", "runs", format!("{total} cells"), expected()))?;
        let cells = w.runs.iter().enumerate().flat_map(|(i, &n)| std::iter::repeat_n(i % 2 == 1, n as usize));
        Self::new(w.grid, cells.collect())
            .ok_or_else(|| Error::invalid("support", "runs", "no occupied cell", "at least one"))
    }
}

/// Maximum number of cells.
const MOST: usize = 1 << 24;

impl Support {
    /// The support of these cells (`[x][y][z]` of `grid`); `None` if none is occupied.
    pub fn new(grid: VoxelGrid, occupied: Vec<bool>) -> Option<Self> {
        let [_, ny, nz] = grid.shape;
        let (mut low, mut high) = ([usize::MAX; 3], [0; 3]);
        for (i, _) in occupied.iter().enumerate().filter(|(_, o)| **o) {
            for (k, n) in [i / (ny * nz), i / nz % ny, i % nz].into_iter().enumerate() {
                (low[k], high[k]) = (low[k].min(n), high[k].max(n + 1));
            }
        }
        if low[0] == usize::MAX {
            return None;
        }
        let lower = grid.bounds()[0];
        let corner = |n: [usize; 3]| std::array::from_fn(|k| lower[k] + n[k] as f64 * grid.spacing[k]);
        Some(Self { bounds: [corner(low), corner(high)], shape: Shape::Cells(Cells { grid, occupied }) })
    }

    /// The marked voxels of `volume`, rounded out to blocks of voxels if there are more than 2²⁴; `None` if none is marked.
    pub fn voxels(volume: &VoxelGrid, marked: ArrayView3<'_, bool>) -> Option<Self> {
        let blocks = |side: usize| volume.shape.map(|n| n.div_ceil(side));
        let side = (1..).find(|side| blocks(*side).iter().product::<usize>() <= MOST)?;
        let shape = blocks(side);
        let mut occupied = Array3::from_elem(shape, false);
        for ((x, y, z), _) in marked.indexed_iter().filter(|(_, marked)| **marked) {
            occupied[[x / side, y / side, z / side]] = true;
        }
        let [low, high] = volume.bounds();
        let spacing = volume.spacing.map(|s| s * side as f64);
        let center = std::array::from_fn(|k| low[k] + 0.5 * shape[k] as f64 * spacing[k]);
        let mut support = Self::new(VoxelGrid { shape, spacing, center }, occupied.into_raw_vec_and_offset().0)?;
        // The last blocks can extend beyond the volume.
        support.bounds[1] = std::array::from_fn(|k| support.bounds[1][k].min(high[k]));
        Some(support)
    }

    /// The part of a box (mm) in `volume`; `None` if there is none.
    pub fn cuboid([low, high]: [Vec3; 2], volume: &VoxelGrid) -> Option<Self> {
        let [from, to] = volume.bounds();
        let low: Vec3 = std::array::from_fn(|k| from[k].max(low[k]));
        let high: Vec3 = std::array::from_fn(|k| to[k].min(high[k]));
        (0..3).all(|k| low[k] < high[k]).then_some(Self { shape: Shape::Cuboid, bounds: [low, high] })
    }

    /// The part of a cylinder in `volume`; `None` if there is none.
    pub fn cylinder(cylinder: Cylinder, volume: &VoxelGrid) -> Option<Self> {
        let Cylinder { center, radius } = cylinder;
        let [from, to] = volume.bounds();
        let low = [center[0] - radius, center[1] - radius, from[2]];
        let high = [center[0] + radius, center[1] + radius, to[2]];
        let nearest: [f64; 2] = std::array::from_fn(|k| center[k].clamp(from[k], to[k]));
        let meets = cylinder.holds([nearest[0], nearest[1], 0.0]);
        let part = Self::cuboid([low, high], volume).filter(|_| meets)?;
        Some(Self { shape: Shape::Cylinder(cylinder), ..part })
    }

    fn from_shape(bounds: [Vec3; 2], cylinder: Option<Cylinder>) -> Result<Self> {
        let [low, high] = bounds;
        let ordered = (0..3).all(|k| low[k].is_finite() && high[k].is_finite() && low[k] < high[k]);
        ensure(ordered, "support", "bounds", format!("{bounds:?}"), "finite corners of a box, the lower one first")?;
        let shape = match cylinder {
            None => Shape::Cuboid,
            Some(c) => {
                let right = c.center.iter().all(|x| x.is_finite()) && c.radius.is_finite() && c.radius > 0.0;
                ensure(right, "support", "cylinder", format!("{c:?}"), "a finite centre and a positive radius")?;
                Shape::Cylinder(c)
            }
        };
        Ok(Self { shape, bounds })
    }

    /// The bounding box of the region, mm.
    pub fn bounds(&self) -> [Vec3; 2] {
        self.bounds
    }

    /// Its share of `volume`.
    pub fn share(&self, volume: &VoxelGrid) -> f64 {
        let sides: Vec3 = std::array::from_fn(|k| self.bounds[1][k] - self.bounds[0][k]);
        let size = match &self.shape {
            Shape::Cells(Cells { grid, occupied }) => {
                let cell: f64 = grid.spacing.iter().product();
                cell * occupied.iter().filter(|o| **o).count() as f64
            }
            Shape::Cuboid => sides.iter().product(),
            Shape::Cylinder(c) => std::f64::consts::PI * c.radius.powi(2) * sides[2],
        };
        size / volume.size().iter().product::<f64>()
    }

    /// Whether the object can be at `p` (mm).
    pub fn holds(&self, p: Vec3) -> bool {
        let within = || (0..3).all(|k| (self.bounds[0][k]..=self.bounds[1][k]).contains(&p[k]));
        match &self.shape {
            Shape::Cells(cells) => cells.at(cells.cell(cells.place(p))),
            Shape::Cuboid => within(),
            Shape::Cylinder(cylinder) => within() && cylinder.holds(p),
        }
    }

    /// Range (mm along the ray) from the first to the last point of the region, including holes in between; `None` if
    /// there is none.
    pub fn clip(&self, ray: &Ray) -> Option<[f64; 2]> {
        let [near, far] = ray.clip(self.bounds)?;
        match &self.shape {
            Shape::Cells(cells) => {
                let forth = cells.first(ray, near, far, 1.0)?;
                // From the other end; it meets at least the cell found above.
                let back = cells.first(ray, far, near, -1.0).unwrap_or(far);
                Some([forth, back.max(forth)])
            }
            Shape::Cuboid => Some([near, far]),
            Shape::Cylinder(cylinder) => {
                let [first, last] = cylinder.clip(ray)?;
                let (near, far) = (near.max(first), far.min(last));
                (near < far).then_some([near, far])
            }
        }
    }
}

impl Cells {
    fn at(&self, cell: [usize; 3]) -> bool {
        let [_, ny, nz] = self.grid.shape;
        self.occupied[(cell[0] * ny + cell[1]) * nz + cell[2]]
    }

    /// The cell at a position in cell units; positions outside are clamped.
    fn cell(&self, p: Vec3) -> [usize; 3] {
        std::array::from_fn(|k| (p[k].max(0.0) as usize).min(self.grid.shape[k] - 1))
    }

    /// A world position in cell units, from the lowest corner.
    fn place(&self, p: Vec3) -> Vec3 {
        let lower = self.grid.bounds()[0];
        std::array::from_fn(|k| (p[k] - lower[k]) / self.grid.spacing[k])
    }

    /// First occupied cell on the way from `t` to `end`, forwards or backwards (Amanatides and Woo 1987).
    fn first(&self, ray: &Ray, t: f64, end: f64, way: f64) -> Option<f64> {
        let direction: Vec3 = std::array::from_fn(|k| way * ray.direction[k] / self.grid.spacing[k]);
        let reach = (end - t) * way;
        let start = self.place(ray.at(t + way * 1e-9 * reach));
        let mut cell = self.cell(start);
        let mut done = 0.0;
        loop {
            if self.at(cell) {
                return Some(t + way * done);
            }
            let (mut axis, mut next) = (0, f64::INFINITY);
            for k in 0..3 {
                if direction[k] != 0.0 {
                    let wall = cell[k] as f64 + if direction[k] > 0.0 { 1.0 } else { 0.0 };
                    let to = (wall - start[k]) / direction[k];
                    if to < next {
                        (axis, next) = (k, to);
                    }
                }
            }
            if next >= reach {
                return None;
            }
            done = next.max(done);
            cell[axis] = if direction[axis] > 0.0 { cell[axis] + 1 } else { cell[axis].checked_sub(1)? };
            if cell[axis] >= self.grid.shape[axis] {
                return None;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{mix, unit};

    fn grid() -> VoxelGrid {
        VoxelGrid { shape: [6, 5, 4], spacing: [10.0, 12.0, 15.0], center: [3.0, -2.0, 1.0] }
    }

    fn random(seed: u64) -> Support {
        let cells = (0..120).map(|i| unit(mix(seed, i)) < 0.06).collect();
        Support::new(grid(), cells).unwrap()
    }

    /// Compares where rays meet a region with the points that it holds, in small steps: `count` random rays from `origin`
    /// of two numbers in ±80.
    fn check_rays(s: &Support, seed: u64, count: u64, origin: fn([f64; 2]) -> Vec3) {
        for i in 0..count {
            let draw = |k: u64| f64::from(unit(mix(seed * 1000 + i, k))) * 2.0 - 1.0;
            let origin = origin([80.0 * draw(1), 80.0 * draw(2)]);
            let towards: Vec3 = std::array::from_fn(|k| 25.0 * draw(3 + k as u64) - origin[k]);
            let length = towards.iter().map(|x| x * x).sum::<f64>().sqrt();
            let ray = Ray { origin, direction: towards.map(|x| x / length) };
            let [near, far] = ray.clip(grid().bounds()).unwrap_or_default();
            let steps = (0..5000).map(|j| f64::from(j) * 0.05).filter(|t| *t > near && *t < far);
            let hits: Vec<f64> = steps.filter(|&t| s.holds(ray.at(t))).collect();
            match (s.clip(&ray), hits.first(), hits.last()) {
                (Some([a, b]), Some(first), Some(last)) => {
                    assert!((a - first).abs() < 0.06 && (b - last).abs() < 0.06, "{a} {first} {b} {last}");
                }
                // A corner cut between two steps.
                (Some([a, b]), None, None) => assert!(b - a < 0.06, "{a} {b}"),
                (found, first, _) => assert!(found.is_none() && first.is_none(), "{found:?} {first:?}"),
            }
        }
    }

    #[test]
    fn rays_are_cut_to_where_cells_are() {
        for seed in 1..30 {
            check_rays(&random(seed), seed, 40, |[x, y]| [x, y, -90.0]);
        }
    }

    #[test]
    fn marked_voxels_are_held_and_blocks_of_them_stay_in_the_volume() {
        let marked = |at: [usize; 3]| at == [1, 2, 3] || at == [5, 4, 0];
        let flags = Array3::from_shape_fn(grid().shape, |(x, y, z)| marked([x, y, z]));
        let support = Support::voxels(&grid(), flags.view()).unwrap();
        for (x, y, z) in ndarray::indices(grid().shape) {
            assert_eq!(support.holds(grid().voxel([x, y, z])), marked([x, y, z]), "{x} {y} {z}");
        }
        assert!(Support::voxels(&grid(), Array3::from_elem(grid().shape, false).view()).is_none());
        // 2²⁴ cells and more: blocks of two voxels along each axis.
        let large = VoxelGrid { shape: [4097, 4097, 1], spacing: [1.0; 3], center: [0.0; 3] };
        let mut flags = Array3::from_elem(large.shape, false);
        flags[[4096, 10, 0]] = true;
        let support = Support::voxels(&large, flags.view()).unwrap();
        assert!(support.holds(large.voxel([4096, 10, 0])) && support.holds(large.voxel([4096, 11, 0])));
        assert!(!support.holds(large.voxel([4096, 12, 0])) && !support.holds(large.voxel([4095, 10, 0])));
        assert_eq!(support.bounds()[1], [large.bounds()[1][0], large.voxel([0, 11, 0])[1] + 0.5, 0.5]);
    }

    /// Against small steps: a cylinder and a box, cut by the volume.
    #[test]
    fn shapes_cut_rays_and_hold_points() {
        let disc = Cylinder { center: [10.0, -5.0], radius: 20.0 };
        let shapes = [
            Support::cylinder(disc, &grid()).unwrap(),
            Support::cuboid([[-10.0, -99.0, -20.0], [20.0, 10.0, 9.0]], &grid()).unwrap(),
        ];
        for (s, share) in shapes.iter().zip([std::f64::consts::PI * 400.0 / 3600.0, 30.0 * 42.0 * 29.0 / 216_000.0]) {
            assert!((s.share(&grid()) - share).abs() < 1e-9, "{}", s.share(&grid()));
            let text = serde_json::to_string(s).unwrap();
            assert_eq!(serde_json::from_str::<Support>(&text).unwrap(), *s, "{text}");
            check_rays(s, 7, 60, |[x, z]| [x, 90.0, 0.75 * z]);
        }
        assert!(Support::cylinder(Cylinder { center: [50.0, -40.0], radius: 15.0 }, &grid()).is_none());
        assert!(Support::cuboid([[40.0; 3], [50.0; 3]], &grid()).is_none());
        for text in [
            "{\"bounds\": [[0, 0, 0], [1, 1, 0]]}",
            "{\"bounds\": [[0, 0, 0], [1, 1, 1]], \"cylinder\": {\"center\": [0, 0], \"radius\": -1}}",
        ] {
            let e = serde_json::from_str::<Support>(text).unwrap_err().to_string();
            assert!(e.contains("expected"), "{e}");
        }
    }

    #[test]
    fn a_support_comes_back_from_its_text() {
        for seed in 1..10 {
            let s = random(seed);
            let text = serde_json::to_string(&s).unwrap();
            assert_eq!(serde_json::from_str::<Support>(&text).unwrap(), s);
        }
        let all = Support::new(grid(), vec![true; 120]).unwrap();
        let text = serde_json::to_string(&all).unwrap();
        assert_eq!(serde_json::from_str::<Support>(&text).unwrap(), all);
        assert!(
            all.bounds()[0].iter().zip(grid().bounds()[0]).all(|(a, b)| (a - b).abs() < 1e-9)
                && (all.share(&grid()) - 1.0).abs() < 1e-9
        );
        for (bad, words) in [("[0,121]", "121 cells"), ("[120]", "no occupied"), ("[4294967295,4294967295]", "cells")] {
            let broken = text.replace("[0,120]", bad);
            let e = serde_json::from_str::<Support>(&broken).unwrap_err().to_string();
            assert!(e.contains(words), "{e}");
        }
    }
}
