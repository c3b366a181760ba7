//! Where Gaussians begin: at voxels of a first volume.
//!
//! As published, places are drawn among the voxels above a threshold, and a Gaussian is as wide as its three nearest
//! neighbours are away. Densities are then scaled until the mixture has the volume's value at every centre, which the
//! published factor of 0.15 comes to on average.

use super::cells::Cells;
use super::lists::Lists;
use super::shape::{CENTRE, DENSITY, NUMBERS, ROTATION, SCALE, V3, before_softplus, dot};
use super::stage::shapes;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::random::stream;
use conefield_core::scan::Volume;
use conefield_core::scene::Scene;
use rand::seq::index::sample;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Neighbours whose distance is a Gaussian's width.
const NEIGHBOURS: usize = 3;
/// Rounds in which densities are scaled.
const ROUNDS: usize = 5;
/// Of the voxels above 0, the share below the value that a threshold counts by.
const TOP: f64 = 0.995;

/// Settings of the start.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Start {
    /// Gaussians that are drawn, at most as many as voxels are above the threshold.
    pub count: usize,
    /// The value above which a voxel can be drawn, as a share of the 99.5th percentile of the positive voxels.
    pub threshold: f64,
}

impl Default for Start {
    fn default() -> Self {
        Self { count: 50_000, threshold: 0.05 }
    }
}

impl Start {
    /// Refuses numbers that cannot be used.
    pub fn validate(&self, most: usize) -> Result<()> {
        ensure(
            (8..=most).contains(&self.count),
            "spec",
            "count",
            self.count,
            format!("8 to {most}, the places there are"),
        )?;
        let share = (0.0..1.0).contains(&self.threshold);
        ensure(share, "spec", "threshold", self.threshold, "a share from 0 to below 1")
    }

    /// Bytes that it works in for so many voxels.
    pub fn bytes(&self, voxels: u64) -> u64 {
        // The volume, its positive values or the numbers of its voxels, and neighbours with lists.
        12 * voxels + 1024 * self.count as u64
    }

    /// Fills `params` with Gaussians for `volume` (1/mm), each not narrower than `least` and not wider than `widest` cube
    /// sides; returns how many.
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
        let (_, top, _) = positive.select_nth_unstable_by(at, f32::total_cmp);
        let threshold = *top * self.threshold as f32;
        drop(positive);
        let [_, ny, nz] = volume.grid.shape;
        let place = |i: usize| volume.grid.voxel([i / (ny * nz), i / nz % ny, i % nz]);
        let above = |(i, x): (usize, &f32)| (*x > threshold && scene.holds(place(i))).then_some(i as u32);
        let above: Vec<u32> = volume.data.iter().enumerate().filter_map(above).collect();
        if above.len() <= NEIGHBOURS {
            let expected = "more voxels above start.threshold";
            return Err(Error::invalid("start", "volume", format!("{} of them", above.len()), expected));
        }
        let count = self.count.min(above.len());
        let mut drawn: Vec<(u64, V3, f64)> = sample(&mut stream(seed ^ 0x6a05_51a7, 0), above.len(), count)
            .into_iter()
            .map(|i| {
                let voxel = above[i] as usize;
                let p = scene.to_unit(place(voxel)).map(f64::from);
                let (x, y, z) = (voxel / (ny * nz), voxel / nz % ny, voxel % nz);
                (morton(p), p, f64::from(volume.data[[x, y, z]]) / scene.attenuation)
            })
            .collect();
        // What is near in space is near in memory.
        drawn.sort_by(|a, b| a.0.cmp(&b.0).then(a.1[2].total_cmp(&b.1[2])));
        let points: Vec<V3> = drawn.iter().map(|d| d.1).collect();
        let widths = widths(&points);
        for ((p, (_, point, value)), width) in params.chunks_mut(NUMBERS).zip(&drawn).zip(widths) {
            p.fill(0.0);
            p[CENTRE..SCALE].copy_from_slice(&point.map(|x| x as f32));
            p[SCALE..ROTATION].fill(width.clamp(least, widest).ln() as f32);
            p[ROTATION] = 1.0;
            p[DENSITY] = before_softplus(*value) as f32;
        }
        let mut shapes = shapes(&params[..count * NUMBERS]);
        let cells = Cells::new(&shapes);
        for _ in 0..ROUNDS {
            let sums: Vec<f64> = points.par_iter().map(|p| cells.value(&shapes, *p)).collect();
            for ((shape, sum), (_, _, value)) in shapes.iter_mut().zip(sums).zip(&drawn) {
                shape.density *= (value / sum.max(1e-12)).clamp(0.1, 10.0);
            }
        }
        for (p, shape) in params.chunks_mut(NUMBERS).zip(&shapes) {
            p[DENSITY] = before_softplus(shape.density) as f32;
        }
        Ok(count)
    }
}

/// A number that grows along a curve through the unit cube on which neighbours stay close.
fn morton(p: V3) -> u64 {
    let n = p.map(|x| (x * 1024.0).clamp(0.0, 1023.0) as u64);
    (0..10).fold(0, |code, bit| (0..3).fold(code, |code, k| code | (n[k] >> bit & 1) << (3 * bit + k)))
}

/// Of each point, the root mean square distance of its nearest neighbours.
fn widths(points: &[V3]) -> Vec<f64> {
    // About one point in a cell that has some.
    let side = ((4.0 * points.len() as f64).cbrt() as usize).clamp(1, 128);
    let cell = |p: V3| p.map(|x| ((x * side as f64).max(0.0) as usize).min(side - 1));
    let mut lists = Lists::default();
    lists.fill(side.pow(3), points.len(), |i, put| {
        let [x, y, z] = cell(points[i]);
        put((x * side + y) * side + z);
    });
    let near = |(i, p): (usize, &V3)| {
        let at = cell(*p);
        let mut nearest = [f64::INFINITY; NEIGHBOURS];
        for ring in 0..side {
            let range = |k: usize| at[k].saturating_sub(ring)..(at[k] + ring + 1).min(side);
            for x in range(0) {
                for y in range(1) {
                    for z in range(2) {
                        // Cells within the ring were looked at before.
                        let apart = x.abs_diff(at[0]).max(y.abs_diff(at[1])).max(z.abs_diff(at[2]));
                        if apart < ring {
                            continue;
                        }
                        for &j in lists.of((x * side + y) * side + z) {
                            let d: V3 = std::array::from_fn(|k| points[j as usize][k] - p[k]);
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
            // No cell beyond has a nearer one.
            if nearest[NEIGHBOURS - 1].sqrt() <= ring as f64 / side as f64 {
                break;
            }
        }
        let found: Vec<f64> = nearest.into_iter().filter(|d| d.is_finite()).collect();
        (found.iter().sum::<f64>() / found.len().max(1) as f64).sqrt()
    };
    points.par_iter().enumerate().map(near).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widths_are_those_of_all_neighbours() {
        let points: Vec<V3> = (0..300)
            .map(|i| std::array::from_fn(|k| ((i * [7919, 104_729, 1_299_709][k] + 13) % 1000) as f64 / 2500.0))
            .collect();
        for (i, found) in widths(&points).into_iter().enumerate() {
            let apart = |q: &V3| {
                dot(std::array::from_fn(|k| q[k] - points[i][k]), std::array::from_fn(|k| q[k] - points[i][k]))
            };
            let mut all: Vec<f64> = points.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, q)| apart(q)).collect();
            all.sort_by(f64::total_cmp);
            let want = (all[..3].iter().sum::<f64>() / 3.0).sqrt();
            assert!((found - want).abs() < 1e-12, "{i}: {found} {want}");
        }
    }
}
