//! Initial Gaussians, at voxels of a first volume.
//!
//! `cells` puts one Gaussian into each cell of the volume. Cells have eight voxels per side at first; the cell whose
//! voxels vary most is halved along each axis until there are enough cells. Neighbours on a lattice whose standard
//! deviation is 0.6 of its spacing add up to a constant within 0.5 %. `random`, as published, draws voxels above a
//! threshold; a Gaussian is as wide as the distance to its three nearest neighbours. Densities are then scaled until
//! the mixture has the volume's value at every centre, which matches the published factor of 0.15 on average.

use super::cells::Cells;
use super::lists::Lists;
use super::shape::{CENTRE, DENSITY, NUMBERS, ROTATION, SCALE, before_softplus};
use super::stage::shapes;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Vec3, dot};
use conefield_core::parallel;
use conefield_core::random::stream;
use conefield_core::scan::Volume;
use conefield_core::scene::Scene;
use rand::seq::index::sample;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// Voxels per side of the first cells.
const LARGEST: usize = 8;
/// Standard deviation of a Gaussian relative to the side of its cell.
const LATTICE: f64 = 0.6;
/// Nearest neighbours that define a Gaussian's width.
const NEIGHBOURS: usize = 3;
/// Rounds of density scaling.
const ROUNDS: usize = 5;
/// Percentile of the positive voxels that the threshold is relative to.
const TOP: f64 = 0.995;

/// Settings of the initial Gaussians.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Start {
    /// Number of Gaussians, at most the number of voxels above the threshold.
    pub count: usize,
    /// Smallest value of a voxel with a Gaussian, as a share of the 99.5th percentile of the positive voxels.
    pub threshold: f64,
    /// Positions of the Gaussians.
    pub sites: Sites,
}

/// Initial positions of Gaussians.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Sites {
    /// In the middle of cells that are small where the volume has detail.
    Cells,
    /// At random voxels (published).
    Random,
}

/// An initial Gaussian: centre, standard deviations, and the volume's value there, in the scale that stages see.
struct Begin {
    centre: Vec3,
    widths: Vec3,
    value: f64,
}

impl Default for Start {
    fn default() -> Self {
        Self { count: 50_000, threshold: 0.05, sites: Sites::Cells }
    }
}

impl Start {
    /// Refuses invalid settings.
    pub fn validate(&self, most: usize) -> Result<()> {
        let expected = format!("8 to {most}, the number of slots");
        ensure((8..=most).contains(&self.count), "spec", "count", self.count, expected)?;
        let share = (0.0..1.0).contains(&self.threshold);
        ensure(share, "spec", "threshold", self.threshold, "a share from 0 to below 1")
    }

    /// Working memory in bytes for this many voxels.
    pub fn bytes(&self, voxels: u64) -> u64 {
        // The volume, its positive values or the indices of its voxels, and neighbours with lists.
        12 * voxels + 1024 * self.count as u64
    }

    /// Fills `params` with Gaussians for `volume` (1/mm), with widths from `least` to `widest` cube sides; returns
    /// their number.
    pub fn fill(
        &self,
        volume: &Volume,
        scene: &Scene,
        seed: u64,
        [least, widest]: [f64; 2],
        params: &mut [f32],
    ) -> Result<usize> {
        let mut positive: Vec<f32> = volume.data.iter().copied().filter(|x| *x > 0.0).collect();
        let expected = "some positive attenuation";
        ensure(!positive.is_empty(), "start", "volume", "no positive voxel", expected)?;
        let at = ((positive.len() - 1) as f64 * TOP) as usize;
        let threshold = *positive.select_nth_unstable_by(at, f32::total_cmp).1 * self.threshold as f32;
        drop(positive);
        let mut begins = match self.sites {
            Sites::Cells => cells(volume, scene, threshold, self.count),
            Sites::Random => self.random(volume, scene, threshold, seed),
        };
        let (found, expected) = (format!("{} of them", begins.len()), "more voxels above start.threshold");
        ensure(begins.len() > NEIGHBOURS, "start", "volume", found, expected)?;
        // Neighbours in space become neighbours in memory.
        begins.sort_by_cached_key(|b| morton(b.centre));
        let count = begins.len();
        for (p, begin) in params.chunks_mut(NUMBERS).zip(&begins) {
            p.fill(0.0);
            for k in 0..3 {
                p[CENTRE + k] = begin.centre[k] as f32;
                p[SCALE + k] = begin.widths[k].clamp(least, widest).ln() as f32;
            }
            p[ROTATION] = 1.0;
            p[DENSITY] = before_softplus(begin.value) as f32;
        }
        let mut shapes = shapes(&params[..count * NUMBERS]);
        let cells = Cells::new(&shapes);
        for _ in 0..ROUNDS {
            let sums: Vec<f64> = parallel::map(&begins, |_, b| cells.value(&shapes, b.centre));
            for ((shape, sum), begin) in shapes.iter_mut().zip(sums).zip(&begins) {
                shape.density *= (begin.value / sum.max(1e-12)).clamp(0.1, 10.0);
            }
        }
        for (p, shape) in params.chunks_mut(NUMBERS).zip(&shapes) {
            p[DENSITY] = before_softplus(shape.density) as f32;
        }
        Ok(count)
    }

