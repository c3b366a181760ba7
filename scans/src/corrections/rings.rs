//! Ring artefacts, from a constant that a pixel adds to every view.
//!
//! A pixel whose gain differs from its flat field adds the same number to all of its line integrals. The object moves
//! over the detector from view to view; this number stays.

use crate::corrections::Correct;
use crate::diagnosis::quantiles::median;
use conefield_core::error::{Result, ensure};
use conefield_core::parallel;
use conefield_core::scan::Scan;
use ndarray::{Array2, ArrayView1, ArrayView2, Axis};
use serde::{Deserialize, Serialize};

/// Offsets within this many standard deviations of the median of sorted values count as chance.
const CHANCE: f32 = 3.0;

/// How the constant offset is separated from the object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RingMethod {
    /// The difference from a moving average along the row is the pixel's offset if it is constant over the views (Boin
    /// and Haibel, Optics Express 14(25), 2006). Medians replace both of their means: with few views each has a large
    /// weight, and edges of the object must not count.
    #[default]
    Median,
    /// Each pixel's values are sorted over the views: neighbours then differ little, wherever the object was. The
    /// difference of the sorted values from their moving median along the row is the pixel's offset (Vo, Atwood and
    /// Drakopoulos, Optics Express 26(22), 2018, algorithm 3). Its median over the ranks, reduced by its chance level,
    /// is subtracted from every view.
    Sorting,
}

/// Ring artefacts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Rings {
    /// How the constant offset is separated from the object.
    pub method: RingMethod,
    /// Width of the moving median along the row in pixels, odd. Corrects faults narrower than half of it. A wider
    /// window also removes more of the object where it stays in the same columns.
    pub window: usize,
}

impl Default for Rings {
    fn default() -> Self {
        Self { method: RingMethod::Median, window: 5 }
    }
}

impl Correct for Rings {
    fn validate(&self) -> Result<()> {
        let odd = self.window % 2 == 1 && self.window >= 3 && self.window <= 999;
        ensure(odd, "spec", "window", self.window, "an odd number of pixels from 3 to 999")
    }

    fn correct(&self, scan: &mut Scan) -> Result<String> {
        let columns = scan.geometry.detector[1];
        ensure(
            self.window <= columns,
            "spec",
            "window",
            self.window,
            format!("at most {columns}, a row of the detector"),
        )?;
        let own = |row: ArrayView2<'_, f32>| match self.method {
            RingMethod::Median => by_median(row, self.window),
            RingMethod::Sorting => by_sorting(row, self.window),
        };
        let mut squares = 0.0;
        let lines: Vec<Vec<f32>> = parallel::map(scan.projections.axis_iter(Axis(1)), |_, row| own(row));
        for (mut row, line) in scan.projections.axis_iter_mut(Axis(1)).zip(&lines) {
            squares += line.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>();
            for mut view in row.outer_iter_mut() {
                view.iter_mut().zip(line).for_each(|(x, own)| *x -= own);
            }
        }
        let pixels = (lines.len() * columns).max(1) as f64;
        Ok(format!("gains differ by {:.2} % (root mean square over the pixels)", 100.0 * (squares / pixels).sqrt()))
    }
}

/// The pixels' offsets in a row `[view, column]`.
fn by_median(row: ArrayView2<'_, f32>, window: usize) -> Vec<f32> {
    let own = differences(row, window);
    own.columns().into_iter().map(|views| median(&mut views.to_vec()).unwrap_or(0.0)).collect()
}

fn by_sorting(row: ArrayView2<'_, f32>, window: usize) -> Vec<f32> {
    let mut sorted = row.to_owned();
    for mut values in sorted.columns_mut() {
        let mut line = values.to_vec();
        line.sort_unstable_by(f32::total_cmp);
        values.iter_mut().zip(&line).for_each(|(x, y)| *x = *y);
    }
    let own = differences(sorted.view(), window);
    // 1.4826 makes the median of |x| the standard deviation of normal noise, and the median of n values spreads 1.2533/√n times as far.
    let by_chance = CHANCE * 1.4826 * 1.2533 / (row.nrows() as f32).sqrt();
    let of = |ranks: ArrayView1<'_, f32>| {
        let mut ranks = ranks.to_vec();
        let middle = median(&mut ranks).unwrap_or(0.0);
        ranks.iter_mut().for_each(|x| *x = (*x - middle).abs());
        let least = by_chance * median(&mut ranks).unwrap_or(0.0);
        middle.signum() * (middle.abs() - least).max(0.0)
    };
    own.columns().into_iter().map(of).collect()
}

/// The difference of each line of `[view, column]` from its moving median.
fn differences(lines: ArrayView2<'_, f32>, window: usize) -> Array2<f32> {
    let mut own = lines.to_owned();
    for mut line in own.rows_mut() {
        let smooth = moving_median(&line.to_vec(), window);
        line.iter_mut().zip(&smooth).for_each(|(x, s)| *x -= s);
    }
    own
}

/// The median of the `window` values around each value. The line is mirrored at its ends.
fn moving_median(line: &[f32], window: usize) -> Vec<f32> {
    let (n, reach) = (line.len() as isize, (window / 2) as isize);
    let mut around = Vec::with_capacity(window);
    let at = |i: isize| {
        if i < 0 {
            -1 - i
        } else if i >= n {
            2 * n - 1 - i
        } else {
            i
        }
    };
    let of = |i: isize| {
        around.clear();
        around.extend((i - reach..=i + reach).map(|k| line[at(k) as usize]));
        median(&mut around).unwrap_or(0.0)
    };
    (0..n).map(of).collect()
}
