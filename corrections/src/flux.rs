//! The brightness of each view.

use crate::Correct;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::scan::Scan;
use conefield_diagnosis::border::border_medians;
use conefield_diagnosis::quantiles::{median, quantile};
use ndarray::{ArrayView2, s};
use serde::{Deserialize, Serialize};

/// Where the border tells: this share of its pieces is taken for air, as where `import` looks for the open beam.
const AIR: f64 = 0.15;
/// Pieces that lie above that by no more than so many times what the lowest lies below it are air, too.
const NOISE: f32 = 3.0;
/// No tube is so far off from one view to another: a view in which air seems to absorb more shows something else there.
const MOST: f32 = 0.5;

/// A tube that shines `k` times as bright in one view as in the flat field takes `ln k` off every line integral of that view. What air
/// shows, where nothing absorbs, tells how much: it is taken off the whole view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Flux {
    /// The first row of a region that shows air in every view, and the one after its last; all rows if not said.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rows: Option<[usize; 2]>,
    /// Its columns; all if not said. With neither, the border of each view tells: of 16 pieces of it some must show air.
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
            let found = format!("line integrals of {:.3} where air is looked for in view {view}", air[view]);
            let expected = format!("at most {MOST} in air; flux.rows and flux.columns tell where air is in every view");
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
    /// What air shows in a view.
    fn air(&self, view: ArrayView2<'_, f32>) -> f32 {
        if self.rows.is_none() && self.columns.is_none() {
            let pieces = border_medians(view, |_, _| true);
            let (low, air) = (pieces.first().copied().unwrap_or(0.0), quantile(&pieces, AIR).unwrap_or(0.0));
            // All pieces that differ by noise: the lowest ones alone would be too low.
            let all: Vec<f32> = pieces.into_iter().filter(|p| *p <= air + NOISE * (air - low)).collect();
            return all.iter().sum::<f32>() / all.len().max(1) as f32;
        }
        let [rows, columns] = [view.nrows(), view.ncols()];
        let ([top, bottom], [left, right]) = (self.rows.unwrap_or([0, rows]), self.columns.unwrap_or([0, columns]));
        median(&mut view.slice(s![top..bottom, left..right]).iter().copied().collect::<Vec<_>>()).unwrap_or(0.0)
    }
}
