//! Scattered radiation.

use crate::corrections::Correct;
use crate::corrections::smooth::blurred;
use conefield_core::error::{Result, ensure};
use conefield_core::parallel;
use conefield_core::scan::Scan;
use ndarray::{Array2, ArrayView2, ArrayViewMut2, Axis, Zip};
use serde::{Deserialize, Serialize};

/// Iterations of computing the scatter from the corrected intensity. If a fifth of the light is scattered, each
/// iteration reduces the error to a twentieth.
const ROUNDS: usize = 4;
/// Largest share of a pixel's light that counts as scatter.
const MOST: f32 = 0.8;

/// Subtracts scattered light. The scatter of a ray with transmission T = exp(−A) increases with absorption along the
/// ray and decreases with the light that does not get through: as T·A, spread widely over the detector (Ohnesorge,
/// Flohr and Klingenbeck-Regn, Eur. Radiol. 9(3), 1999).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scatter {
    /// Scattered light over T·A, both summed over the detector. A strip of lead between source and object allows a
    /// measurement: all light behind it is scattered.
    pub share: f64,
    /// Standard deviation of its spread, as a share of the detector's wider side in pixels.
    #[serde(default = "width")]
    pub width: f64,
}

fn width() -> f64 {
    0.15
}

impl Correct for Scatter {
    fn validate(&self) -> Result<()> {
        let share = self.share > 0.0 && self.share <= 1.0;
        ensure(share, "spec", "share", self.share, "scattered light over T·A, above 0 and at most 1")?;
        let width = self.width > 0.0 && self.width <= 1.0;
        ensure(width, "spec", "width", self.width, "a share of the detector's wider side, above 0 and at most 1")
    }

    fn correct(&self, scan: &mut Scan) -> Result<String> {
        let sigma = self.width * scan.geometry.detector.into_iter().max().unwrap_or(1) as f64;
        let shares = parallel::map(scan.projections.axis_iter_mut(Axis(0)), |_, v| self.view(v, sigma));
        let most = shares.into_iter().fold(0.0, f32::max);
        Ok(format!("up to {:.1} % of the light of a pixel was scattered", 100.0 * most))
    }
}

impl Scatter {
    /// Subtracts the scatter from a view and returns the largest subtracted share of a pixel's light.
    fn view(&self, mut view: ArrayViewMut2<'_, f32>, sigma: f64) -> f32 {
        let light = view.mapv(|a| (-a).exp().min(f32::MAX));
        let mut scattered = Array2::zeros(light.dim());
        for _ in 0..ROUNDS {
            let straight = straight(light.view(), scattered.view());
            let source = straight.mapv(|t| t * (-t.ln()).max(0.0));
            scattered = blurred(source.view(), sigma);
            scattered.mapv_inplace(|x| x * self.share as f32);
        }
        let mut most = 0.0f32;
        Zip::from(&mut view).and(&light).and(&scattered).for_each(|a, &t, &s| {
            let share = (s / t.max(f32::MIN_POSITIVE)).clamp(0.0, MOST);
            most = most.max(share);
            // Subtracting the logarithm keeps the exact bits of a pixel without scatter.
            *a -= (1.0 - share).ln();
        });
        most
    }
}

/// The light minus the scatter, never 0.
fn straight(light: ArrayView2<'_, f32>, scattered: ArrayView2<'_, f32>) -> Array2<f32> {
    let mut out = light.to_owned();
    Zip::from(&mut out).and(&scattered).for_each(|t, &s| *t = (*t - s).max((1.0 - MOST) * *t).max(f32::MIN_POSITIVE));
    out
}
