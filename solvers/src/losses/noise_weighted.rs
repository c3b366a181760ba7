//! Half the squared difference, weighted by the inverse noise variance of the measured value.

use conefield_core::prelude::*;

/// Settings of `noise-weighted`: there are none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NoiseWeighted {}

conefield_core::stage_type!(
    LossSpec,
    "noise-weighted",
    NoiseWeighted,
    "half the squared difference divided by the noise variance of the measured value"
);

impl LossSpec for NoiseWeighted {
    fn build(&self) -> Result<Box<dyn Loss>> {
        Ok(Box::new(Weighted { growth: 0.0, factor: 1.0 }))
    }
}

/// The weight of a measured value `p` is `factor·exp(−growth·p)`, for negative ones `factor`. Before the loss is fitted
/// to a scan, every weight is 1.
struct Weighted {
    growth: f64,
    factor: f64,
}

impl Weighted {
    fn weight(&self, measured: f64) -> f64 {
        self.factor * (-self.growth * measured.max(0.0)).exp()
    }
}

impl Loss for Weighted {
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64) {
        let (d, weight) = (predicted - measured, self.weight(measured));
        (weight * (0.5 * d * d), weight * d)
    }

    fn wgsl(&self) -> Option<Fragment> {
        let [growth, factor] = [self.growth as f32, self.factor as f32];
        Some(Fragment::new(&[&format!(
            "fn stage_at(predicted: f32, measured: f32) -> vec2<f32> {{
    let d = predicted - measured;
    let weight = f32({factor:?}) * exp(-f32({growth:?}) * max(measured, 0.0));
    return vec2<f32>(weight * (0.5 * d * d), weight * d);
}}
"
        )]))
    }

    fn needs_scan(&self) -> bool {
        true
    }

    /// Normalizes the weights to a mean of 1 over the training data, so that learning rates keep their meaning.
    fn fitted(&self, noise: &NoiseModel<'_>) -> Option<Box<dyn Loss>> {
        let inverse = Self { growth: noise.growth, factor: 1.0 };
        let sum: f64 = noise.measured.iter().map(|&p| inverse.weight(p)).sum();
        let mean = sum / noise.measured.len() as f64;
        let factor = if mean > 0.0 { 1.0 / mean } else { 1.0 };
        Some(Box::new(Self { factor, ..inverse }))
    }

    fn describe(&self) -> String {
        if self.growth > 0.0 {
            return format!("noise-weighted, {:.3} times exp(-{:.3} p)", self.factor, self.growth);
        }
        "noise-weighted, fitted to the noise of the scan".into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_have_a_mean_of_one_and_fall_with_the_noise() {
        let loss = NoiseWeighted {}.build().unwrap();
        assert_eq!(loss.at(2.0, 1.0), (0.5, 1.0));
        assert!(loss.needs_scan());
        let measured: Vec<f64> = (0..100).map(|i| 0.03 * f64::from(i) - 0.1).collect();
        let fitted = loss.fitted(&NoiseModel { sigma: 0.01, growth: 0.8, measured: &measured }).unwrap();
        let weight = |p: f64| fitted.at(p + 1.0, p).1;
        let mean = measured.iter().map(|&p| weight(p)).sum::<f64>() / 100.0;
        assert!((mean - 1.0).abs() < 1e-12, "{mean}");
        assert!((weight(1.0) / weight(2.0) - 0.8f64.exp()).abs() < 1e-12);
        assert_eq!(weight(-1.0), weight(0.0));
    }

    #[test]
    fn a_scan_without_noise_gives_plain_squares() {
        let loss = NoiseWeighted {}.build().unwrap();
        for measured in [&[0.3, 0.4][..], &[]] {
            let fitted = loss.fitted(&NoiseModel { sigma: 0.0, growth: 0.0, measured }).unwrap();
            assert_eq!(fitted.at(3.0, 1.0), (2.0, 2.0));
        }
    }
}
