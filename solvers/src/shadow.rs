//! The object's shadow on the detector.

use conefield_core::finite::range;
use conefield_core::scan::Scan;
use ndarray::{Array2, ArrayView2};

/// Upper limit of smoothed pixels in air: the noise's standard deviation, estimated from differences of neighbouring
/// pixels, or 1/500 of the largest values, whichever is larger.
pub fn air_level(scan: &Scan) -> f32 {
    let top = range(&scan.projections)[1].max(0.0);
    let some = |view| dark_differences(view, top).into_iter().step_by(7);
    let mut differences: Vec<f32> = scan.projections.outer_iter().flat_map(some).collect();
    let sigma = if differences.len() < 100 {
        0.0
    } else {
        // The median of |a − b| of two equal normals is 0.6745·√2·σ, but pixels clipped at zero cause ties at 0. So the
        // 75th percentile is used: 1.150·√2·σ.
        let k = differences.len() * 3 / 4;
        *differences.select_nth_unstable_by(k, f32::total_cmp).1 / (1.150 * std::f32::consts::SQRT_2)
    };
    sigma.max(top / 500.0)
}

/// Differences of neighbours along the rows of `image` that are both below a tenth of `top`.
pub fn dark_differences(image: ArrayView2<'_, f32>, top: f32) -> Vec<f32> {
    let dark = |x: f32| x < 0.1 * top;
    let pairs = image.rows().into_iter().flat_map(|row| row.into_iter().zip(row.into_iter().skip(1)));
    pairs.filter(|&(a, b)| dark(*a) && dark(*b)).map(|(a, b)| (a - b).abs()).collect()
}

/// Pixels whose 7 × 7 neighbourhood has a mean above `level`, dilated by `margin` pixels.
pub fn shadow(view: ArrayView2<'_, f32>, level: f32, margin: usize) -> Array2<bool> {
    let smooth = box_filter(view.to_owned(), 3, |window| window.iter().sum::<f32>() / window.len() as f32);
    dilated(smooth.mapv(|x| x > level), margin)
}

/// The marked pixels and all within ± `margin` of them along rows and columns.
pub fn dilated(marked: Array2<bool>, margin: usize) -> Array2<bool> {
    box_filter(marked, margin, |window| window.contains(&true))
}

/// Applies `f` to windows of ± `reach` along rows, then along columns; windows are clipped at the border.
fn box_filter<T: Copy>(mut image: Array2<T>, reach: usize, f: impl Fn(&[T]) -> T) -> Array2<T> {
    for axis in [1, 0] {
        for mut lane in image.lanes_mut(ndarray::Axis(axis)) {
            let line = lane.to_vec();
            for (i, x) in lane.iter_mut().enumerate() {
                *x = f(&line[i.saturating_sub(reach)..(i + reach + 1).min(line.len())]);
            }
        }
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_those_of_dark_neighbours_in_a_row() {
        let image = ndarray::array![[1.0, 3.0, 30.0], [4.0, 9.0, 2.0]];
        assert_eq!(dark_differences(image.view(), 100.0), [2.0, 5.0, 7.0]);
        for columns in [0, 1] {
            assert!(dark_differences(Array2::zeros((3, columns)).view(), 100.0).is_empty());
        }
    }

    #[test]
    fn a_shadow_covers_the_object_and_its_margin_but_not_noise() {
        let view = Array2::from_shape_fn((40, 40), |(r, c)| {
            let noise = 0.01 * (((r * 31 + c * 17) % 13) as f32 / 6.0 - 1.0);
            if (15..25).contains(&r) && (15..25).contains(&c) { 1.0 } else { noise.max(0.0) }
        });
        let s = shadow(view.view(), 0.02, 4);
        assert!(s[[20, 20]] && s[[12, 20]] && !s[[2, 2]] && !s[[35, 35]]);
    }
}
