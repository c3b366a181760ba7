//! The noise of a scan, from the scan alone.

use conefield_core::scan::Scan;
use ndarray::Axis;
use rayon::prelude::*;

/// Bytes that [`sigma`] takes: the differences, in lists and then in one.
pub fn memory(pixels: u64) -> u64 {
    2 * 4 * pixels
}

/// Standard deviation of the line integrals' noise where rays meet the object: second differences along rows hold little
/// else than noise, and their median absolute value is hardly moved by edges. For white noise `p[-1] − 2p[0] + p[1]` has
/// the variance 6σ². Noise that is correlated between pixels is underestimated.
pub fn sigma(scan: &Scan) -> f64 {
    let top = scan.projections.iter().fold(0.0f32, |m, &x| m.max(x));
    // Outside the object negative noise is often cut off.
    let least = 0.1 * top;
    let mut all: Vec<f32> = scan
        .projections
        .axis_iter(Axis(0))
        .into_par_iter()
        .flat_map_iter(|view| {
            let mut found = vec![];
            for row in view.rows() {
                for c in 1..row.len().saturating_sub(1) {
                    if row[c - 1] > least && row[c] > least && row[c + 1] > least {
                        found.push((row[c - 1] - 2.0 * row[c] + row[c + 1]).abs());
                    }
                }
            }
            found
        })
        .collect();
    if all.is_empty() {
        return 0.0;
    }
    let middle = all.len() / 2;
    let (_, median, _) = all.select_nth_unstable_by(middle, f32::total_cmp);
    // The median of |x| of a normal distribution is 0.6745 standard deviations.
    f64::from(*median) / 0.674_489_750_196_081_7 / 6f64.sqrt()
}
