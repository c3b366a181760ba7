//! Values along the border of a projection, where most scans show air.

use crate::diagnosis::quantiles::median;
use ndarray::ArrayView2;

/// Segments per border strip.
const PIECES: usize = 4;

/// Medians of the border segments of `view` (`[row, column]`), ascending: strips of 1/32 of the shorter side, four
/// segments per side. Ignores pixels that `usable` rejects.
pub fn border_medians(view: ArrayView2<'_, f32>, usable: impl Fn(usize, usize) -> bool) -> Vec<f32> {
    let (rows, columns) = view.dim();
    let width = (rows.min(columns) / 32).max(1);
    let mut out = Vec::with_capacity(4 * PIECES);
    let mut values = Vec::new();
    let mut add = |r: std::ops::Range<usize>, c: std::ops::Range<usize>| {
        values.clear();
        for i in r {
            values.extend(c.clone().filter(|&j| usable(i, j)).map(|j| view[[i, j]]));
        }
        out.extend(median(&mut values));
    };
    for k in 0..PIECES {
        let part = |n: usize| k * n / PIECES..(k + 1) * n / PIECES;
        add(0..width, part(columns));
        add(rows - width..rows, part(columns));
        add(part(rows), 0..width);
        add(part(rows), columns - width..columns);
    }
    out.sort_unstable_by(f32::total_cmp);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::quantiles::quantile;
    use ndarray::Array2;

    #[test]
    fn the_border_is_found_at_every_size() {
        for (rows, columns) in [(1, 1), (2, 9), (64, 96), (5, 200)] {
            let view = Array2::from_elem((rows, columns), 3.0f32);
            let found = border_medians(view.view(), |_, _| true);
            assert!(!found.is_empty() && found.iter().all(|&x| x == 3.0), "{rows} x {columns}: {found:?}");
        }
        let view = Array2::from_shape_fn((64, 64), |(_, c)| if c < 32 { 1.0 } else { 2.0 });
        let found = border_medians(view.view(), |_, _| true);
        assert_eq!((found.len(), quantile(&found, 0.1), quantile(&found, 0.9)), (16, Some(1.0), Some(2.0)));
        assert!(border_medians(view.view(), |_, _| false).is_empty());
    }
}
