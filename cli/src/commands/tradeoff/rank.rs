//! Spearman's rank correlation: how well one figure puts things into the order of another.

/// Between −1 (the reverse order) and 1 (the same); equal values share their mean rank. None of fewer than three pairs, or
/// where one of the figures is the same for all.
pub fn spearman(a: &[f64], b: &[f64]) -> Option<f64> {
    let pairs: Vec<(f64, f64)> =
        a.iter().copied().zip(b.iter().copied()).filter(|(a, b)| !(a.is_nan() || b.is_nan())).collect();
    if pairs.len() < 3 {
        return None;
    }
    let (a, b): (Vec<f64>, Vec<f64>) = pairs.into_iter().unzip();
    let (a, b) = (ranks(&a), ranks(&b));
    let mean = (a.len() as f64 + 1.0) / 2.0;
    let product = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| (x - mean) * (y - mean)).sum::<f64>();
    let scale = (product(&a, &a) * product(&b, &b)).sqrt();
    (scale > 0.0).then(|| (product(&a, &b) / scale).clamp(-1.0, 1.0))
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
    fn known_values_come_out() {
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
