//! Detects a last view that repeats the first: a full turn with both ends, imported with angles that exclude the end.

use conefield_core::geometry::{View, norm, sub};
use conefield_core::scan::Scan;
use ndarray::{Array2, ArrayView2, Zip};

/// Least number of views; with fewer, neighbours are too far apart to compare.
const FEWEST: usize = 8;
/// Pixels along the longer side of the compared images: few enough to average out the noise, but not the object.
const SIDE: usize = 64;
/// Largest difference of first and last view, as a share of the difference of neighbours.
const SHARE: f64 = 0.5;
/// Least difference of neighbours, as a share of the first view. Below it the object is round, and the test decides
/// nothing.
const ROUND: f64 = 1e-4;
/// Range of source distances, in steps, that counts as one step.
const STEPS: std::ops::Range<f64> = 0.5..1.5;

/// If the last view repeats the first although their sources are a step apart: the difference of the two views and the
/// smallest difference of their neighbours, both as shares of the first view.
///
/// A symmetric object can look alike from both sides of the seam. Then the neighbours of first and last view look alike
/// too; those of a repeated view do not.
pub(crate) fn repeated(scan: &Scan) -> Option<[f64; 2]> {
    let views = &scan.geometry.views;
    let n = views.len();
    if n < FEWEST || !a_step_apart(views) {
        return None;
    }
    let image = |i: usize| coarse(scan.projections.index_axis(ndarray::Axis(0), i));
    let [first, second, before, last] = [0, 1, n - 2, n - 1].map(image);
    let seam = difference(&last, &first);
    let neighbours = [(&first, &second), (&before, &last), (&before, &second)].map(|(a, b)| difference(a, b));
    let least = neighbours.into_iter().fold(f64::INFINITY, f64::min);
    let size = difference(&first, &Array2::zeros(first.raw_dim()));
    (least > ROUND * size && seam < SHARE * least).then(|| [seam / size, least / size])
}

/// Whether the first and the last view are about a step apart.
fn a_step_apart(views: &[View]) -> bool {
    let n = views.len();
    let apart = |a: usize, b: usize| norm(sub(views[a].source, views[b].source));
    [apart(0, 1), apart(n - 2, n - 1)].iter().all(|step| STEPS.contains(&(apart(n - 1, 0) / step)))
}

/// Means of square blocks; drops incomplete blocks at the last rows and columns.
fn coarse(view: ArrayView2<'_, f32>) -> Array2<f64> {
    let (rows, columns) = view.dim();
    let block = rows.max(columns).div_ceil(SIDE).min(rows.min(columns)).max(1);
    let mean = |b: ArrayView2<'_, f32>| b.iter().map(|x| f64::from(*x)).sum::<f64>() / b.len() as f64;
    Zip::from(view.exact_chunks([block, block])).map_collect(mean)
}

/// Root mean square of the difference.
fn difference(a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    let squares: f64 = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum();
    (squares / a.len() as f64).sqrt()
}
