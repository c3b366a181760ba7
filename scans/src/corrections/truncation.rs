//! Extends the views of objects that are wider than the detector.

use crate::corrections::Correct;
use crate::diagnosis::line_integrals::check_line_integrals;
use crate::diagnosis::setup::setup;
use crate::diagnosis::truncation::truncation;
use conefield_core::Result;
use conefield_core::error::ensure;
use conefield_core::parallel;
use conefield_core::scan::Scan;
use conefield_core::words::counted;
use ndarray::{Array3, Axis, s};
use serde::{Deserialize, Serialize};
use std::f64::consts::FRAC_PI_2;

/// Extends rows that end in the object beyond the detector's sides, by point reflection about the last value, faded to
/// 0 (Ohnesorge et al., Med. Phys. 27(1), 2000). The detector becomes wider; one that is shifted on purpose, on a full
/// circle, only on the far side: what the near side lacks is measured from the opposite direction. Without the step at the side, the ramp
/// filter of `fdk` makes no bright rim. The new values are not measured: for methods that fit them, use
/// `scene.surround.coarse` of the spec instead.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Truncation {
    /// Number of columns added on either side, as a share of the detector's.
    pub share: f64,
}

impl Default for Truncation {
    fn default() -> Self {
        Self { share: 0.5 }
    }
}

impl Correct for Truncation {
    fn validate(&self) -> Result<()> {
        let fits = self.share > 0.0 && self.share <= 1.0;
        ensure(fits, "spec", "share", self.share, "a share of the detector's columns, above 0 and at most 1")
    }

    fn correct(&self, scan: &mut Scan) -> Result<String> {
        let (views, rows, columns) = scan.projections.dim();
        let (check, setup) = (check_line_integrals(scan.projections.view()), setup(&scan.geometry));
        let [left, right] = setup.open_sides();
        let cut = (truncation(scan.projections.view(), &setup, &check).views * views as f64).round();
        if cut == 0.0 {
            return Ok("the object reaches the sides of no view: nothing is added".into());
        }
        let more = ((self.share * columns as f64).ceil() as usize).min(columns.saturating_sub(1));
        let [before, after] = [left, right].map(|side| if side { more } else { 0 });
        let mut wide = Array3::zeros((views, rows, before + columns + after));
        parallel::over(wide.axis_iter_mut(Axis(0)).zip(scan.projections.axis_iter(Axis(0))), |_, (mut to, from)| {
            for (mut to, from) in to.rows_mut().into_iter().zip(from.rows()) {
                to.slice_mut(s![before..before + columns]).assign(&from);
                for k in 1..=more {
                    let fade = (FRAC_PI_2 * k as f64 / (more + 1) as f64).cos() as f32;
                    let goes_on = |last: usize, inner: usize| (2.0 * from[last] - from[inner]).max(0.0) * fade;
                    if left {
                        to[before - k] = goes_on(0, k);
                    }
                    if right {
                        to[before + columns - 1 + k] = goes_on(columns - 1, columns - 1 - k);
                    }
                }
            }
        });
        scan.projections = wide;
        scan.geometry.detector[1] = before + columns + after;
        // The measured columns stay where they are.
        let aside = (after as f64 - before as f64) / 2.0;
        for view in &mut scan.geometry.views {
            (0..3).for_each(|k| view.detector[k] += aside * view.u[k]);
        }
        let sides = if left && right { "on either side" } else { "on the far side" };
        let views = counted(views, "view");
        Ok(format!("the object reaches the sides of {cut} of {views}: {more} columns are added {sides}"))
    }
}
