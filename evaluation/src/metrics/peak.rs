//! The default data range of scores.

use conefield_core::finite::range;
use ndarray::ArrayView3;

/// Minimum of the largest value of volumes normalized to `[0, 1]`.
const REACH: f32 = 0.5;

/// The data range of `reference`: 1 if its values lie in `[0, 1]` and exceed ½, as for normalized volumes; otherwise
/// the difference of its largest and smallest value (1/mm, Hounsfield units). 1 if all values are equal.
pub fn peak_of(reference: ArrayView3<f32>) -> f64 {
    let [low, high] = range(&reference);
    // Tolerance for interpolation and rounding beyond the ends.
    let unit = low >= -1e-3 && high <= 1.0 + 1e-3 && high > REACH;
    let range = f64::from(high) - f64::from(low);
    if unit || !(range > 0.0 && range.is_finite()) { 1.0 } else { range }
}

/// The factor that brings `result` nearest to `reference`, if the two are similar except for a factor of more than 3
/// either way: most likely they have different units.
pub fn other_unit(result: ArrayView3<f32>, reference: ArrayView3<f32>) -> Option<f64> {
    let (mut both, mut own, mut other) = (0.0f64, 0.0f64, 0.0f64);
    for (&a, &b) in result.iter().zip(reference) {
        let (a, b) = (f64::from(a), f64::from(b));
        (both, own, other) = (both + a * b, own + a * a, other + b * b);
    }
    let factor = both / own;
    let alike = both / (own * other).sqrt() > 0.8;
    (alike && factor.is_finite() && !(1.0 / 3.0..=3.0).contains(&factor)).then_some(factor)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    fn ramp(low: f32, high: f32) -> Array3<f32> {
        Array3::from_shape_fn((4, 4, 4), |(x, y, z)| low + (high - low) * (x + 4 * y + 16 * z) as f32 / 63.0)
    }

    #[test]
    fn the_range_is_that_of_the_reference() {
        for (low, high, peak) in [
            (0.0, 1.0, 1.0),
            (0.0, 0.7, 1.0),
            (0.0, 1.0005, 1.0),
            (0.0, 0.04, 0.04),
            (0.01, 0.04, 0.03),
            (-1000.0, 2000.0, 3000.0),
            (0.0, 12.0, 12.0),
            (-1.0, 1.0, 2.0),
        ] {
            let found = peak_of(ramp(low, high).view());
            assert!((found / peak - 1.0).abs() < 1e-5, "{low} to {high}: {found}");
        }
        assert_eq!(peak_of(Array3::from_elem((2, 2, 2), 7.0).view()), 1.0);
    }

    #[test]
    fn values_far_beyond_the_range_have_no_ssim() {
        let of = |x: f32| Array3::from_elem((12, 12, 12), x);
        let scores = crate::metrics::evaluate(of(1e20).view(), of(-1e20).view(), 1.0).unwrap();
        assert_eq!([scores.ssim_2d, scores.ssim_3d, scores.ssim_skimage], [None; 3]);
        assert!(scores.missing["ssim_3d"].contains("data range"), "{:?}", scores.missing);
        let near = crate::metrics::evaluate(of(1.0).view(), of(-1.0).view(), 1.0).unwrap();
        assert!(near.ssim_3d.is_some_and(|s| s < -0.9), "{near:?}");
    }

    #[test]
    fn another_unit_is_reported_and_a_poor_result_is_not_mistaken_for_one() {
        let truth = ramp(0.0, 1.0);
        let scaled = |k: f32| truth.mapv(|x| k * x);
        let found = other_unit(scaled(0.02).view(), truth.view()).unwrap();
        assert!((found - 50.0).abs() < 1e-3, "{found}");
        assert!(other_unit(scaled(1000.0).view(), truth.view()).is_some());
        assert!(other_unit(scaled(0.9).view(), truth.view()).is_none());
        assert!(other_unit(Array3::zeros((4, 4, 4)).view(), truth.view()).is_none());
        let noise = Array3::from_shape_fn((4, 4, 4), |(x, y, z)| if (x + y + z) % 2 == 0 { 9.0 } else { -9.0 });
        assert!(other_unit(noise.view(), truth.view()).is_none());
    }
}
