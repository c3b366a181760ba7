//! Estimates the noise of a scan from the scan alone.

use conefield_core::data_term::{DataTerm, Misfit};
use conefield_core::error::Result;
use conefield_core::parallel;
use conefield_core::scan::{ScanHeader, high};
use conefield_core::wgsl::Fragment;
use ndarray::ArrayView3;
use rayon::slice::ParallelSliceMut;

/// Approximate number of pixels used.
const LOOKED_AT: usize = 4 << 20;
/// Groups of equal size, from low to high line integrals.
const GROUPS: usize = 16;

/// Noise of line integrals `p` with the variance `sigma²·exp(growth·p)`. The logarithm of Poisson counts has a growth
/// of 1 (the variance of `−ln(I/I₀)` is about `1/I = exp(p)/I₀`).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Standard deviation at `p = 0`.
    pub sigma: f64,
    /// Growth of the variance with the line integral, 0 or more.
    pub growth: f64,
}

impl std::fmt::Display for Noise {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "noise of {:.3e} in line integrals", self.sigma)?;
        if self.growth > 0.0 {
            write!(f, " near 0, variance growing as exp({:.2}·p)", self.growth)?;
        }
        Ok(())
    }
}

impl Noise {
    /// Estimates the noise where rays meet the object: second differences along rows contain little else, and edges
    /// hardly change the median of their absolute values. For white noise `p[-1] − 2p[0] + p[1]` has the variance 6σ².
    /// Noise that is correlated between pixels is underestimated. `growing` also fits the growth: a line through the
    /// logarithms of the groups' variances.
    pub fn of(measured: ArrayView3<'_, f32>, growing: bool) -> Self {
        let mut all = differences(measured);
        if all.is_empty() {
            return Self { sigma: 0.0, growth: 0.0 };
        }
        all.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let size = all.len().div_ceil(if growing { GROUPS } else { 1 });
        let points: Vec<[f64; 2]> = all
            .chunks_mut(size)
            .map(|group| {
                let level = group[group.len() / 2].0;
                let (_, middle, _) = group.select_nth_unstable_by(group.len() / 2, |a, b| a.1.total_cmp(&b.1));
                // The median of |x| of a normal distribution is 0.6745 standard deviations.
                let sigma = f64::from(middle.1) / 0.674_489_750_196_081_7 / 6f64.sqrt();
                [f64::from(level), sigma]
            })
            .collect();
        line(&points)
    }

    /// Multiplies values by powers of the weights `exp(−growth·p)`, at most 1: inverse variances up to a factor.
    /// Returns `Σ w·y²`.
    fn weigh(&self, power: f64, measured: &[f32], y: &mut [f32]) -> f64 {
        let rate = (power * self.growth) as f32;
        let mut sum = 0.0;
        for (y, p) in y.iter_mut().zip(measured) {
            let weighted = if rate > 0.0 { *y * (-rate * p.max(0.0)).exp() } else { *y };
            sum += f64::from(weighted) * f64::from(*y);
            *y = weighted;
        }
        sum
    }
}

/// Weighted least squares. If the noise does not grow, all weights are 1.
impl Misfit for Noise {
    fn differentiate(&self, _: usize, measured: &[f32], residuals: &mut [f32]) -> f64 {
        0.5 * self.weigh(1.0, measured, residuals)
    }

    fn curve(&self, _: usize, measured: &[f32], values: &mut [f32]) {
        self.weigh(1.0, measured, values);
    }

    /// Noise of the variance `sigma²/w` has the standard deviation `sigma·√w` after weighting.
    fn spread(&self, _: usize, measured: &[f32], values: &mut [f32]) {
        self.weigh(0.5, measured, values);
    }

    fn wgsl(&self) -> Option<Fragment> {
        Some(Fragment::new(&[
            &format!("const stage_growth: f32 = {:?};", self.growth as f32),
            include_str!("noise.wgsl"),
        ]))
    }

    fn noise(&self) -> f64 {
        self.sigma
    }

    fn describe(&self) -> String {
        self.to_string()
    }
}

/// The data term of squared residuals, with weights by the scan's noise.
pub(super) struct Squares {
    /// Whether the noise may grow with the line integral; if not, all weights are 1.
    pub(super) growing: bool,
    pub(super) text: &'static str,
}

impl DataTerm for Squares {
    fn of(&self, measured: ArrayView3<'_, f32>) -> Result<Box<dyn Misfit>> {
        Ok(Box::new(Noise::of(measured, self.growing)))
    }

