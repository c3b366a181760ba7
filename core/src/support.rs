//! Where the object can be: cells of a regular grid over the volume, found before training.

use crate::error::{Error, Result};
use crate::geometry::{Ray, Vec3, VoxelGrid};
use serde::{Deserialize, Serialize};

/// Cells that may contain the object; all others are air.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub struct Support {
    /// The cells.
    grid: VoxelGrid,
    /// `[x][y][z]`.
    occupied: Vec<bool>,
    /// The bounding box of the occupied cells, mm.
    bounds: [Vec3; 2],
}

/// File format: lengths of runs of cells, starting with empty ones.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    grid: VoxelGrid,
    runs: Vec<u32>,
}

impl From<Support> for Written {
    fn from(s: Support) -> Self {
        let mut runs = vec![];
        if s.occupied.first() == Some(&true) {
            runs.push(0);
        }
        runs.extend(s.occupied.chunk_by(|a, b| a == b).map(|run| run.len() as u32));
        Self { grid: s.grid, runs }
    }
}

impl TryFrom<Written> for Support {
    type Error = Error;
    fn try_from(w: Written) -> Result<Self> {
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
        Some(Self { bounds: [corner(low), corner(high)], grid, occupied })
    }

    /// The bounding box of the occupied cells, mm.
    pub fn bounds(&self) -> [Vec3; 2] {
        self.bounds
    }

    /// Share of the cells that are occupied.
    pub fn share(&self) -> f64 {
        self.occupied.iter().filter(|o| **o).count() as f64 / self.occupied.len() as f64
    }

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

    /// Whether the object can be at `p` (mm).
    pub fn holds(&self, p: Vec3) -> bool {
        self.at(self.cell(self.place(p)))
    }

    /// Range (mm along the ray) from the first to the last occupied cell, including holes in between; `None` if there
    /// is none.
    pub fn clip(&self, ray: &Ray) -> Option<[f64; 2]> {
        let [near, far] = ray.clip(self.bounds)?;
        let forth = self.first(ray, near, far, 1.0)?;
        // From the other end; it meets at least the cell found above.
        let back = self.first(ray, far, near, -1.0).unwrap_or(far);
        Some([forth, back.max(forth)])
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

    #[test]
    fn rays_are_cut_to_where_cells_are() {
        for seed in 1..30 {
            let s = random(seed);
            for i in 0..40 {
                let draw = |k: u64| f64::from(unit(mix(seed * 1000 + i, k))) * 2.0 - 1.0;
                let origin = [80.0 * draw(1), 80.0 * draw(2), -90.0];
                let towards: Vec3 = std::array::from_fn(|k| 25.0 * draw(3 + k as u64) - origin[k]);
                let length = towards.iter().map(|x| x * x).sum::<f64>().sqrt();
                let ray = Ray { origin, direction: towards.map(|x| x / length) };
                // In small steps.
                let hits: Vec<f64> = (0..4000)
                    .map(|j| f64::from(j) * 0.06)
                    .filter(|&t| ray.clip(grid().bounds()).is_some_and(|[a, b]| t > a && t < b) && s.holds(ray.at(t)))
                    .collect();
                match (s.clip(&ray), hits.first(), hits.last()) {
                    (Some([a, b]), Some(first), Some(last)) => {
                        assert!((a - first).abs() < 0.07 && (b - last).abs() < 0.07, "{a} {first} {b} {last}");
                    }
                    // A corner cut between two steps.
                    (Some([a, b]), None, None) => assert!(b - a < 0.07, "{a} {b}"),
                    (found, first, _) => assert!(found.is_none() && first.is_none(), "{found:?} {first:?}"),
                }
            }
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
            all.bounds()[0].iter().zip(grid().bounds()[0]).all(|(a, b)| (a - b).abs() < 1e-9) && all.share() == 1.0
        );
        for (bad, words) in [("[0,121]", "121 cells"), ("[120]", "no occupied"), ("[4294967295,4294967295]", "cells")] {
            let broken = text.replace("[0,120]", bad);
            let e = serde_json::from_str::<Support>(&broken).unwrap_err().to_string();
            assert!(e.contains(words), "{e}");
        }
    }
}