    /// Gaussians at random voxels above `threshold` (1/mm).
    fn random(&self, volume: &Volume, scene: &Scene, threshold: f32, seed: u64) -> Vec<Begin> {
        let [_, ny, nz] = volume.grid.shape;
        let voxel = |i: usize| [i / (ny * nz), i / nz % ny, i % nz];
        let place = |i: usize| volume.grid.voxel(voxel(i));
        let above = |(i, x): (usize, &f32)| (*x > threshold && scene.holds(place(i))).then_some(i as u32);
        let above: Vec<u32> = volume.data.iter().enumerate().filter_map(above).collect();
        let drawn = sample(&mut stream(seed ^ 0x6a05_51a7, 0), above.len(), self.count.min(above.len()));
        let voxels: Vec<usize> = drawn.into_iter().map(|i| above[i] as usize).collect();
        let points: Vec<Vec3> = voxels.iter().map(|&i| scene.to_unit(place(i)).map(f64::from)).collect();
        let all = points.iter().zip(widths(&points)).zip(&voxels);
        all.map(|((&centre, width), &i)| Begin {
            centre,
            widths: [width; 3],
            value: f64::from(volume.data[voxel(i)]) / scene.attenuation,
        })
        .collect()
    }
}

/// A cell of voxels, ordered by the variation of its voxels.
#[derive(PartialEq)]
struct Cell {
    /// Sum of squared differences from the mean.
    differing: f64,
    mean: f64,
    first: [usize; 3],
    side: usize,
}

impl Eq for Cell {}

impl Ord for Cell {
    fn cmp(&self, other: &Self) -> Ordering {
        self.differing.total_cmp(&other.differing).then_with(|| other.first.cmp(&self.first))
    }
}

