//! A last view that repeats the first: a scan over a full turn with both ends, whose angles were taken without the last.

use conefield_core::geometry::{View, norm, sub};
use conefield_core::scan::Scan;
use ndarray::{Array2, ArrayView2, Zip};

/// Fewer views are too far apart to compare neighbours.
const FEWEST: usize = 8;
/// Pixels along the longer side of the images that are compared: noise is averaged out, the object is not.
const SIDE: usize = 64;
/// Largest difference of first and last view, as a share of that of neighbours.
const SHARE: f64 = 0.5;
/// Neighbours that differ by less, as a share of the first view, tell nothing: the object is round.
const ROUND: f64 = 1e-4;
/// Distances of sources, in steps, that count as a step.
const STEPS: std::ops::Range<f64> = 0.5..1.5;

/// The difference of last and first view and the least one between their neighbours, as shares of the first view, if
/// the two views show the same although they stand a step apart.
///
/// A symmetric object can look alike from both sides of the seam. Then the neighbours of first and last view look alike
/// too, which a repeated view does not explain.
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

/// Whether the first view follows the last at a distance of about a step.
fn a_step_apart(views: &[View]) -> bool {
    let n = views.len();
    let apart = |a: usize, b: usize| norm(sub(views[a].source, views[b].source));
    [apart(0, 1), apart(n - 2, n - 1)].iter().all(|step| STEPS.contains(&(apart(n - 1, 0) / step)))
}

/// Means of square blocks; what is left at the last rows and columns is dropped.
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