    fn scratch(&self, header: &ScanHeader) -> u64 {
        scratch(header)
    }

    fn describe(&self) -> String {
        self.text.into()
    }
}

/// Bytes that [`Noise::of`] needs: pairs of numbers, in lists and then in one.
pub fn scratch(header: &ScanHeader) -> u64 {
    2 * 8 * header.pixels().min(2 * LOOKED_AT as u64)
}

/// Values and absolute second differences of pixels within the object.
fn differences(measured: ArrayView3<'_, f32>) -> Vec<(f32, f32)> {
    let top = measured.iter().fold(0.0f32, |m, &x| m.max(x));
    // Outside the object negative noise is often clipped. A bad pixel or metal does not count as the object.
    let typical = high(measured);
    let least = 0.1 * if typical > 0.0 { top.min(2.0 * typical) } else { top };
    let every = measured.len().div_ceil(LOOKED_AT).max(1);
    let view = |n: usize, view: ndarray::ArrayView2<'_, f32>| {
        let mut found = vec![];
        for row in view.rows() {
            for c in (1 + n % every..row.len().saturating_sub(1)).step_by(every) {
                let [a, b, c] = [row[c - 1], row[c], row[c + 1]];
                if a > least && b > least && c > least {
                    found.push(((a + b + c) / 3.0, (a - 2.0 * b + c).abs()));
                }
            }
        }
        found
    };
    parallel::map(measured.outer_iter(), view).concat()
}

/// The least-squares line through `ln σ²` over the line integral; constant if it would fall.
fn line(points: &[[f64; 2]]) -> Noise {
    let seen: Vec<[f64; 2]> = points.iter().filter(|p| p[1] > 0.0).map(|p| [p[0], 2.0 * p[1].ln()]).collect();
    let n = seen.len().max(1) as f64;
    let mean: [f64; 2] = std::array::from_fn(|k| seen.iter().map(|p| p[k]).sum::<f64>() / n);
    let [square, product] = [0, 1].map(|k| seen.iter().map(|p| (p[0] - mean[0]) * (p[k] - mean[k])).sum::<f64>());
    if 2 * seen.len() <= points.len() {
        // Most pixels are exactly equal to their neighbours: there is no noise.
        return Noise { sigma: 0.0, growth: 0.0 };
    }
    let growth = if square > 0.0 { (product / square).max(0.0) } else { 0.0 };
    Noise { sigma: (0.5 * (mean[1] - growth * mean[0])).exp(), growth }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::random::stream;
    use ndarray::Array3;
    use rand_distr::{Distribution, Normal};

    /// A hill of line integrals up to 3 with noise of standard deviation `sigma(p)`.
    fn hill(sigma: impl Fn(f64) -> f64) -> Array3<f32> {
        let mut rng = stream(5, 0);
        let normal = Normal::new(0.0, 1.0).unwrap();
        let mut projections = Array3::zeros((4, 128, 256));
        for ((_, _, c), x) in projections.indexed_iter_mut() {
            let p = 3.0 * (std::f64::consts::PI * c as f64 / 255.0).sin();
            *x = (p + sigma(p) * normal.sample(&mut rng)) as f32;
        }
        projections
    }

    #[test]
    fn the_law_of_the_noise_is_found() {
        let found = Noise::of(hill(|p| 0.01 * (0.5 * p).exp()).view(), true);
        assert!((found.sigma / 0.01 - 1.0).abs() < 0.1 && (found.growth - 1.0).abs() < 0.05, "{found:?}");
        let found = Noise::of(hill(|_| 0.02).view(), true);
        assert!((found.sigma / 0.02 - 1.0).abs() < 0.1 && found.growth < 0.05, "{found:?}");
        let found = Noise::of(hill(|_| 0.02).view(), false);
        assert!((found.sigma / 0.02 - 1.0).abs() < 0.05 && found.growth == 0.0, "{found:?}");
    }

    #[test]
    fn without_noise_little_is_found() {
        let found = Noise::of(hill(|_| 0.0).view(), true);
        assert!(found.sigma < 1e-3, "{found:?}");
        let mut flat = hill(|_| 0.0);
        flat.fill(0.0);
        assert_eq!(Noise::of(flat.view(), true), Noise { sigma: 0.0, growth: 0.0 });
        flat.fill(1.0);
        assert_eq!(Noise::of(flat.view(), true), Noise { sigma: 0.0, growth: 0.0 });
    }
}
