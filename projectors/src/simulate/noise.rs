//! Photon counting noise of line integrals.

use conefield_core::error::{Error, Result, ensure};
use conefield_core::finite::range;
use conefield_core::parallel;
use ndarray::{Array3, ArrayViewMut2, Axis};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal, Poisson};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The smallest count of a pixel, so that every logarithm is finite: half a photon, between "none" and "one".
pub const MIN_COUNT: f64 = 0.5;

/// Noise of a detector. Written `none`, `tigre:1e4,10` or `poisson:1e5`, in files as on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum DetectorNoise {
    /// Exact line integrals.
    #[default]
    None,
    /// The noise of published synthetic scans: `I = i0·exp(-A/Amax)` with `Amax` the largest line integral of the scan,
    /// `I ← Poisson(I) + N(0, sigma)`, `A ← -ln(I/i0)·Amax`, negative `A` set to 0; counts below [`MIN_COUNT`] are
    /// raised to it. A scan without a positive line integral is unchanged.
    Tigre {
        /// Photons per pixel without an object.
        i0: f64,
        /// Standard deviation of the read-out noise, in photons.
        sigma: f64,
    },
    /// Beer-Lambert: `I = i0·exp(-A)`, `I ← Poisson(I)`, `A ← -ln(I/i0)`; counts below [`MIN_COUNT`] are raised to it.
    /// Negative `A` are kept: otherwise the mean of an empty background would be above 0.
    Poisson {
        /// Photons per pixel without an object.
        i0: f64,
    },
}

impl DetectorNoise {
    /// Adds the noise to `[view, row, column]` line integrals. Each view has its own random stream, so its noise
    /// depends neither on threads nor on other views.
    pub fn add(&self, projections: &mut Array3<f32>, seed: u64) {
        // Scale of A, photons, read-out noise, smallest value.
        let (scale, i0, sigma, least) = match *self {
            Self::None => return,
            Self::Tigre { i0, sigma } => {
                let largest = range(projections)[1].max(0.0);
                (f64::from(largest), i0, sigma, 0.0)
            }
            Self::Poisson { i0 } => (1.0, i0, 0.0, f64::NEG_INFINITY),
        };
        if scale <= 0.0 {
            return;
        }
        let detector = Detector { scale, i0, sigma, least };
        parallel::over(projections.axis_iter_mut(Axis(0)), |view, pixels| {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            random.set_stream(view as u64);
            detector.read(pixels, &mut random);
        });
    }

    /// Refuses invalid photon numbers.
    pub fn validate(&self, place: &str) -> Result<()> {
        // Beyond 1e15 photons per pixel, noise is below the rounding of an f32 line integral.
        let photons =
            |i0: f64| ensure((1.0..=1e15).contains(&i0), place, "noise: photons i0", i0, "a number from 1 to 1e15");
        match *self {
            Self::None => Ok(()),
            Self::Poisson { i0 } => photons(i0),
            Self::Tigre { i0, sigma } => {
                photons(i0)?;
                let ok = sigma.is_finite() && sigma >= 0.0;
                ensure(ok, place, "noise: sigma", sigma, "a finite number of photons, 0 or more")
            }
        }
    }
}

/// The count where no distribution can be drawn from: 0 for a mean of 0, the mean itself above 1.8e19, where its noise is
/// below 1e-9 of it. An infinite mean makes the line integral infinite, and the scan is refused.
fn certain(mean: f64) -> f64 {
    if mean > 1.0 { mean } else { 0.0 }
}

struct Detector {
    scale: f64,
    i0: f64,
    sigma: f64,
    least: f64,
}

impl Detector {
    fn read(&self, mut pixels: ArrayViewMut2<f32>, random: &mut ChaCha8Rng) {
        // `None` only for numbers that `validate` refuses: no noise is drawn then.
        let read_out = if self.sigma > 0.0 { Normal::new(0.0, self.sigma).ok() } else { None };
        pixels.mapv_inplace(|a| {
            let expected = self.i0 * (-f64::from(a) / self.scale).exp();
            let mut count = Poisson::new(expected).map_or_else(|_| certain(expected), |p| p.sample(random));
            if let Some(read_out) = &read_out {
                count += read_out.sample(random);
            }
            let a = -(count.max(MIN_COUNT) / self.i0).ln() * self.scale;
            a.max(self.least) as f32
        });
    }
}

impl fmt::Display for DetectorNoise {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::None => write!(f, "none"),
            Self::Tigre { i0, sigma } => write!(f, "tigre:{i0},{sigma}"),
            Self::Poisson { i0 } => write!(f, "poisson:{i0}"),
        }
    }
}

impl FromStr for DetectorNoise {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let wrong = || {
            Error::invalid(
                "noise",
                "value",
                format!("`{text}`"),
                "`none`, `tigre:PHOTONS,SIGMA` (as tigre:1e4,10) or `poisson:PHOTONS` (as poisson:1e5)",
            )
        };
        let number = |s: &str| s.trim().parse::<f64>().map_err(|_| wrong());
        let noise = match text.trim().split_once(':') {
            None if text.trim() == "none" => Self::None,
            Some(("tigre", numbers)) => {
                let (i0, sigma) = numbers.split_once(',').ok_or_else(wrong)?;
                Self::Tigre { i0: number(i0)?, sigma: number(sigma)? }
            }
            Some(("poisson", i0)) => Self::Poisson { i0: number(i0)? },
            _ => return Err(wrong()),
        };
        noise.validate("noise")?;
        Ok(noise)
    }
}

impl TryFrom<String> for DetectorNoise {
    type Error = Error;

    fn try_from(text: String) -> Result<Self> {
        text.parse()
    }
}

impl From<DetectorNoise> for String {
    fn from(noise: DetectorNoise) -> Self {
        noise.to_string()
    }
}
