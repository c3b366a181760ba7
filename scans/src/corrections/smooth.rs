//! Blurring images.

use ndarray::{Array2, ArrayView2, Axis};

/// Passes of a moving average; together they approximate a Gaussian.
const PASSES: usize = 3;

/// `image` blurred by a Gaussian with a standard deviation of `sigma` pixels, as three moving averages along each axis.
/// The image is mirrored at its borders, so that its sum stays. Sums are in double precision, so that adding and
/// subtracting values in a wide average leaves no error.
pub(crate) fn blurred(image: ArrayView2<'_, f32>, sigma: f64) -> Array2<f32> {
    // Three boxes of 2r + 1 pixels have a variance of ((2r + 1)² − 1)/4.
    let reach = ((((4.0 * sigma * sigma + 1.0).sqrt()) - 1.0) / 2.0).round() as usize;
    let mut out = image.to_owned();
    if reach == 0 {
        return out;
    }
    for axis in [Axis(0), Axis(1)] {
        for mut lane in out.lanes_mut(axis) {
            let (n, wide) = (lane.len(), PASSES * reach);
            let mirrored = |i: usize| {
                // Position among the values forwards and backwards.
                let i = (i + 2 * n * wide.div_ceil(2 * n) - wide) % (2 * n);
                lane[if i < n { i } else { 2 * n - 1 - i }]
            };
            let mut line: Vec<f32> = (0..n + 2 * wide).map(mirrored).collect();
            (0..PASSES).for_each(|_| line = averaged(&line, reach));
            lane.iter_mut().zip(&line[wide..]).for_each(|(x, y)| *x = *y);
        }
    }
    out
}

/// The moving average of `2·reach + 1` values; those beyond the ends are 0.
fn averaged(line: &[f32], reach: usize) -> Vec<f32> {
    let (n, width) = (line.len(), (2 * reach + 1) as f64);
    let mut sum: f64 = line.iter().take(reach).map(|&x| f64::from(x)).sum();
    let mut next = |i: usize| {
        sum += line.get(i + reach).map_or(0.0, |&x| f64::from(x));
        let mean = (sum / width) as f32;
        sum -= if i >= reach { f64::from(line[i - reach]) } else { 0.0 };
        mean
    };
    (0..n).map(&mut next).collect()
}

/// Sums of rectangles of an image in four look-ups.
pub(crate) struct Sums {
    /// `[row, column]`, one larger than the image along both axes: the sum above and to the left.
    below: Array2<f64>,
}

impl Sums {
    /// The sums of `image`.
    pub fn of(image: ArrayView2<'_, f32>) -> Self {
        let (rows, columns) = image.dim();
        let mut below = Array2::zeros((rows + 1, columns + 1));
        for i in 0..rows {
            let mut line = 0.0;
            for j in 0..columns {
                line += f64::from(image[[i, j]]);
                below[[i + 1, j + 1]] = below[[i, j + 1]] + line;
            }
        }
        Self { below }
    }

    /// Sum and number of the pixels within `reach` of `at` along both axes.
    pub fn around(&self, [i, j]: [usize; 2], reach: usize) -> (f64, usize) {
        let (rows, columns) = (self.below.dim().0 - 1, self.below.dim().1 - 1);
        let (top, bottom) = (i.saturating_sub(reach), (i + reach + 1).min(rows));
        let (left, right) = (j.saturating_sub(reach), (j + reach + 1).min(columns));
        let b = &self.below;
        (b[[bottom, right]] - b[[top, right]] - b[[bottom, left]] + b[[top, left]], (bottom - top) * (right - left))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sum_stays_also_at_borders_and_on_one_row() {
        for shape in [(61, 61), (7, 90), (1, 200), (3, 2)] {
            let image = Array2::from_shape_fn(shape, |(i, j)| ((3 * i + 5 * j) % 7) as f32);
            let b = blurred(image.view(), 9.0);
            assert!((b.sum() / image.sum() - 1.0).abs() < 1e-4, "{shape:?}: {} and {}", b.sum(), image.sum());
            let even = blurred(Array2::from_elem(shape, 2.0).view(), 9.0);
            assert!(even.iter().all(|x| (x - 2.0).abs() < 1e-5), "{shape:?}");
        }
    }

    #[test]
    fn a_point_becomes_a_gaussian() {
        let mut image = Array2::zeros((61, 61));
        image[[30, 30]] = 1.0;
        // The result of boxes of 9 pixels.
        let sigma = 20f64.sqrt();
        let b = blurred(image.view(), sigma);
        assert!((b.sum() - 1.0).abs() < 1e-4);
        let variance: f32 = b.indexed_iter().map(|((i, _), x)| x * (i as f32 - 30.0).powi(2)).sum();
        assert!((variance - 20.0).abs() < 0.1, "{variance}");
        assert!((b[[30, 34]] / b[[30, 30]] - (-0.4f32).exp()).abs() < 0.08);
        assert_eq!(blurred(image.view(), 0.2), image);
    }

    #[test]
    fn rectangles_are_summed() {
        let image = Array2::from_shape_fn((7, 9), |(i, j)| (3 * i + j * j) as f32);
        let sums = Sums::of(image.view());
        for (at, reach) in [([0, 0], 1), ([3, 4], 2), ([6, 8], 20), ([2, 7], 0)] {
            let near = |(i, j): (usize, usize)| i.abs_diff(at[0]) <= reach && j.abs_diff(at[1]) <= reach;
            let within: Vec<f64> = image.indexed_iter().filter(|(k, _)| near(*k)).map(|(_, x)| f64::from(*x)).collect();
            assert_eq!(sums.around(at, reach), (within.iter().sum(), within.len()));
        }
    }
}
