//! Pixels that do not measure, detected from their values over the views.

use crate::corrections::Correct;
use crate::corrections::filling::Filling;
use crate::diagnosis::bad_pixels::{neighbours, outliers};
use crate::diagnosis::quantiles::{median, quantile, sorted_sample};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::parallel;
use conefield_core::scan::Scan;
use ndarray::{Array2, ArrayView3, Axis};
use serde::{Deserialize, Serialize};

/// Least number of views for judging a pixel over the views.
const LEAST_VIEWS: usize = 16;
/// A pixel that changes over the views by less than this share of its neighbours' change is dead.
const STUCK: f32 = 0.1;
/// A flickering pixel differs from its neighbours by this share of the range of the line integrals, ...
const RESTLESS: f32 = 0.02;
/// ... and a single outlier by this share.
const STANDS_OUT: f32 = 0.1;
/// Columns examined at once: a thread holds their differences for all views.
const STRIP: usize = 64;
/// With a larger share of bad values, the scan is wrong, not the detector.
const MOST: f64 = 0.2;

/// Dead, hot and flickering pixels, and single outliers (cosmic rays): each gets the mean of the good pixels around it,
/// weighted by one over their squared distance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Pixels {
    /// A value is an outlier above this many standard deviations of the noise of its neighbours.
    pub deviations: f32,
}

impl Default for Pixels {
    fn default() -> Self {
        Self { deviations: 8.0 }
    }
}

impl Correct for Pixels {
    fn validate(&self) -> Result<()> {
        let d = self.deviations;
        ensure(d.is_finite() && d >= 3.0, "spec", "deviations", d, "a number of standard deviations, 3 or more")
    }

    fn correct(&self, scan: &mut Scan) -> Result<String> {
        let values = &mut scan.projections;
        let [rows, columns] = scan.geometry.detector;
        let range = range(values.view());
        let mut bad = Array2::from_elem((rows, columns), false);
        let (mut stuck, mut restless) = (0, 0);
        if values.dim().0 >= LEAST_VIEWS {
            let [changes, flickers] = over_time(values.view());
            for ((at, &change), &flicker) in changes.indexed_iter().zip(&flickers) {
                let [changes, flickers] = [&changes, &flickers].map(|a| {
                    let mut around = Vec::with_capacity(8);
                    neighbours(a.view(), at, Some(&bad), &mut around);
                    around.sort_unstable_by(f32::total_cmp);
                    around
                });
                // Along an edge of the object two neighbours flicker as well.
                let (Some(usual), Some(most)) =
                    (changes.get(changes.len().saturating_sub(1) / 2), flickers.iter().nth_back(1))
                else {
                    continue;
                };
                if change < STUCK * usual {
                    (bad[at], stuck) = (true, stuck + 1);
                } else if flicker > self.deviations * most && flicker > RESTLESS * range {
                    (bad[at], restless) = (true, restless + 1);
                }
            }
        }
        let staying = outliers(values.view(), &bad);
        staying.iter().for_each(|&at| bad[at] = true);
        let whole = bad.iter().filter(|b| **b).count();
        few(whole, rows * columns, "pixels")?;
        if let Some(filling) = Filling::new(&bad) {
            parallel::over(values.axis_iter_mut(Axis(0)), |_, v| filling.fill(v));
        }
        let single = parallel::map(values.axis_iter_mut(Axis(0)), |_, view| self.single(view, range));
        let single = single.iter().sum::<usize>();
        few(single, values.len(), "values")?;
        Ok(format!(
            "{stuck} dead, {restless} flickering and {} other pixels that stand out in nearly every view; {single} single values",
            staying.len()
        ))
    }
}

impl Pixels {
    /// Fills in the outliers of one view and returns their number.
    fn single(&self, mut view: ndarray::ArrayViewMut2<'_, f32>, range: f32) -> usize {
        let mut bad = Array2::from_elem(view.dim(), false);
        let mut around = Vec::with_capacity(8);
        for (at, &x) in view.indexed_iter() {
            neighbours(view.view(), at, None, &mut around);
            around.sort_unstable_by(f32::total_cmp);
            let n = around.len();
            if n < 3 {
                continue;
            }
            let beyond = (x - around[n / 2]).max(around[(n - 1) / 2] - x);
            // The quartiles of normal noise are 1.35 standard deviations apart.
            let noise = (around[n - 1 - n / 4] - around[n / 4]) / 1.35;
            bad[at] = beyond > self.deviations * noise && beyond > STANDS_OUT * range;
        }
        let count = bad.iter().filter(|b| **b).count();
        if count > 0
            && let Some(filling) = Filling::new(&bad)
        {
            filling.fill(view.view_mut());
        }
        count
    }
}

fn few(bad: usize, all: usize, what: &str) -> Result<()> {
    let most = format!("fewer than a fifth of {all}: is this a scan of line integrals?");
    match bad as f64 > MOST * all as f64 {
        true => Err(Error::invalid("spec", "deviations", format!("{bad} {what} that do not measure"), most)),
        false => Ok(()),
    }
}

/// The range of the line integrals, without one percent at either end.
fn range(values: ArrayView3<'_, f32>) -> f32 {
    let sample = sorted_sample(values);
    let at = |share| quantile(&sample, share).unwrap_or(0.0);
    at(0.99) - at(0.01)
}

/// For each pixel: the change of its value over the views (mean distance from the mean), and the change of its
/// difference from its neighbours (median distance from the median).
fn over_time(values: ArrayView3<'_, f32>) -> [Array2<f32>; 2] {
    let (views, rows, columns) = values.dim();
    let (mut changes, mut flickers) = (Array2::zeros((rows, columns)), Array2::zeros((rows, columns)));
    let lines = changes.outer_iter_mut().zip(flickers.outer_iter_mut());
    parallel::over(lines, |r, (mut changes, mut flickers)| {
        let mut around = Vec::with_capacity(8);
        let mut strip = vec![Vec::with_capacity(views); STRIP.min(columns)];
        for first in (0..columns).step_by(STRIP) {
            let pixels = || (first..columns).zip(0..STRIP);
            strip.iter_mut().for_each(Vec::clear);
            for view in values.outer_iter() {
                for (c, k) in pixels() {
                    neighbours(view, (r, c), None, &mut around);
                    strip[k].push(view[[r, c]] - median(&mut around).unwrap_or(0.0));
                }
            }
            for (c, k) in pixels() {
                let own = values.slice(ndarray::s![.., r, c]);
                let mean = own.sum() / views as f32;
                changes[c] = own.iter().map(|x| (x - mean).abs()).sum::<f32>() / views as f32;
                let apart = &mut strip[k];
                let middle = median(apart).unwrap_or(0.0);
                apart.iter_mut().for_each(|x| *x = (*x - middle).abs());
                flickers[c] = median(apart).unwrap_or(0.0);
            }
        }
    });
    [changes, flickers]
}
