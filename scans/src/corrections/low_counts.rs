//! The logarithm of few photons.

use crate::corrections::Correct;
use crate::corrections::smooth::Sums;
use conefield_core::error::{Result, ensure};
use conefield_core::parallel;
use conefield_core::scan::Scan;
use ndarray::{Array2, ArrayViewMut2, Axis};
use serde::{Deserialize, Serialize};

/// Largest distance of averaged neighbours, in pixels.
const FARTHEST: usize = 4;
/// The number of photons comes from the mean within this distance in pixels; a pixel's own noisy count would bias the
/// choice.
const LOOK: usize = 2;

/// Corrects the logarithm of few photons: it is too large on average and very noisy. Each such pixel gets the mean
/// intensity of as many neighbours as together count enough photons, and the logarithm follows (after the idea of
/// Hsieh, Med. Phys. 25(11), 1998: a filter that widens as the signal falls). Pixels with enough photons do not change.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LowCounts {
    /// Photons per pixel in the open beam.
    pub photons: f64,
    /// Sufficient number of photons.
    #[serde(default = "enough")]
    pub enough: f64,
}

fn enough() -> f64 {
    20.0
}

impl Correct for LowCounts {
    fn validate(&self) -> Result<()> {
        let number = |x: f64| (1.0..=1e15).contains(&x);
        ensure(number(self.photons), "spec", "photons", self.photons, "photons per pixel in the open beam, 1 to 1e15")?;
        let fits = number(self.enough) && self.enough < self.photons;
        ensure(fits, "spec", "enough", self.enough, format!("a number of photons from 1 to {}", self.photons))
    }

    fn correct(&self, scan: &mut Scan) -> Result<String> {
        let changed: usize = parallel::map(scan.projections.axis_iter_mut(Axis(0)), |_, v| self.view(v)).iter().sum();
        let share = 100.0 * changed as f64 / scan.projections.len() as f64;
        Ok(format!("{share:.2} % of the values come from fewer than {} photons and include neighbours", self.enough))
    }
}

impl LowCounts {
    /// Corrects a view and returns the number of changed values.
    fn view(&self, mut view: ArrayViewMut2<'_, f32>) -> usize {
        let light = view.mapv(|a| (-a).exp().min(f32::MAX));
        let sums = Sums::of(light.view());
        let mut reach = Array2::<u8>::zeros(view.dim());
        for ((i, j), reach) in reach.indexed_iter_mut() {
            let (sum, n) = sums.around([i, j], LOOK);
            let photons = self.photons * sum / n as f64;
            // (2k + 1)² pixels of this mean count enough.
            let k = 0.5 * ((self.enough / photons.max(1e-9)).sqrt() - 1.0);
            *reach = k.ceil().clamp(0.0, FARTHEST as f64) as u8;
        }
        // Less than half a photon cannot be distinguished from none.
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
