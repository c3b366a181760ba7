//! The logarithm of few photons.

use crate::Correct;
use crate::smooth::Sums;
use conefield_core::error::{Result, ensure};
use conefield_core::scan::Scan;
use ndarray::{Array2, ArrayViewMut2, Axis};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// A pixel takes neighbours in that are at most so many pixels away.
const FARTHEST: usize = 4;
/// How many photons there are is read from the mean over so many pixels either way: a pixel's own count would choose itself.
const LOOK: usize = 2;

/// Where few photons arrive, the logarithm of a noisy count is too large on average and its noise is huge. There each pixel takes the mean
/// of as many neighbours' light as together count enough photons, and the logarithm comes after that (Hsieh, Med. Phys. 25(11), 1998,
/// in its idea: a filter that widens as the signal falls). Where enough arrive nothing changes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LowCounts {
    /// Photons a pixel in the open beam.
    pub photons: f64,
    /// Photons that are enough.
    #[serde(default = "enough")]
    pub enough: f64,
}

fn enough() -> f64 {
    20.0
}

impl Correct for LowCounts {
    fn validate(&self) -> Result<()> {
        let number = |x: f64| (1.0..=1e15).contains(&x);
        ensure(number(self.photons), "spec", "photons", self.photons, "photons a pixel in the open beam, 1 to 1e15")?;
        let fits = number(self.enough) && self.enough < self.photons;
        ensure(fits, "spec", "enough", self.enough, format!("a number of photons from 1 to {}", self.photons))
    }

    fn correct(&self, scan: &mut Scan) -> Result<String> {
        let views = scan.projections.axis_iter_mut(Axis(0)).into_par_iter();
        let changed: usize = views.map(|v| self.view(v)).collect::<Vec<_>>().iter().sum();
        let share = 100.0 * changed as f64 / scan.projections.len() as f64;
        Ok(format!("{share:.2} % of the values come from fewer than {} photons and took neighbours in", self.enough))
    }
}

impl LowCounts {
    /// Corrects a view; how many values changed.
    fn view(&self, mut view: ArrayViewMut2<'_, f32>) -> usize {
        let light = view.mapv(|a| (-a).exp().min(f32::MAX));
        let sums = Sums::of(light.view());
        let mut reach = Array2::<u8>::zeros(view.dim());
        for ((i, j), reach) in reach.indexed_iter_mut() {
            let (sum, n) = sums.around([i, j], LOOK);
            let photons = self.photons * sum / n as f64;
            // (2k + 1)² pixels with these count enough.
            let k = 0.5 * ((self.enough / photons.max(1e-9)).sqrt() - 1.0);
            *reach = k.ceil().clamp(0.0, FARTHEST as f64) as u8;
        }
        // Less than half a photon is not told from none.
        let least = 0.5 / self.photons;
        let mut changed = 0;
        for (at, x) in view.indexed_iter_mut() {
            let k = usize::from(reach[at]);
            if k > 0 {
                let (sum, n) = sums.around([at.0, at.1], k);
                *x = -(sum / n as f64).max(least).ln() as f32;
                changed += 1;
            }
        }
        changed
    }
}
