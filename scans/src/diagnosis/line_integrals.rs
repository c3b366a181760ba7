//! Checks whether projections look like line integrals, and finds the likely cause if they do not.

use crate::diagnosis::border::border_medians;
use crate::diagnosis::quantiles::{median, middle, quantile, sorted_sample};
use conefield_core::finite::range;
use ndarray::{ArrayView3, Axis, s};
use serde::Serialize;

/// Views whose border is examined.
const VIEWS: usize = 32;
/// At this line integral less than one photon in 10²¹ gets through; no detector measures that.
const OPAQUE: f32 = 50.0;

/// The result of [`check_line_integrals`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LineIntegralCheck {
    /// The smallest and the largest value.
    pub range: [f32; 2],
    /// The 0.1 % and 99.9 % quantiles of the values.
    pub typical_range: [f32; 2],
    /// Level of the emptiest part of the border: near 0 for line integrals of an object surrounded by air. The median
    /// over views of the third-lowest of 16 medians along the border.
    pub air: f32,
    /// Share of values below −1/20 of the upper end of the typical range.
    pub negative: f64,
    /// Likely problems, in words; empty if there are none.
    pub complaints: Vec<String>,
}

/// Checks whether `projections` (`[view, row, column]`) can be line integrals `A = −ln(I/I0)`, which have no unit:
/// their range, air near zero at the border, the share of negative values.
pub fn check_line_integrals(projections: ArrayView3<'_, f32>) -> LineIntegralCheck {
    let sample = sorted_sample(projections);
    let at = |share| quantile(&sample, share).unwrap_or(0.0);
    let (low, high) = (at(0.001), at(0.999));
    let negative = sample.partition_point(|&x| x < -0.05 * high.abs()) as f64 / sample.len().max(1) as f64;
    let (mut dark, mut bright, mut centres) = (Vec::new(), Vec::new(), Vec::new());
    let (rows, columns) = (projections.len_of(Axis(1)), projections.len_of(Axis(2)));
    for view in projections.axis_iter(Axis(0)).step_by(projections.len_of(Axis(0)).div_ceil(VIEWS).max(1)) {
        if rows == 0 || columns == 0 {
            break;
        }
        let border = border_medians(view, |_, _| true);
        dark.extend(quantile(&border, 0.15));
        bright.extend(quantile(&border, 0.85));
        let centre = view.slice(s![rows / 4..rows - rows / 4, columns / 4..columns - columns / 4]);
        centres.push(middle(centre));
    }
    let [air, bright, centre] = [dark, bright, centres].map(|mut v| median(&mut v).unwrap_or(0.0));
    let mut complaints = Vec::new();
    // Intensities are highest in air; line integrals are lowest there.
    let upside_down = bright > 0.7 * high && centre < 0.95 * bright && air > 0.2 * high;
    if high > 0.0 && (upside_down || (high > OPAQUE && bright > 0.5 * high)) {
        complaints.push(format!(
            "looks like intensities, not line integrals: pass --i0 or flat/dark (the border shows {bright:.4}, the \
             middle {centre:.4}, the highest values {high:.4}; air has line integrals near 0)"
        ));
    } else {
        if high > OPAQUE {
            complaints.push(format!(
                "line integrals up to {high:.1}: no detector measures above {OPAQUE}; are they counts, or in another \
                 unit?"
            ));
        }
        if air > 0.1 * high {
            complaints.push(format!(
                "air at the border is {air:.4}, not near 0: I0 is too high, or the object reaches past the detector \
                 on all sides"
            ));
        }
    }
    if negative > 0.01 {
        complaints.push(format!(
            "{:.1} % of the values are clearly negative: I0 is too low, or the sign is wrong",
            100.0 * negative
        ));
    }
    LineIntegralCheck { range: range(&projections), typical_range: [low, high], air, negative, complaints }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    /// A ball of line integrals up to `peak` in the middle of the detector.
    fn ball(peak: f32) -> Array3<f32> {
        Array3::from_shape_fn((6, 40, 50), |(_, i, j)| {
            let d = ((i as f32 - 19.5) / 15.0).powi(2) + ((j as f32 - 24.5) / 15.0).powi(2);
            // Some noise, of both signs.
            peak * (1.0 - d).max(0.0).sqrt() + 0.002 * peak * ((i * 7 + j * 13) % 5) as f32 - 0.004 * peak
        })
    }

    #[test]
    fn line_integrals_pass_and_other_values_are_reported() {
        for peak in [1e-3, 0.5, 5.0, 12.0] {
            let c = check_line_integrals(ball(peak).view());
            assert!(c.complaints.is_empty(), "{peak}: {c:?}");
        }
        let reported = |p: Array3<f32>, words: &str| {
            let c = check_line_integrals(p.view());
            assert!(c.complaints.iter().any(|w| w.contains(words)), "{words}: {c:?}");
        };
        reported(ball(2.0).mapv(|a| 20000.0 * (-a).exp()), "looks like intensities, not line integrals: pass --i0");
        reported(ball(2.0).mapv(|a| (-a).exp()), "looks like intensities, not line integrals: pass --i0 or flat/dark");
        reported(ball(2.0) + 0.7, "I0 is too high");
        reported(ball(2.0) - 0.7, "I0 is too low");
        reported(-ball(2.0), "the sign is wrong");
        reported(ball(200.0), "no detector measures");
        // An empty beam is not an error.
        assert!(check_line_integrals(Array3::zeros((2, 3, 4)).view()).complaints.is_empty());
        assert!(check_line_integrals(Array3::zeros((0, 0, 0)).view()).complaints.is_empty());
    }
}
