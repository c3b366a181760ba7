//! Medians and quantiles of values.

use conefield_core::scan::sample;
use ndarray::{ArrayView2, ArrayView3};

/// About a million values of `projections` (`[view, row, column]`), ascending.
pub(crate) fn sorted_sample(projections: ArrayView3<'_, f32>) -> Vec<f32> {
    let mut sample = sample(projections);
    sample.sort_unstable_by(f32::total_cmp);
    sample
}

/// The median of an image; 0 if it has no pixels.
pub(crate) fn middle(image: ArrayView2<'_, f32>) -> f32 {
    median(&mut image.iter().copied().collect::<Vec<_>>()).unwrap_or(0.0)
}

/// The median, or `None` for no values. For an even number, the mean of the middle two.
pub fn median(values: &mut [f32]) -> Option<f32> {
    let (n, middle) = (values.len(), values.len() / 2);
    if n == 0 {
        return None;
    }
    let (below, upper, _) = values.select_nth_unstable_by(middle, f32::total_cmp);
    let lower = if n.is_multiple_of(2) { below.iter().copied().max_by(f32::total_cmp) } else { None };
    Some(f32::midpoint(lower.unwrap_or(*upper), *upper))
}

/// The value below which `share` of the `sorted` values lie.
pub fn quantile(sorted: &[f32], share: f64) -> Option<f32> {
    let last = sorted.len().checked_sub(1)?;
    sorted.get((share * last as f64).round() as usize).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_list_has_no_median_and_no_quantile() {
        assert_eq!((median(&mut []), quantile(&[], 0.5)), (None, None));
        assert_eq!((median(&mut [3.0, 1.0, 2.0, 4.0]), quantile(&[1.0, 2.0, 5.0], 0.5)), (Some(2.5), Some(2.0)));
    }
}
