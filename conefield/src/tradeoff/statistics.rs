//! Means and correlations.

/// The mean; `None` if a value is missing or there are none.
pub fn mean(values: impl IntoIterator<Item = Option<f64>>) -> Option<f64> {
    let all: Option<Vec<f64>> = values.into_iter().collect();
    all.filter(|a| !a.is_empty()).map(|a| a.iter().sum::<f64>() / a.len() as f64)
}

/// Pearson's correlation, between −1 and 1; `None` if one of the two is constant.
pub fn pearson(a: &[f64], b: &[f64]) -> Option<f64> {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (mean_a, mean_b) = (mean(a), mean(b));
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (a, b) in a.iter().zip(b) {
        let (a, b) = (a - mean_a, b - mean_b);
        (ab, aa, bb) = (ab + a * b, aa + a * a, bb + b * b);
    }
    let r = ab / (aa * bb).sqrt();
    r.is_finite().then(|| r.clamp(-1.0, 1.0))
}

/// Spearman's rank correlation: how well one figure orders things like another, between −1 (reverse order) and 1 (same
/// order); equal values share their mean rank. `None` for fewer than three pairs, or if one of the figures is constant.
pub fn spearman(a: &[f64], b: &[f64]) -> Option<f64> {
    let pairs = a.iter().copied().zip(b.iter().copied()).filter(|(a, b)| !(a.is_nan() || b.is_nan()));
    let (a, b): (Vec<f64>, Vec<f64>) = pairs.unzip();
    if a.len() < 3 { None } else { pearson(&ranks(&a), &ranks(&b)) }
}

/// Ranks from 1.
fn ranks(values: &[f64]) -> Vec<f64> {
    let rank = |x: &f64| {
        let less = values.iter().filter(|y| *y < x).count() as f64;
        let equal = values.iter().filter(|y| *y == x).count() as f64;
        less + (equal + 1.0) / 2.0
    };
    values.iter().map(rank).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mean_needs_every_value() {
        assert_eq!(mean([Some(1.0), Some(4.0)]), Some(2.5));
        assert_eq!(mean([Some(1.0), None]), None);
        assert_eq!(mean([]), None);
    }

    #[test]
    fn pearson_s_correlation_is_known() {
        let ramp: Vec<f64> = (0..=100).map(f64::from).collect();
        let down: Vec<f64> = ramp.iter().map(|x| 3.0 - 0.5 * x).collect();
        assert!((pearson(&ramp, &down).unwrap() + 1.0).abs() < 1e-12);
        assert_eq!(pearson(&ramp, &[2.0; 101]), None);
        assert_eq!(pearson(&[-1.0, 0.0, 1.0], &[1.0, 0.0, 1.0]), Some(0.0));
        assert_eq!(pearson(&[], &[]), None);
    }

    #[test]
    fn spearman_s_correlation_is_known() {
        // The textbook example of ten people's IQ and hours of television: −29/165.
        let iq = [106.0, 100.0, 86.0, 101.0, 99.0, 103.0, 97.0, 113.0, 112.0, 110.0];
        let hours = [7.0, 27.0, 2.0, 50.0, 28.0, 29.0, 20.0, 12.0, 6.0, 17.0];
        assert!((spearman(&iq, &hours).unwrap() + 29.0 / 165.0).abs() < 1e-12);
        let x = [1.0, 2.0, 3.0, 4.0];
        assert_eq!(spearman(&x, &[1.0, 8.0, 27.0, f64::INFINITY]), Some(1.0));
        assert_eq!(spearman(&x, &[-1.0, -2.0, -3.0, -9.0]), Some(-1.0));
        // Ties share a rank: 1, 2.5, 2.5, 4 against 1, 2, 3, 4.
        let tied = spearman(&x, &[1.0, 2.0, 2.0, 3.0]).unwrap();
        assert!((tied - 0.9f64.sqrt()).abs() < 1e-12, "{tied}");
        assert_eq!(spearman(&x, &[5.0; 4]), None);
        assert_eq!(spearman(&x[..2], &x[..2]), None);
        assert_eq!(spearman(&[1.0, f64::NAN, 2.0, 3.0], &[3.0, 1.0, 2.0, 1.0]), Some(-1.0));
    }
}
