//! Which values an array holds: the first that is not allowed, such as NaN, and the range.

use crate::parallel;
use ndarray::{ArrayBase, Data, Dimension};

/// Numbers per task.
const PART: usize = 1 << 16;

/// The first value of `array` that is not finite, with its index.
pub fn stray<S: Data<Elem = f32>, D: Dimension>(array: &ArrayBase<S, D>) -> Option<(D::Pattern, f32)> {
    first_not(array, |x| x.is_finite())
}

/// The first value of `array` that is not `fine`, with its index.
pub fn first_not<S, D>(array: &ArrayBase<S, D>, fine: impl Fn(f32) -> bool + Sync) -> Option<(D::Pattern, f32)>
where
    S: Data<Elem = f32>,
    D: Dimension,
{
    // Nearly all arrays are fine: a fast pass over the memory says so. Only the slow one knows indices.
    if let Some(values) = array.as_slice_memory_order() {
        let all = |part: &[f32]| part.iter().fold(true, |all, x| all & fine(*x));
        if parallel::map(values.chunks(PART), |_, part| all(part)).into_iter().all(|fine| fine) {
            return None;
        }
    }
    array.indexed_iter().find(|(_, x)| !fine(**x)).map(|(at, x)| (at, *x))
}

/// The least and the largest number of `array`, NaN aside; `[∞, −∞]` if there is none.
pub fn range<S: Data<Elem = f32>, D: Dimension>(array: &ArrayBase<S, D>) -> [f32; 2] {
    let wider = |[low, high]: [f32; 2], x: f32| [low.min(x), high.max(x)];
    let none = [f32::INFINITY, f32::NEG_INFINITY];
    let Some(values) = array.as_slice_memory_order() else { return array.iter().copied().fold(none, wider) };
    let parts = parallel::map(values.chunks(PART), |_, part| part.iter().copied().fold(none, wider));
    parts.into_iter().fold(none, |[low, high], [least, most]| [low.min(least), high.max(most)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array3, s};

    #[test]
    fn the_first_stray_value_is_found_in_any_layout() {
        let mut array = Array3::<f32>::zeros([40, 50, 60]);
        assert_eq!(stray(&array), None);
        array[[7, 9, 30]] = f32::NAN;
        array[[7, 8, 31]] = f32::INFINITY;
        assert_eq!(stray(&array), Some(((7, 8, 31), f32::INFINITY)));
        // The transposed array has another first one.
        assert_eq!(stray(&array.t()).map(|found| found.0), Some((30, 9, 7)));
        assert_eq!(stray(&array.slice(s![..7, .., ..])), None);
        assert_eq!(stray(&array.slice(s![.., ..;2, ..])).map(|found| found.0), Some((7, 4, 31)));
        assert_eq!(first_not(&array, |x| x < 1.0).map(|found| found.0), Some((7, 8, 31)));
    }

    #[test]
    fn the_range_leaves_nan_aside_in_any_layout() {
        assert_eq!(range(&Array3::<f32>::zeros([0, 1, 1])), [f32::INFINITY, f32::NEG_INFINITY]);
        let mut array = Array3::from_shape_fn([40, 50, 60], |(i, j, k)| (i + j + k) as f32 - 7.0);
        array[[0, 0, 1]] = f32::NAN;
        assert_eq!(range(&array), [-7.0, 140.0]);
        assert_eq!(range(&array.slice(s![1.., ..;2, ..])), [-6.0, 139.0]);
        array[[3, 3, 3]] = f32::INFINITY;
        assert_eq!(range(&array), [-7.0, f32::INFINITY]);
    }
}
