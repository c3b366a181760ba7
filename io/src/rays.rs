//! Line integrals through a volume, accurate enough to find the unit of a file.

use conefield_core::geometry::{Ray, VoxelGrid};
use conefield_core::scan::Scan;
use ndarray::Array3;

/// The integral of `data` along `ray`, in values times mm: trilinear between voxel centres, with steps of half a voxel.
pub(crate) fn integral(data: &Array3<f32>, grid: &VoxelGrid, ray: &Ray) -> f64 {
    let Some([near, far]) = ray.clip(grid.bounds()) else { return 0.0 };
    let finest = grid.spacing.iter().copied().fold(f64::INFINITY, f64::min);
    let steps = ((far - near) / (0.5 * finest)).ceil().clamp(1.0, 1e5) as usize;
    let length = (far - near) / steps as f64;
    let lower = grid.bounds()[0];
    let mut sum = 0.0;
    for i in 0..steps {
        let p = ray.at(near + (i as f64 + 0.5) * length);
        // The voxels before and behind the point along each axis, and the weight of the latter.
        let axes: [(usize, usize, f64); 3] = std::array::from_fn(|k| {
            let last = grid.shape[k] - 1;
            // Between the outermost centres and the border the outermost value applies.
            let x = ((p[k] - lower[k]) / grid.spacing[k] - 0.5).clamp(0.0, last as f64);
            (x as usize, (x as usize + 1).min(last), x - (x as usize) as f64)
        });
        for corner in 0..8 {
            let mut weight = 1.0;
            let at: [usize; 3] = std::array::from_fn(|k| {
                let ((low, high, part), behind) = (axes[k], corner >> k & 1 == 1);
                weight *= if behind { part } else { 1.0 - part };
                if behind { high } else { low }
            });
            sum += weight * f64::from(data[at]);
        }
    }
    sum * length
}

/// How well a volume matches a scan.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Agreement {
    /// Ratio of the measured line integrals to those through the volume, by least squares.
    pub ratio: f64,
    /// Residual of the measured integrals after scaling, relative to their root mean square.
    pub residual: f64,
}

/// Compares the measured line integrals with those through `data` on the scan's grid along some rays; `None` if none of
/// them hits the volume's values.
pub(crate) fn agreement(scan: &Scan, data: &Array3<f32>) -> Option<Agreement> {
    let g = &scan.geometry;
    if data.shape() != g.volume.shape {
        return None;
    }
    let views = g.views.len();
    let stride = |n: usize, most: usize| n.div_ceil(most);
    let (mut mm, mut mi, mut ii) = (0.0, 0.0, 0.0);
    for view in (0..views).step_by(stride(views, 4)) {
        for row in (0..g.detector[0]).step_by(stride(g.detector[0], 24)) {
            for column in (0..g.detector[1]).step_by(stride(g.detector[1], 24)) {
                let i = integral(data, &g.volume, &g.ray(view, row, column));
                let m = f64::from(scan.projections[[view, row, column]]);
                mm += m * m;
                mi += i * m;
                ii += i * i;
            }
        }
    }
    let left = if mm > 0.0 { (1.0 - mi * mi / (mm * ii)).max(0.0).sqrt() } else { 1.0 };
    (ii > 0.0 && mi.is_finite()).then_some(Agreement { ratio: mi / ii, residual: left })
}
