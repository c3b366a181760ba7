//! Which way the source goes about the object: both ways are calibrated, and the views predicted in each.
//!
//! Views taken in the wrong direction are those of the mirrored object if all rays are parallel. The wider the cone is, the less are
//! they those of any object. The same holds for columns that run the wrong way.

use crate::criterion::spread;
use crate::{COARSEST, Correction, Parameter, Settings, Watch, calibrate, on_a_circle};
use conefield_core::backend::Backend;
use conefield_core::error::Result;
use conefield_core::geometry::Geometry;
use conefield_core::scan::Scan;
use serde::Serialize;

/// A direction whose held-out error is less than this share of the other's is the right one.
const CLEARLY: f64 = 0.7;

/// The held-out errors of both directions, each after a quick calibration, relative to the largest line integral.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Directions {
    /// Of the angles as they were told.
    pub as_told: f64,
    /// Of the same angles with the other sign.
    pub reversed: f64,
}

impl Directions {
    /// Whether the views clearly belong to the other direction.
    pub fn is_reversed(&self) -> bool {
        self.reversed < CLEARLY * self.as_told
    }
}

/// Compares both directions on coarse pixels. `None` if the sources do not stand on a circle about the axis.
pub fn directions(scan: &Scan, backend: &dyn Backend, watch: &dyn Watch) -> Result<Option<Directions>> {
    if !on_a_circle(&scan.geometry.views) {
        return Ok(None);
    }
    let [rows, columns] = scan.geometry.detector;
    let bin = rows.max(columns).div_ceil(2 * COARSEST).clamp(1, (rows.min(columns) / 4).max(1));
    let told = spread(scan.binned(bin))?;
    // A shift along u changes its sign with the direction; what else is off makes both errors larger.
    let settings = Settings { parameters: vec![Parameter::OffsetU], width: COARSEST, curves: false };
    let error = |scan: &Scan, from: f64| -> Result<f64> {
        Ok(calibrate(scan, &settings, backend, &Half { watch, from })?.held_out[1])
    };
    let as_told = error(&told, 0.0)?;
    let reversed = error(&reversed(told), 0.5)?;
    Ok(Some(Directions { as_told, reversed }))
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
    use crate::consistency::tests::scan;
    use conefield_backend_cpu::Cpu;
    use conefield_core::geometry::VoxelGrid;
    use conefield_core::orbit::CircularOrbit;
    use conefield_projectors::simulate::{Ellipsoid, scan_ellipsoids};
    use std::f64::consts::TAU;

    struct Silent;

    impl Watch for Silent {
        fn cancelled(&self) -> bool {
            false
        }

        fn progress(&self, _: f64) {}
    }

    /// Both ways with this scan and with the one that is told the wrong way.
    fn both(right: Scan) -> [Directions; 2] {
        let of = |scan: &Scan| directions(scan, &Cpu::new(), &Silent).unwrap().unwrap();
        [of(&right), of(&reversed(right))]
    }

    #[test]
    fn the_wrong_direction_is_told_and_the_right_one_is_not() {
        for noise in [0.0, 0.02] {
            let mut scan = scan(40, noise);
            // The detector is told to stand two pixels aside.
            let aside = Correction::default().with(Parameter::OffsetU, 5.0);
            scan.geometry.views = aside.views(&scan.geometry.views);
            let [right, wrong] = both(scan);
            assert!(wrong.is_reversed() && !right.is_reversed(), "{noise}: {right:?}, {wrong:?}");
            assert!((right.as_told - wrong.reversed).abs() < 0.01 * right.as_told, "{noise}: {right:?}, {wrong:?}");
        }
    }

    /// Nearly parallel rays show the mirrored object.
    #[test]
    fn a_narrow_cone_tells_no_direction() {
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
    fn views_that_stand_on_no_circle_are_not_compared() {
        let mut scan = scan(12, 0.0);
        for (i, view) in scan.geometry.views.iter_mut().enumerate() {
            view.source[2] += 10.0 * i as f64;
        }
        assert_eq!(directions(&scan, &Cpu::new(), &Silent).unwrap(), None);
    }
}
