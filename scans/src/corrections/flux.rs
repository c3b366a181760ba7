//! The brightness of each view.

use crate::corrections::Correct;
use crate::diagnosis::border::border_medians;
use crate::diagnosis::quantiles::{middle, quantile};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::scan::Scan;
use ndarray::{ArrayView2, s};
use serde::{Deserialize, Serialize};

/// Share of the border segments that counts as air, as in `import`'s search for the open beam.
const AIR: f64 = 0.15;
/// Segments above this level are air too, up to this multiple of the distance from the lowest segment to the level.
const NOISE: f32 = 3.0;
/// No tube varies by more than this between views: a larger line integral in air means that the region shows something
/// else.
const MOST: f32 = 0.5;

/// Corrects the tube's brightness. A tube that is `k` times as bright in a view as in the flat field lowers every line
/// integral of this view by `ln k`. The value in air, where nothing absorbs, shows this offset; it is subtracted from
/// the whole view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Flux {
    /// The first row of a region that shows air in every view, and the one after its last; all rows if absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rows: Option<[usize; 2]>,
    /// Its columns; all if absent. With neither, the border of each view is used: some of its 16 segments must show
    /// air.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub columns: Option<[usize; 2]>,
}

impl Correct for Flux {
    fn validate(&self) -> Result<()> {
        for (name, range) in [("rows", self.rows), ("columns", self.columns)] {
            let Some([from, to]) = range else { continue };
            ensure(from < to, "spec", name, format!("[{from}, {to}]"), "the first one and the one after the last")?;
        }
        Ok(())
    }

    fn correct(&self, scan: &mut Scan) -> Result<String> {
        let [rows, columns] = scan.geometry.detector;
        for (name, range, n) in [("rows", self.rows, rows), ("columns", self.columns, columns)] {
            let Some([from, to]) = range else { continue };
            ensure(to <= n, "spec", name, format!("[{from}, {to}]"), format!("at most {n}, which the detector has"))?;
        }
        let air = scan.projections.outer_iter().map(|v| self.air(v)).collect::<Vec<f32>>();
        if let Some(view) = air.iter().position(|a| a.abs() > MOST) {
            let found = format!("line integrals of {:.3} in the air region of view {view}", air[view]);
            let expected =
                format!("at most {MOST} in air; flux.rows and flux.columns select a region of air in every view");
            return Err(Error::invalid("spec", "rows", found, expected));
        }
        for (mut view, &air) in scan.projections.outer_iter_mut().zip(&air) {
            view -= air;
        }
        let brightness = |a: f32| 100.0 * (-f64::from(a)).exp();
        let (low, high) = air.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), &a| (l.min(a), h.max(a)));
        Ok(format!("views of {:.1} to {:.1} % of the open beam", brightness(high), brightness(low)))
    }
}

impl Flux {
    /// The line integral of air in a view.
    fn air(&self, view: ArrayView2<'_, f32>) -> f32 {
        if self.rows.is_none() && self.columns.is_none() {
            let pieces = border_medians(view, |_, _| true);
            let (low, air) = (pieces.first().copied().unwrap_or(0.0), quantile(&pieces, AIR).unwrap_or(0.0));
            // The mean of all segments that differ only by noise; the lowest ones alone would be too low.
            let all: Vec<f32> = pieces.into_iter().filter(|p| *p <= air + NOISE * (air - low)).collect();
            return all.iter().sum::<f32>() / all.len().max(1) as f32;
        }
        let [rows, columns] = [view.nrows(), view.ncols()];
        let ([top, bottom], [left, right]) = (self.rows.unwrap_or([0, rows]), self.columns.unwrap_or([0, columns]));
        middle(view.slice(s![top..bottom, left..right]))
    }
}
