//! What a pixel adds to every view, which becomes a ring.
//!
//! A pixel whose gain is not that of its flat field adds one number to all of its line integrals. The object moves over the
//! detector from view to view, that number stays.

use crate::Correct;
use conefield_core::error::{Result, ensure};
use conefield_core::scan::Scan;
use conefield_diagnosis::quantiles::median;
use ndarray::{Array2, ArrayView2, Axis};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How what stays is told from the object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RingMethod {
    /// Each pixel's values are sorted over the views: neighbours then differ little, wherever the object was. What a moving
    /// median along the row takes off the sorted values is the pixel's own (Vo, Atwood and Drakopoulos, Optics Express 26(22), 2018,
    /// algorithm 3). Of that the median over all ranks is taken off every view.
    #[default]
    Sorting,
    /// What a moving median along the row takes off the mean of all views (Boin and Haibel, Optics Express 14(25), 2006, with
    /// the median in place of their moving average).
    Mean,
}

/// Ring artefacts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Rings {
    /// How what stays is told from the object.
    pub method: RingMethod,
    /// Pixels along the row over which the median moves, odd. Faults that are half as wide are mended.
    pub window: usize,
}

impl Default for Rings {
    fn default() -> Self {
        Self { method: RingMethod::Sorting, window: 11 }
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
            RingMethod::Sorting => by_sorting(row, self.window),
            RingMethod::Mean => by_mean(row, self.window),
        };
        let mut squares = 0.0;
        let lines: Vec<Vec<f32>> = scan.projections.axis_iter(Axis(1)).into_par_iter().map(own).collect();
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

/// What is the pixels' own in a row `[view, column]`.
fn by_sorting(row: ArrayView2<'_, f32>, window: usize) -> Vec<f32> {
    let (views, columns) = row.dim();
    let mut sorted = Array2::zeros((columns, views));
    for (values, mut out) in row.columns().into_iter().zip(sorted.outer_iter_mut()) {
        let mut line = values.to_vec();
        line.sort_unstable_by(f32::total_cmp);
        out.iter_mut().zip(&line).for_each(|(x, y)| *x = *y);
    }
    let mut own = Array2::zeros((columns, views));
    for rank in 0..views {
        let line = sorted.column(rank).to_vec();
        let smooth = moving_median(&line, window);
        for c in 0..columns {
            own[[c, rank]] = line[c] - smooth[c];
        }
    }
    own.outer_iter().map(|ranks| median(&mut ranks.to_vec()).unwrap_or(0.0)).collect()
}

fn by_mean(row: ArrayView2<'_, f32>, window: usize) -> Vec<f32> {
    let mean: Vec<f32> = row
        .columns()
        .into_iter()
        .map(|c| (c.iter().map(|&x| f64::from(x)).sum::<f64>() / c.len().max(1) as f64) as f32)
        .collect();
    moving_median(&mean, window).iter().zip(&mean).map(|(smooth, x)| x - smooth).collect()
}

/// The median of the `window` values around each. At the ends the line goes on as its mirror image.
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
