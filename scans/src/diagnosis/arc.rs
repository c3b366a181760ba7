//! Angular positions of the views: the arc, its gaps, and angles in degrees that were read as radians.

use conefield_core::geometry::View;
use conefield_core::orbit::Arcs;
use serde::Serialize;
use std::f64::consts::TAU;

/// A gap this wide, in degrees, is the open part of a short scan.
const OPENING: f64 = 60.0;

/// The views' directions from the axis, in degrees.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScanArc {
    /// Angle of the first view, from +x towards +y.
    pub first_deg: f64,
    /// Step from the first view to the second, the shorter way; positive from +x towards +y.
    pub step_deg: f64,
    /// The arc covered; each view contributes the mean step.
    pub covered_deg: f64,
    /// Whether the views cover the full circle: no gap of 60° or more is wider than three times every other gap.
    pub full_circle: bool,
    /// The largest gap between neighbours within the arc.
    pub largest_gap_deg: f64,
    /// Start of the largest gap.
    pub largest_gap_at_deg: f64,
    /// The mean gap between neighbours within the arc.
    pub mean_gap_deg: f64,
    /// Whether the steps look like degrees read as radians.
    pub like_degrees: bool,
}

/// Analyses the angular positions of `views`.
pub(crate) fn scan_arc(views: &[View]) -> ScanArc {
    let turns: Vec<f64> = views.iter().map(|v| v.source[1].atan2(v.source[0]).rem_euclid(TAU)).collect();
    let mut sorted: Vec<f64> = turns.iter().map(|a| a.to_degrees()).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let n = sorted.len();
    // Gap to the next view and its start, widest first.
    let mut gaps: Vec<[f64; 2]> =
        (0..n).map(|i| [sorted.get(i + 1).copied().unwrap_or(sorted[0] + 360.0) - sorted[i], sorted[i]]).collect();
    // Further turns repeat angles: they leave no gaps.
    let same = Arcs::of(&turns).same.to_degrees();
    gaps.retain(|g| g[0] > same);
    gaps.sort_unstable_by(|a, b| b[0].total_cmp(&a[0]));
    let wide = |i: usize| gaps.get(i).map_or(0.0, |g| g[0]);
    // The views of a short scan are close to each other, or too few to decide.
    let full_circle = wide(0) < OPENING || (n > 2 && wide(0) <= 3.0 * wide(1));
    let within = if full_circle { &gaps[..] } else { gaps.get(1..).unwrap_or_default() };
    let sum: f64 = within.iter().map(|g| g[0]).sum();
    let mean = if within.is_empty() { 0.0 } else { sum / within.len() as f64 };
    let largest = within.first().copied().unwrap_or_default();
    let step = match turns[..] {
        [a, b, ..] => (b - a + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0,
        _ => 0.0,
    };
    ScanArc {
        first_deg: turns.first().copied().unwrap_or(0.0).to_degrees(),
        step_deg: step.to_degrees(),
        covered_deg: if full_circle { 360.0 } else { sum + mean },
        full_circle,
        largest_gap_deg: largest[0],
        largest_gap_at_deg: largest[1],
        mean_gap_deg: mean,
        like_degrees: steps_of_degrees(&turns),
    }
}

/// Whether equal steps between angles in radians (modulo whole turns) equal those of 180, 360 or 720 degrees divided
/// evenly but not converted.
fn steps_of_degrees(turns: &[f64]) -> bool {
    let n = turns.len();
    if n < 4 {
        return false;
    }
    let step = (turns[1] - turns[0]).rem_euclid(TAU);
    let apart = |a: f64, b: f64| ((a - b + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0).abs();
    if turns.windows(2).any(|w| apart(w[1] - w[0], step) > 1e-4) {
        return false;
    }
    // Golden-angle steps are equal too, and come close to 360 by chance.
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    if apart(step, golden) < 1e-4 || apart(step, -golden) < 1e-4 {
        return false;
    }
    let candidates = [step, TAU - step].into_iter().flat_map(|s| (0..120).map(move |k| s + TAU * f64::from(k)));
    let whole = |total: f64| [180.0, 360.0, 720.0].iter().any(|w| (total / w - 1.0).abs() < 2e-4);
    candidates.into_iter().any(|s| whole(s * n as f64) || whole(s * (n - 1) as f64))
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::geometry::{Millimetres, Radians};

    fn arc(degrees: f64, n: usize) -> ScanArc {
        let mm = Millimetres;
        let angle = |i: usize| Radians((20.0 + degrees * i as f64 / n as f64).to_radians());
        let view = |i| View::circular(angle(i), mm(100.0), mm(150.0), [mm(1.0); 2], [mm(0.0); 2]);
        scan_arc(&(0..n).map(view).collect::<Vec<_>>())
    }

    #[test]
    fn arcs_and_gaps_do_not_depend_on_the_number_of_turns() {
        for (degrees, n, covered) in [(90.0, 180, 90.0), (203.0, 58, 203.0), (360.0, 50, 360.0), (1440.0, 720, 360.0)] {
            let found = arc(degrees, n);
            assert!((found.covered_deg - covered).abs() < 1e-6, "{degrees}: {found:?}");
            assert!(found.largest_gap_deg < 1.01 * found.mean_gap_deg, "{degrees}: {found:?}");
        }
    }
}
