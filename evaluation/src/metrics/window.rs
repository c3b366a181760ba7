//! Separable windows over the four fields of an SSIM.
//!
//! SSIM needs the windowed means of `x`, `y`, `x²`, `y²` and `xy`, but the two squares only as a sum: four fields are
//! filtered, not five.

use ndarray::ArrayView1;

/// `x`, `y`, `x² + y²`, `xy`.
pub(crate) const FIELDS: usize = 4;

/// A window of odd size, equal along every axis, whose weights sum to one.
pub(crate) struct SsimWindow {
    weights: Vec<f64>,
    /// Factor from the windowed `E[xy] − E[x]E[y]` to the covariance of the metric.
    covariance: f64,
}

impl SsimWindow {
    /// Gaussian of 11 samples with σ = 1.5; covariances stay biased, as in the original code.
    pub(crate) fn gaussian() -> Self {
        let raw: Vec<f64> = (-5i32..=5).map(|i| (-f64::from(i * i) / (2.0 * 1.5 * 1.5)).exp()).collect();
        let sum: f64 = raw.iter().sum();
        Self { weights: raw.iter().map(|w| w / sum).collect(), covariance: 1.0 }
    }

    /// Uniform 7×7 window with the sample covariance, N/(N−1) for N = 49.
    pub(crate) fn uniform() -> Self {
        Self { weights: vec![1.0 / 7.0; 7], covariance: 49.0 / 48.0 }
    }

    /// Number of samples along an axis.
    pub(crate) fn len(&self) -> usize {
        self.weights.len()
    }

    /// `to[i] = Σ w[t]·from[i + t]` at valid positions, so `to` is shorter by the window size less one.
    pub(crate) fn along_row(&self, from: &[f64], to: &mut [f64]) {
        to.fill(0.0);
        for (t, &w) in self.weights.iter().enumerate() {
            to.iter_mut().zip(&from[t..]).for_each(|(to, &x)| *to += w * x);
        }
    }

    /// `to = Σ w[t]·from(t)`: the same across rows or planes of equal length.
    pub(crate) fn across<'a>(&self, from: impl Fn(usize) -> &'a [f64], to: &mut [f64]) {
        to.fill(0.0);
        for (t, &w) in self.weights.iter().enumerate() {
            to.iter_mut().zip(from(t)).for_each(|(to, &x)| *to += w * x);
        }
    }

    /// Sum of the SSIM map over a row, from the windowed fields.
    pub(crate) fn ssim(&self, fields: [&[f64]; FIELDS], peak: f64) -> f64 {
        let (c1, c2) = ((0.01 * peak).powi(2), (0.03 * peak).powi(2));
        let [x, y, squares, xy] = fields;
        let mut sum = 0.0;
        for (((&mx, &my), &squares), &xy) in x.iter().zip(y).zip(squares).zip(xy) {
            let (mm, m2) = (mx * my, mx * mx + my * my);
            let (cov, var) = (self.covariance * (xy - mm), self.covariance * (squares - m2));
            sum += (2.0 * mm + c1) * (2.0 * cov + c2) / ((m2 + c1) * (var + c2));
        }
        sum
    }
}

/// Writes the four fields of a row of voxels from `pad` on; the rest is left unchanged.
pub(crate) fn products(x: ArrayView1<f32>, y: ArrayView1<f32>, pad: usize, to: &mut [Vec<f64>; FIELDS]) {
    let [tx, ty, squares, xy] = to;
    let to = tx[pad..].iter_mut().zip(&mut ty[pad..]).zip(squares[pad..].iter_mut().zip(&mut xy[pad..]));
    for ((&x, &y), ((tx, ty), (squares, xy))) in x.iter().zip(&y).zip(to) {
        let (x, y) = (f64::from(x), f64::from(y));
        (*tx, *ty, *squares, *xy) = (x, y, x * x + y * y, x * y);
    }
}