impl PartialOrd for Cell {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// Gaussians in the middle of cells that have a voxel above `threshold` (1/mm), at most `count`.
fn cells(volume: &Volume, scene: &Scene, threshold: f32, count: usize) -> Vec<Begin> {
    let shape = volume.grid.shape;
    let look = |first: [usize; 3], side: usize| -> Option<Cell> {
        let end: [usize; 3] = std::array::from_fn(|k| (first[k] + side).min(shape[k]));
        let (mut n, mut sum, mut square, mut above) = (0.0, 0.0, 0.0, false);
        for x in first[0]..end[0] {
            for y in first[1]..end[1] {
                for z in first[2]..end[2] {
                    let value = volume.data[[x, y, z]];
                    above |= value > threshold && scene.holds(volume.grid.voxel([x, y, z]));
                    let value = f64::from(value.max(0.0));
                    (n, sum, square) = (n + 1.0, sum + value, square + value * value);
                }
            }
        }
        let mean: f64 = sum / n;
        above.then(|| Cell { differing: (square - sum * mean).max(0.0), mean, first, side })
    };
    let cells = |side: usize| -> BinaryHeap<Cell> {
        let corners = |n: usize| (0..n).step_by(side);
        let firsts: Vec<[usize; 3]> = corners(shape[0])
            .flat_map(|x| corners(shape[1]).flat_map(move |y| corners(shape[2]).map(move |z| [x, y, z])))
            .collect();
        parallel::map(firsts, |_, first| look(first, side)).into_iter().flatten().collect()
    };
    let mut side = LARGEST;
    let mut heap = cells(side);
    // A large object has more cells than there may be Gaussians.
    while heap.len() > count.max(1) {
        side *= 2;
        heap = cells(side);
    }
    let mut done = vec![];
    while heap.len() + done.len() + 7 <= count {
        let Some(cell) = heap.pop() else { break };
        if cell.side == 1 || cell.differing == 0.0 {
            done.push(cell);
            continue;
        }
        let side = cell.side / 2;
        for corner in 0..8 {
            let first: [usize; 3] = std::array::from_fn(|k| cell.first[k] + (corner >> k & 1) * side);
            if (0..3).all(|k| first[k] < shape[k]) {
                heap.extend(look(first, side));
            }
        }
    }
    done.extend(heap);
    let (low, spacing) = (volume.grid.voxel([0; 3]), volume.grid.spacing);
    let begin = |cell: Cell| {
        let half = (cell.side as f64 - 1.0) / 2.0;
        let middle = std::array::from_fn(|k| low[k] + (cell.first[k] as f64 + half) * spacing[k]);
        Begin {
            centre: scene.to_unit(middle).map(|x| f64::from(x).clamp(0.0, 1.0)),
            widths: spacing.map(|s| LATTICE * cell.side as f64 * s / scene.side),
            value: cell.mean / scene.attenuation,
        }
    };
    done.into_iter().take(count).filter(|c| c.mean > 0.0).map(begin).collect()
}

/// Morton code of a point in the unit cube: neighbours stay close.
fn morton(p: Vec3) -> u64 {
    let n = p.map(|x| (x * 1024.0).clamp(0.0, 1023.0) as u64);
    (0..10).fold(0, |code, bit| (0..3).fold(code, |code, k| code | (n[k] >> bit & 1) << (3 * bit + k)))
}

/// For each point, the root mean square distance of its nearest neighbours.
fn widths(points: &[Vec3]) -> Vec<f64> {
    // About one point per occupied cell.
    let side = ((4.0 * points.len() as f64).cbrt() as usize).clamp(1, 128);
    let cell = |p: Vec3| p.map(|x| ((x * side as f64).max(0.0) as usize).min(side - 1));
    let mut lists = Lists::default();
    lists.fill(side.pow(3), points.len(), |i, put| {
        let [x, y, z] = cell(points[i]);
        put((x * side + y) * side + z);
    });
    let near = |(i, p): (usize, &Vec3)| {
        let at = cell(*p);
        let mut nearest = [f64::INFINITY; NEIGHBOURS];
        for ring in 0..side {
            let range = |k: usize| at[k].saturating_sub(ring)..(at[k] + ring + 1).min(side);
            for x in range(0) {
                for y in range(1) {
                    for z in range(2) {
                        // Cells within the ring have been visited.
                        let apart = x.abs_diff(at[0]).max(y.abs_diff(at[1])).max(z.abs_diff(at[2]));
                        if apart < ring {
                            continue;
                        }
                        for &j in lists.of((x * side + y) * side + z) {
                            let d: Vec3 = std::array::from_fn(|k| points[j as usize][k] - p[k]);
                            let mut d = dot(d, d);
                            if j as usize != i {
                                nearest.iter_mut().for_each(|n| {
                                    if d < *n {
                                        std::mem::swap(n, &mut d)
                                    }
                                });
                            }
                        }
                    }
                }
            }
            // No cell further out has a nearer point.
            if nearest[NEIGHBOURS - 1].sqrt() <= ring as f64 / side as f64 {
                break;
            }
        }
        let found: Vec<f64> = nearest.into_iter().filter(|d| d.is_finite()).collect();
        (found.iter().sum::<f64>() / found.len().max(1) as f64).sqrt()
    };
    let parts = points.chunks(256).enumerate();
    let widths = |_, (n, part): (usize, &[Vec3])| (n * 256..).zip(part).map(near).collect::<Vec<_>>();
    parallel::map(parts, widths).concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widths_are_those_of_all_neighbours() {
        let points: Vec<Vec3> = (0..300)
            .map(|i| std::array::from_fn(|k| ((i * [7919, 104_729, 1_299_709][k] + 13) % 1000) as f64 / 2500.0))
            .collect();
        for (i, found) in widths(&points).into_iter().enumerate() {
            let apart = |q: &Vec3| {
                dot(std::array::from_fn(|k| q[k] - points[i][k]), std::array::from_fn(|k| q[k] - points[i][k]))
            };
            let mut all: Vec<f64> = points.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, q)| apart(q)).collect();
            all.sort_by(f64::total_cmp);
            let want = (all[..3].iter().sum::<f64>() / 3.0).sqrt();
            assert!((found - want).abs() < 1e-12, "{i}: {found} {want}");
        }
    }
}
