//! The part of the volume that the views see.

use crate::diagnosis::setup::Setup;
use crate::diagnosis::shadow::Shadow;
use conefield_core::geometry::{Geometry, Vec3};
use conefield_core::parallel;
use serde::Serialize;

/// Sample points along each side of the volume, and most views.
const POINTS: usize = 32;
const VIEWS: usize = 360;

/// Shares of the volume's voxels by the share of views that see them, from a regular sample.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct VolumeCoverage {
    /// The sufficient share of views: all, half for an offset detector on a full circle, those of half a turn of a helix.
    pub needed: f64,
    /// Voxels seen by enough views.
    pub complete: f64,
    /// Voxels seen by no view.
    pub unseen: f64,
    /// Mean over voxels of the share of views.
    pub mean: f64,
    /// Smallest share of views over all voxels.
    pub least: f64,
}

/// For each of `points` (mm), the share of the views of `geometry` onto whose detector it projects; uses evenly spaced
/// views if there are many.
pub fn share_of_views(geometry: &Geometry, points: &[Vec3]) -> Vec<f64> {
    let shadows: Vec<Shadow> =
        geometry.views.iter().step_by(geometry.views.len().div_ceil(VIEWS).max(1)).map(Shadow::of).collect();
    let [rows, columns] = geometry.detector.map(|n| n as f64 / 2.0);
    parallel::map(points, |_, point| {
        let sees = |s: &&Shadow| s.of_point(*point).is_some_and(|f| f.row.abs() <= rows && f.column.abs() <= columns);
        shadows.iter().filter(sees).count() as f64 / shadows.len().max(1) as f64
    })
}

/// Computes how many views see each part of the volume.
pub(crate) fn volume_coverage(geometry: &Geometry, setup: &Setup) -> VolumeCoverage {
    let needed = match setup.helix_turns {
        Some(turns) => (0.5 / turns).min(1.0),
        None if setup.half_is_enough() => 0.5,
        None => 1.0,
    };
    let grid = &geometry.volume;
    let along = |k: usize| {
        let n = grid.shape[k];
        let m = n.min(POINTS);
        (0..m).map(move |i| (2 * i + 1) * n / (2 * m))
    };
    let mut points = Vec::new();
    for x in along(0) {
        for y in along(1) {
            points.extend(along(2).map(|z| grid.voxel([x, y, z])));
        }
    }
    let shares = share_of_views(geometry, &points);
    let part =
        |test: &dyn Fn(f64) -> bool| shares.iter().filter(|s| test(**s)).count() as f64 / shares.len().max(1) as f64;
    // One view less than half is enough too: rounding decides between the two.
    let views = geometry.views.len().clamp(2, VIEWS) as f64;
    let enough = if needed < 1.0 { needed - 1.01 / views } else { needed };
    VolumeCoverage {
        needed,
        complete: part(&|s| s >= enough),
        unseen: part(&|s| s == 0.0),
        mean: shares.iter().sum::<f64>() / shares.len().max(1) as f64,
        least: shares.iter().copied().fold(1.0, f64::min),
    }
}
