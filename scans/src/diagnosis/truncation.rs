//! Checks whether the object extends beyond the left or right side of the detector.

use crate::diagnosis::line_integrals::LineIntegralCheck;
use crate::diagnosis::setup::Setup;
use ndarray::{ArrayView3, Axis, s};
use serde::Serialize;

/// Threshold of air at the sides, as a share of the highest line integrals.
const LEVEL: f32 = 0.05;

/// Truncation: projections that are not near zero at the first or last columns. For an offset detector on a full circle
/// only the far side counts: the near one cuts through the object on purpose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Truncation {
    /// Share of truncated views.
    pub views: f64,
    /// Share of truncated detector rows in these views.
    pub rows: f64,
    /// The same in mm at the isocentre.
    pub height_mm: f64,
    /// The mean line integral there.
    pub level: f32,
    /// Upper limit of values that count as zero.
    pub threshold: f32,
}

/// Examines the sides of `projections`, `[view, row, column]`.
pub(crate) fn truncation(projections: ArrayView3<'_, f32>, setup: &Setup, check: &LineIntegralCheck) -> Truncation {
    let (_, rows, columns) = projections.dim();
    let high = check.typical_range[1].max(0.0);
    let threshold = LEVEL * high + check.air.clamp(0.0, LEVEL * high);
    // Averaging some pixels reduces their noise.
    let (tall, wide) = (rows.div_ceil(64).max(1), columns.div_ceil(64).max(1));
    let [left, right] = setup.open_sides();
    let (mut cut_views, mut cut_rows, mut sum, mut blocks) = (0usize, 0.0, 0.0f64, 0usize);
    for view in projections.axis_iter(Axis(0)) {
        let mut cut = 0usize;
        let pieces = (0..rows).step_by(tall);
        let all = pieces.len();
        for row in pieces {
            let end = (row + tall).min(rows);
            let sides = [(left, 0..wide), (right, columns - wide..columns)];
            let means = sides.into_iter().filter(|s| s.0).filter_map(|(_, c)| view.slice(s![row..end, c]).mean());
            let most = means.fold(f32::NEG_INFINITY, f32::max);
            if most > threshold {
                cut += 1;
                sum += f64::from(most);
                blocks += 1;
            }
        }
        // A single segment may be noise or a bad pixel, unless it is all there is.
        if cut > (all / 50 + 1).min(all - 1) {
            cut_views += 1;
            cut_rows += cut as f64 / all as f64;
        }
    }
    let rows_share = if cut_views > 0 { cut_rows / cut_views as f64 } else { 0.0 };
    let magnification = if setup.magnification > 0.0 { setup.magnification } else { 1.0 };
    Truncation {
        views: cut_views as f64 / projections.len_of(Axis(0)).max(1) as f64,
        rows: rows_share,
        height_mm: rows_share * setup.detector_mm[0] / magnification,
        level: if blocks > 0 { (sum / blocks as f64) as f32 } else { 0.0 },
        threshold,
    }
}
