//! Where a field is known to be empty: training takes no samples there.

use crate::random::mix;
use crate::stage::Samples;

/// Mixed with a ray's seed, decides whether the ray is a probe.
pub const PROBE: u64 = 0x7072_6f62_6520_7279;

/// Cells of a regular grid over a box of the unit cube, a bit each. Samples in empty cells are left out of a step: the
/// field counts as 0 there. Rays that are probes take all their samples, and so find what has come up in an empty cell.
#[derive(Debug, Clone, PartialEq)]
pub struct Occupancy {
    /// Lowest corner of the box.
    pub low: [f32; 3],
    /// Cells that a side of the cube has room for, along each axis.
    pub per_side: [f32; 3],
    /// Cells along each axis.
    pub shape: [u32; 3],
    /// Cell `[x][y][z]` stands in word `i / 32` at place `i % 32`; 1 where something may be.
    pub bits: Vec<u32>,
    /// One ray in so many is a probe; 0 for none.
    pub probe: u32,
}

impl Occupancy {
    /// Cells of the box between the corners `low` and `high`, `shape` along its axes; `occupied` in the order `[x][y][z]`.
    pub fn new([low, high]: [[f32; 3]; 2], shape: [usize; 3], occupied: &[bool], probe: u32) -> Self {
        debug_assert_eq!(shape.iter().product::<usize>(), occupied.len());
        let word = |bits: &[bool]| bits.iter().enumerate().fold(0, |word, (i, &o)| word | u32::from(o) << i);
        Self {
            low,
            per_side: std::array::from_fn(|k| shape[k] as f32 / (high[k] - low[k])),
            shape: shape.map(|n| n as u32),
            bits: occupied.chunks(32).map(word).collect(),
            probe,
        }
    }

    /// Whether something may be at `p`; outside the box nothing is known.
    pub fn holds(&self, p: [f32; 3]) -> bool {
        let at: [f32; 3] = std::array::from_fn(|k| (p[k] - self.low[k]) * self.per_side[k]);
        if (0..3).any(|k| !(at[k] >= 0.0 && at[k] < self.shape[k] as f32)) {
            return true;
        }
        let [x, y, z] = at.map(|v| v as u32);
        let i = (x * self.shape[1] + y) * self.shape[2] + z;
        self.bits[i as usize / 32] >> (i % 32) & 1 == 1
    }

    /// Whether the ray whose samples stand where `seed` says is a probe.
    pub fn probes(&self, seed: u64) -> bool {
        self.probe > 0 && (mix(seed, PROBE) as u32).is_multiple_of(self.probe)
    }

    /// Leaves out what a ray has in empty cells: of `samples`, those from number `first` on are the ray's. Others keep place
    /// and weight.
    pub fn thin(&self, seed: u64, samples: &mut Samples, first: usize) {
        if self.probes(seed) {
            return;
        }
        let Samples { points, weights } = samples;
        let mut kept = first;
        for i in first..points.len() {
            if self.holds(points[i]) {
                (points[kept], weights[kept]) = (points[i], weights[i]);
                kept += 1;
            }
        }
        points.truncate(kept);
        weights.truncate(kept);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::unit;

    /// 3 × 4 × 5 cells of which every third is occupied.
    fn some(probe: u32) -> Occupancy {
        let occupied: Vec<bool> = (0..60).map(|i| i % 3 == 0).collect();
        Occupancy::new([[0.1, 0.2, 0.0], [0.7, 0.6, 1.0]], [3, 4, 5], &occupied, probe)
    }

    fn draw(i: u64) -> [f32; 3] {
        std::array::from_fn(|k| 1.2 * unit(mix(i, k as u64)) - 0.1)
    }

    #[test]
    fn a_point_is_where_its_cell_is() {
        let o = some(0);
        let mut found = [0; 3];
        for p in (0..5000).map(draw) {
            let cell = |k: usize, low: f32, side: f32, n: i32| {
                let c = ((p[k] - low) / side).floor() as i32;
                (0..n).contains(&c).then_some(c)
            };
            let at = [cell(0, 0.1, 0.2, 3), cell(1, 0.2, 0.1, 4), cell(2, 0.0, 0.2, 5)];
            let want = match at {
                [Some(x), Some(y), Some(z)] => ((x * 4 + y) * 5 + z) % 3 == 0,
                _ => true,
            };
            // Rounding may move what is next to a wall.
            let wall =
                [(0, 5.0, 0.5), (1, 10.0, 0.0), (2, 5.0, 0.0)].iter().any(|&(k, per, shift): &(usize, f32, f32)| {
                    ((p[k] * per - shift) - (p[k] * per - shift).round()).abs() < 1e-4
                });
            assert!(wall || o.holds(p) == want, "{p:?}");
            found[if at.contains(&None) { 0 } else { 1 + usize::from(want) }] += 1;
        }
        assert!(found.iter().all(|&n| n > 200), "{found:?}");
        assert!(o.holds([f32::NAN; 3]), "nothing is known there");
    }

    #[test]
    fn what_is_in_empty_cells_leaves_and_nothing_else() {
        let points: Vec<_> = (0..400).map(draw).collect();
        let weights: Vec<f32> = (0..400).map(|i| i as f32).collect();
        let o = some(4);
        let mut probes = 0;
        for seed in 0..400 {
            let mut samples = Samples { points: points.clone(), weights: weights.clone() };
            o.thin(seed, &mut samples, 100);
            let kept: Vec<usize> = (0..400).filter(|&i| i < 100 || o.probes(seed) || o.holds(points[i])).collect();
            assert_eq!(samples.points, kept.iter().map(|&i| points[i]).collect::<Vec<_>>());
            assert_eq!(samples.weights, kept.iter().map(|&i| weights[i]).collect::<Vec<_>>());
            assert!(kept.len() == 400 || kept.len() < 400 && !o.probes(seed));
            probes += usize::from(o.probes(seed));
        }
        assert!((70..130).contains(&probes), "{probes} of 400 instead of a quarter");
        assert!((0..400).all(|seed| !some(0).probes(seed) && some(1).probes(seed)));
    }
}
