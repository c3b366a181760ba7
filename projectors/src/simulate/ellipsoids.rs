//! Ellipsoids, whose line integrals have a closed form: a reference for projectors and solvers.

use conefield_core::geometry::{Geometry, Ray, Vec3, VoxelGrid, dot};
use conefield_core::parallel;
use conefield_core::scan::{Scan, Unit, Volume};
use ndarray::{Array3, Axis};

/// A homogeneous ellipsoid with its axes along x, y and z. Where several overlap, their attenuations add up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ellipsoid {
    /// Its centre, mm.
    pub center: Vec3,
    /// Its half axes, mm.
    pub axes: Vec3,
    /// Its attenuation, 1/mm.
    pub value: f64,
}

impl Ellipsoid {
    /// Length of `ray` inside it, mm. The source must be outside.
    pub fn chord(&self, ray: &Ray) -> f64 {
        let o: Vec3 = std::array::from_fn(|k| (ray.origin[k] - self.center[k]) / self.axes[k]);
        let d: Vec3 = std::array::from_fn(|k| ray.direction[k] / self.axes[k]);
        let (a, b, c) = (dot(d, d), dot(o, d), dot(o, o) - 1.0);
        2.0 * (b * b - a * c).max(0.0).sqrt() / a
    }

    /// Whether the point is inside.
    pub fn contains(&self, p: Vec3) -> bool {
        let q: Vec3 = std::array::from_fn(|k| (p[k] - self.center[k]) / self.axes[k]);
        dot(q, q) < 1.0
    }

    /// The ellipsoid with half axes `by` mm longer (shorter if `by` is negative).
    pub fn grown(self, by: f64) -> Self {
        Self { axes: self.axes.map(|a| (a + by).max(f64::MIN_POSITIVE)), ..self }
    }
}

/// The attenuation of `bodies` in the voxels of `grid`, each weighted by the share of 4³ points inside.
pub fn ellipsoids(bodies: &[Ellipsoid], grid: &VoxelGrid) -> Volume {
    let mut data = Array3::zeros(grid.shape);
    parallel::over(data.axis_iter_mut(Axis(0)), |x, mut plane| {
        for ((y, z), out) in plane.indexed_iter_mut() {
            let p = grid.voxel([x, y, z]);
            let mut sum = 0.0;
            for i in 0..64 {
                let sub = [i % 4, i / 4 % 4, i / 16].map(|s| (f64::from(s) + 0.5) / 4.0 - 0.5);
                let q = std::array::from_fn(|k| p[k] + sub[k] * grid.spacing[k]);
                sum += bodies.iter().filter(|b| b.contains(q)).map(|b| b.value).sum::<f64>();
            }
            *out = (sum / 64.0) as f32;
        }
    });
    Volume { data, grid: *grid, affine: None }
}

/// The noise-free scan of `bodies`: closed-form line integrals of the rays through the pixels' centres, independent of
/// the voxels.
pub fn scan_ellipsoids(bodies: &[Ellipsoid], geometry: Geometry) -> Scan {
    let [rows, columns] = geometry.detector;
    let mut projections = Array3::zeros((geometry.views.len(), rows, columns));
    parallel::over(projections.axis_iter_mut(Axis(0)), |view, mut image| {
        for ((row, column), out) in image.indexed_iter_mut() {
            let ray = geometry.ray(view, row, column);
            *out = bodies.iter().map(|b| b.value * b.chord(&ray)).sum::<f64>() as f32;
        }
    });
    let provenance = serde_json::json!({ "simulated": "ellipsoids in closed form" });
    Scan { geometry, projections, unit: Unit::default(), provenance }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chords_are_lengths_inside() {
        let body = Ellipsoid { center: [1.0, 2.0, 3.0], axes: [2.0, 3.0, 4.0], value: 1.0 };
        let along = |origin, direction| body.chord(&Ray { origin, direction });
        assert!((along([-50.0, 2.0, 3.0], [1.0, 0.0, 0.0]) - 4.0).abs() < 1e-12);
        assert!((along([1.0, 60.0, 3.0], [0.0, -1.0, 0.0]) - 6.0).abs() < 1e-12);
        // At √3/2 of the half axis across the chord is half as long.
        assert!((along([-50.0, 2.0 + 1.5 * 3f64.sqrt(), 3.0], [1.0, 0.0, 0.0]) - 2.0).abs() < 1e-12);
        assert_eq!(along([-50.0, 5.1, 3.0], [1.0, 0.0, 0.0]), 0.0);
        assert!(body.contains([2.9, 2.0, 3.0]) && !body.grown(-0.2).contains([2.9, 2.0, 3.0]));
    }

    #[test]
    fn voxels_hold_the_body_s_mass() {
        let grid = VoxelGrid { shape: [20, 22, 24], spacing: [0.7, 0.6, 0.5], center: [0.0; 3] };
        let body = Ellipsoid { center: [0.5, -0.4, 0.3], axes: [5.0, 4.0, 4.5], value: 0.02 };
        let mass = f64::from(ellipsoids(&[body], &grid).data.sum()) * grid.spacing.iter().product::<f64>();
        let want = 0.02 * 4.0 / 3.0 * std::f64::consts::PI * body.axes.iter().product::<f64>();
        assert!((mass / want - 1.0).abs() < 2e-3, "{mass} and {want}");
    }
}
