//! Detection of bad pixels, in flat and dark fields and as persistent outliers.

use crate::diagnosis::quantiles::{middle, quantile};
use ndarray::{Array2, ArrayView2, ArrayView3, Axis};

/// A pixel whose response is below this share of the median response is dead.
const DEAD: f32 = 0.1;
/// A pixel whose response exceeds this multiple of the median response is hot.
const HOT: f32 = 3.0;
/// A pixel whose dark value exceeds the median dark value by this share of the median response is hot.
const HOT_DARK: f32 = 0.5;
/// An outlier differs from the two middle ones of its neighbours by this many robust standard deviations of that
/// difference ...
const DEVIATIONS: f32 = 8.0;
/// ... and by this share of the range of the line integrals, ...
const SHARE_OF_RANGE: f32 = 0.1;
/// ... in this share of the views examined, of which there must be some.
const SHARE_OF_VIEWS: f64 = 0.9;
const LEAST_VIEWS: usize = 5;
const MOST_VIEWS: usize = 32;

/// Finds pixels that hardly respond to the open beam or are far brighter than the others. `response` is flat − dark (or
/// a substitute), `dark` the dark field; both `[row, column]`.
pub fn from_fields(response: Option<ArrayView2<f32>>, dark: Option<ArrayView2<f32>>, open: f32) -> Vec<[usize; 2]> {
    let typical = response.map_or(open, middle);
    let mut bad = Vec::new();
    if let Some(r) = response {
        let odd = r.indexed_iter().filter(|(_, x)| !(DEAD * typical..=HOT * typical).contains(*x));
        bad.extend(odd.map(|((i, j), _)| [i, j]));
    }
    if let Some(d) = dark {
        let most = middle(d) + HOT_DARK * typical;
        bad.extend(d.indexed_iter().filter(|(_, x)| **x > most).map(|((i, j), _)| [i, j]));
    }
    bad.sort_unstable();
    bad.dedup();
    bad
}

/// Finds pixels of line integrals `[view, row, column]` that differ from their neighbours in nearly every view, as no
/// part of a rotating object does. Needs five views; examines 32 at most. Ignores pixels in `known`.
pub fn outliers(projections: ArrayView3<f32>, known: &Array2<bool>) -> Vec<[usize; 2]> {
    let (views, rows, columns) = projections.dim();
    if views < LEAST_VIEWS {
        return Vec::new();
    }
    let looked: Vec<usize> = (0..views).step_by(views.div_ceil(MOST_VIEWS)).collect();
    let mut times = Array2::<u16>::zeros((rows, columns));
    let mut around = Vec::with_capacity(8);
    for &v in &looked {
        let view = projections.index_axis(Axis(0), v);
        let off = Array2::from_shape_fn((rows, columns), |(i, j)| {
            neighbours(view, (i, j), Some(known), &mut around);
            around.sort_unstable_by(f32::total_cmp);
            let n = around.len();
            let (Some(lower), Some(upper)) = (around.get(n.saturating_sub(1) / 2), around.get(n / 2)) else {
                return 0.0;
            };
            // A value between the two middle ones is not an outlier: one bad neighbour on an edge must not matter.
            let x = view[[i, j]];
            (x - upper).max(lower - x).max(0.0)
        });
        // 1.4826 makes the median of |x| the standard deviation of normal noise.
        let sigma = 1.4826 * middle(off.view());
        let mut sorted: Vec<f32> = view.iter().copied().collect();
        sorted.sort_unstable_by(f32::total_cmp);
        let at = |share| quantile(&sorted, share).unwrap_or(0.0);
        let least = (DEVIATIONS * sigma).max(SHARE_OF_RANGE * (at(0.99) - at(0.01)));
        times.zip_mut_with(&off, |n, &x| *n += u16::from(x > least));
    }
    let enough = (SHARE_OF_VIEWS * looked.len() as f64).ceil() as u16;
    times.indexed_iter().filter(|((i, j), n)| **n >= enough && !known[[*i, *j]]).map(|((i, j), _)| [i, j]).collect()
}

/// Puts the values of the up to eight pixels around `at` that are not `bad` into `out`.
pub(crate) fn neighbours(
    view: ArrayView2<'_, f32>,
    (i, j): (usize, usize),
    bad: Option<&Array2<bool>>,
    out: &mut Vec<f32>,
) {
    let (rows, columns) = view.dim();
    out.clear();
    for r in i.saturating_sub(1)..(i + 2).min(rows) {
        for c in j.saturating_sub(1)..(j + 2).min(columns) {
            if (r, c) != (i, j) && bad.is_none_or(|bad| !bad[[r, c]]) {
                out.push(view[[r, c]]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    #[test]
    fn dead_and_hot_pixels_are_found_in_fields() {
        let mut flat = Array2::from_elem((6, 8), 1000.0f32);
        let mut dark = Array2::from_elem((6, 8), 10.0f32);
        (flat[[1, 2]], flat[[3, 4]], dark[[5, 7]]) = (20.0, 9000.0, 700.0);
        let response = &flat - &dark;
        assert_eq!(from_fields(Some(response.view()), Some(dark.view()), 0.0), [[1, 2], [3, 4], [5, 7]]);
        assert_eq!(from_fields(None, Some(dark.view()), 1000.0), [[5, 7]]);
        assert!(from_fields(None, None, 1000.0).is_empty());
    }

    #[test]
    fn persistent_outliers_are_found_and_moving_edges_are_not() {
        let bump = |v: usize, i: usize, j: usize| if (i, j) == (4, v + 2) { 2.0 } else { 0.0 };
        let mut p = Array3::from_shape_fn((8, 12, 12), |(v, i, j)| {
            0.2 * (i as f32) + if j > 6 { 1.0 } else { 0.0 } + bump(v, i, j)
        });
        let known = Array2::from_elem((12, 12), false);
        assert!(outliers(p.view(), &known).is_empty());
        p.slice_mut(ndarray::s![.., 7, 6]).fill(9.0);
        p.slice_mut(ndarray::s![.., 0, 0]).fill(-3.0);
        assert_eq!(outliers(p.view(), &known), [[0, 0], [7, 6]]);
        assert!(outliers(p.slice(ndarray::s![..3, .., ..]), &known).is_empty());
    }
}
