//! The speed of this machine: the time per pass of a small reconstruction that is the same on every machine.

use crate::shipped::SHIPPED;
use crate::tradeoff::calibrate::Laps;
use conefield_core::Result;
use conefield_core::backend::Backend;
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::method::{Context, Job, Limits};
use conefield_core::orbit::CircularOrbit;
use conefield_core::random::{mix, unit};
use conefield_core::scan::{Scan, Unit};
use conefield_core::spec::load::Draft;
use ndarray::Array3;
use std::f64::consts::TAU;

/// Views, rows and columns of the detector, and voxels along a side of the volume.
const VIEWS: usize = 16;
const PIXELS: usize = 112;
const VOXELS: usize = 80;
/// Passes; the median of the later half counts. The first ones touch memory for the first time.
const PASSES: u64 = 8;

/// Seconds per pass of total variation on 80³ samples of a cubic spline, from 16 views of 112 × 112 pixels. Projector
/// and prior do the same work as in all voxel methods of the shipped front.
pub fn pass_s(backend: &dyn Backend, cancelled: &dyn Fn() -> bool) -> Result<f64> {
    let sets = [
        "basis={ type = \"cubic\", spacing = 1 }",
        "prior=\"directional-total-variation\"",
        // With fewer views per subset, overhead counts more than in a real run, and subsets are soon merged.
        "subsets=4",
        "stop={ passes = 100, change = 1e-12 }",
    ];
    let loaded = Draft::find("fista-tv", &sets.map(String::from), SHIPPED)?.finish()?;
    let mut plan = loaded.spec.method.plan(&Context::new(backend))?;
    let scan = scan(VIEWS, PIXELS, VOXELS);
    let mut laps = Laps::new(cancelled);
    let limits = Limits { steps: Some(PASSES), ..Limits::default() };
    let solution = plan.run(&Job { limits, ..Job::new(&scan, backend) }, &mut laps)?;
    Ok(laps.typical().unwrap_or(solution.train_s / PASSES as f64))
}

/// The shadow of a ball, with noise: views, detector pixels and voxels along a side.
pub fn scan(views: usize, pixels: usize, voxels: usize) -> Scan {
    let angles = (0..views).map(|i| TAU * i as f64 / views as f64).collect();
    let pixel = 246.4 / pixels as f64;
    let orbit = CircularOrbit { dso: 500.0, dsd: 700.0, pixel: [pixel; 2], offset: [0.0; 2], angles };
    let volume = VoxelGrid { shape: [voxels; 3], spacing: [160.0 / voxels as f64; 3], center: [0.0; 3] };
    let value = |(view, row, column): (usize, usize, usize)| {
        let [y, x] = [row, column].map(|i| (i as f64 + 0.5) / pixels as f64 * 2.5 - 1.25);
        let chord = (1.0 - x * x - y * y).max(0.0).sqrt();
        (chord + 0.02 * f64::from(unit(mix(view as u64, (row * pixels + column) as u64)))) as f32
    };
    Scan {
        geometry: Geometry { views: orbit.views(), detector: [pixels; 2], volume },
        projections: Array3::from_shape_fn((views, pixels, pixels), value),
        unit: Unit::default(),
        provenance: serde_json::Value::Null,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scan_is_one_that_methods_take() {
        let scan = scan(VIEWS, PIXELS, VOXELS);
        scan.validate("speed").unwrap();
        let [middle, corner] = [[0, 56, 56], [0, 0, 0]].map(|at| scan.projections[at]);
        assert!(middle > 0.95 && corner < 0.03, "{middle} {corner}");
    }
}
