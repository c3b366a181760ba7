//! Light that did not come straight.

use crate::Correct;
use crate::smooth::blurred;
use conefield_core::error::{Result, ensure};
use conefield_core::scan::Scan;
use ndarray::{Array2, ArrayView2, ArrayViewMut2, Axis, Zip};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Times that the scatter is computed anew from what is left without it. Each is a twentieth as far from the end as the one before, where a
/// fifth of the light is scattered.
const ROUNDS: usize = 4;
/// No more than this share of the light of a pixel is taken for scatter.
const MOST: f32 = 0.8;

/// What a ray of transmission T = exp(−A) scatters grows with the rays that are absorbed on the way and falls with those that do not come
/// through: as T·A, spread widely over the detector (Ohnesorge, Flohr and Klingenbeck-Regn, Eur. Radiol. 9(3), 1999). That is taken off the light.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scatter {
    /// Scattered light over T·A, both summed over the detector. A strip of lead on the source's side of the object shows it: all
    /// light behind it is scattered.
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
        let views = scan.projections.axis_iter_mut(Axis(0)).into_par_iter();
        let most = views.map(|v| self.view(v, sigma)).collect::<Vec<f32>>().into_iter().fold(0.0, f32::max);
        Ok(format!("up to {:.1} % of the light of a pixel was scattered", 100.0 * most))
    }
}

impl Scatter {
    /// Takes the scatter off a view; the largest share of a pixel's light that was taken off.
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
            // Not through the light: a pixel without scatter keeps its bits.
            *a -= (1.0 - share).ln();
        });
        most
    }
}

/// The light without what is scattered, never 0.
fn straight(light: ArrayView2<'_, f32>, scattered: ArrayView2<'_, f32>) -> Array2<f32> {
    let mut out = light.to_owned();
    Zip::from(&mut out).and(&scattered).for_each(|t, &s| *t = (*t - s).max((1.0 - MOST) * *t).max(f32::MIN_POSITIVE));
    out
}
