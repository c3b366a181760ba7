//! The direction in which the source moves around the object. Both are calibrated; the better prediction of views
//! decides.
//!
//! With parallel rays, views in the wrong direction are exactly those of the mirrored object. The wider the cone, the
//! less any object explains them. Reversed columns have the same effect.

use crate::calibration::criterion::{bin, spread};
use crate::calibration::{COARSEST, Correction, Parameter, Settings, Watch, calibrate, on_a_circle};
use conefield_core::backend::Backend;
use conefield_core::error::Result;
use conefield_core::geometry::Geometry;
use conefield_core::scan::Scan;
use serde::Serialize;

/// A direction is right if its held-out error is below this share of the other's.
const CLEARLY: f64 = 0.7;

/// The held-out errors of both directions, each after a quick calibration, relative to the largest line integral.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Directions {
    /// With the scan's angles.
    pub given: f64,
    /// With the angles reversed.
    pub reversed: f64,
}

impl Directions {
    /// Whether the views clearly belong to the other direction.
    pub fn is_reversed(&self) -> bool {
        self.reversed < CLEARLY * self.given
    }

    /// What to do about a wrong direction; `None` if the views do not clearly belong to the other one.
    pub fn advice(&self) -> Option<String> {
        self.is_reversed().then(|| {
            format!(
                "the views fit the other direction: after a quick calibration the held-out error is {:.4}, and {:.4} with the angles \
                 reversed\n  import the scan with the other `direction` in scanner.toml. If `direction` is certain, use \
                 --flip-columns instead; the wrong choice mirrors the volume",
                self.given, self.reversed
            )
        })
    }
}

/// Compares both directions on coarse pixels. `None` if the sources do not lie on a circle around the axis.
pub fn directions(scan: &Scan, backend: &dyn Backend, watch: &dyn Watch) -> Result<Option<Directions>> {
    if !on_a_circle(&scan.geometry.views) {
        return Ok(None);
    }
    let coarse = spread(scan.binned(bin(scan.geometry.detector, 2 * COARSEST)));
    // Only a shift along u has another sign in the other direction. Other errors of the geometry affect both alike.
    let settings = Settings { parameters: vec![Parameter::OffsetU], width: COARSEST, curves: false };
    let error = |scan: &Scan, from: f64| -> Result<f64> {
        Ok(calibrate(scan, &settings, backend, &Half { watch, from })?.held_out[1])
    };
    let given = error(&coarse, 0.0)?;
    let reversed = error(&reversed(coarse), 0.5)?;
    Ok(Some(Directions { given, reversed }))
}

/// The same views with their angles from the first one in the other direction.
fn reversed(scan: Scan) -> Scan {
    let views = Correction::default().with(Parameter::Step, -2.0).views(&scan.geometry.views);
    Scan { geometry: Geometry { views, ..scan.geometry }, ..scan }
}

/// One half of the work.
struct Half<'a> {
    watch: &'a dyn Watch,
    from: f64,
}

impl Watch for Half<'_> {
    fn cancelled(&self) -> bool {
        self.watch.cancelled()
    }

    fn progress(&self, share: f64) {
        self.watch.progress(self.from + 0.5 * share);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::consistency::tests::{Silent, scan};
    use conefield_backend_cpu::Cpu;
    use conefield_core::geometry::VoxelGrid;
    use conefield_core::orbit::CircularOrbit;
    use conefield_projectors::simulate::{Ellipsoid, scan_ellipsoids};
    use std::f64::consts::TAU;

    /// The errors of a scan and of the same scan with reversed angles.
    fn both(right: Scan) -> [Directions; 2] {
        let of = |scan: &Scan| directions(scan, &Cpu::new(), &Silent).unwrap().unwrap();
        [of(&right), of(&reversed(right))]
    }

    #[test]
    fn only_the_wrong_direction_is_reported() {
        for noise in [0.0, 0.02] {
            let mut scan = scan(40, noise);
            // The detector is off by two pixels.
            let aside = Correction::default().with(Parameter::OffsetU, 5.0);
            scan.geometry.views = aside.views(&scan.geometry.views);
            let [right, wrong] = both(scan);
            assert!(wrong.is_reversed() && !right.is_reversed(), "{noise}: {right:?}, {wrong:?}");
            assert!((right.given - wrong.reversed).abs() < 0.01 * right.given, "{noise}: {right:?}, {wrong:?}");
        }
    }

    /// Nearly parallel rays show the mirrored object.
    #[test]
    fn a_narrow_cone_determines_no_direction() {
        let angles = (0..24).map(|i| TAU * f64::from(i) / 24.0).collect();
        let orbit = CircularOrbit { dso: 1e5, dsd: 1.1e5, pixel: [3.0; 2], offset: [0.0; 2], angles };
        let volume = VoxelGrid { shape: [32; 3], spacing: [3.0; 3], center: [0.0; 3] };
        let geometry = Geometry { views: orbit.views(), detector: [48, 48], volume };
        let body = |center, r| Ellipsoid { center, axes: [r, 1.5 * r, r], value: 0.02 };
        let bodies = [body([20.0, 5.0, 10.0], 8.0), body([-25.0, 12.0, -5.0], 6.0), body([5.0, -24.0, 15.0], 5.0)];
        for found in both(scan_ellipsoids(&bodies, geometry)) {
            assert!(!found.is_reversed(), "{found:?}");
        }
    }

    #[test]
    fn views_off_a_circle_are_not_compared() {
        let mut scan = scan(12, 0.0);
        for (i, view) in scan.geometry.views.iter_mut().enumerate() {
            view.source[2] += 10.0 * i as f64;
        }
        assert_eq!(directions(&scan, &Cpu::new(), &Silent).unwrap(), None);
    }
}
