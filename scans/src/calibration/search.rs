//! The search for the correction with the smallest held-out error of a level: a scan along single parameters where the
//! start may be far off, then Gauss-Newton steps in all parameters.
//!
//! The residual `r(θ)` of the held-out views depends on the correction `θ` through the whole reconstruction. Central
//! differences give its derivatives `J` for all parameters at once; a step solves `JᵀJ·δ = −Jᵀr` (Nocedal and Wright,
//! Numerical Optimization, section 10.3). Each view contributes its gradient `g_v = J_vᵀ·r_v`. The scatter of these
//! gradients gives the uncertainty of their sum: `cov θ = (JᵀJ)⁻¹·(Σ g_v·g_vᵀ)·(JᵀJ)⁻¹` (the sandwich of Huber, Proc.
//! 5th Berkeley Symposium, 1967, with views as clusters).

use crate::calibration::criterion::{Level, Prediction};
use crate::calibration::parameters::{Correction, Parameter};
use conefield_core::backend::Backend;
use conefield_core::matrix::{inner, inverse, product};
use conefield_core::parallel;
use conefield_core::{Error, Result};
use std::sync::{Mutex, PoisonError};

/// Half the distance of central differences, in pixels of a level.
pub(crate) const REACH: f64 = 0.5;
/// Longest step of a parameter, in pixels of a level.
pub(crate) const LONGEST: f64 = 2.0;
/// A step shorter than this, in pixels of a level, is the last one.
pub(crate) const SMALL: f64 = 0.01;
/// Correlation that errors of the reconstruction may have with the effect of a parameter.
const ALIKE: f64 = 0.03;
/// How often a step that does not reduce the error is cut to a third.
const CUTS: usize = 3;

/// Receives the progress of the work and can cancel it.
pub trait Watch: Sync {
    /// Whether the work is cancelled.
    fn cancelled(&self) -> bool {
        false
    }
    /// Reports the approximate share of the work that is done.
    fn progress(&self, _share: f64) {}
}

/// Counts the work for a [`Watch`].
pub(crate) struct Meter<'a> {
    pub watch: &'a dyn Watch,
    /// Approximate total work.
    pub total: f64,
    pub done: Mutex<f64>,
}

impl Meter<'_> {
    /// Adds finished work. Fails if the work is cancelled.
    pub(crate) fn count(&self, work: f64) -> Result<()> {
        let mut done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        *done += work;
        self.watch.progress((*done / self.total).min(0.99));
        if self.watch.cancelled() { Err(Error::Aborted { part: "calibration".into() }) } else { Ok(()) }
    }
}

/// A level with its backend and progress meter.
#[derive(Clone, Copy)]
pub(crate) struct Search<'a> {
    pub level: &'a Level,
    pub backend: &'a dyn Backend,
    pub meter: &'a Meter<'a>,
}

/// The result of the Gauss-Newton steps.
pub(crate) struct Fit {
    pub correction: Correction,
    pub prediction: Prediction,
    /// The fitted parameters.
    pub active: Vec<Parameter>,
    /// The change of each parameter that equals a pixel of the level.
    units: Vec<f64>,
    /// The last derivatives of the residuals by each parameter, per pixel.
    slopes: Vec<Slopes>,
}

/// The derivative of every residual, a list for each view.
type Slopes = Vec<Vec<f32>>;

/// The evidence of the views on one parameter.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Evidence {
    /// Standard deviation, as in a [`Correction`].
    pub deviation: f64,
    /// Change of the predicted views with it, relative to a shift by a pixel: near 0 if the views do not determine it.
    pub sensitivity: f64,
    /// Whether the correction improves the criterion significantly.
    pub sure: bool,
}

impl Search<'_> {
    pub fn predict(&self, correction: &Correction) -> Result<Prediction> {
        let found = self.level.predict(correction, self.backend, &|| self.meter.watch.cancelled())?;
        self.meter.count(self.level.work())?;
        Ok(found)
    }

    fn all(&self, corrections: &[Correction]) -> Result<Vec<Prediction>> {
        parallel::map(corrections, |_, c| self.predict(c)).into_iter().collect()
    }

    /// The errors for `values` of one parameter, with the others as in `at`.
    pub fn along(&self, parameter: Parameter, at: Correction, values: &[f64]) -> Result<Vec<(f64, f64)>> {
        let corrections: Vec<Correction> = values.iter().map(|&x| at.with(parameter, x)).collect();
        let errors = self.all(&corrections)?.into_iter().map(|p| p.error);
        Ok(values.iter().copied().zip(errors).collect())
    }

    /// Scans one parameter around `at`: `steps` steps of `pixels` pixels of the level to either side. Extends the
    /// range, up to `most` steps, while the best value lies at an end. Returns the best correction.
    pub fn scan(&self, parameter: Parameter, at: Correction, pixels: f64, steps: i32, most: i32) -> Result<Correction> {
        let (from, step) = (at.get(parameter), pixels * parameter.pixel(&self.level.geometry));
        let place = |i: i32| from + f64::from(i) * step;
        let (mut low, mut high) = (-steps, steps);
        let mut tried = self.along(parameter, at, &(low..=high).map(place).collect::<Vec<_>>())?;
        loop {
            let best = tried.iter().enumerate().min_by(|a, b| a.1.1.total_cmp(&b.1.1)).map_or(0, |(i, _)| i);
            let more: Vec<f64> = match best {
                0 if low > -most => (low - steps..low).map(place).collect(),
                i if i + 1 == tried.len() && high < most => (high + 1..=high + steps).map(place).collect(),
                i => return Ok(at.with(parameter, tried[i].0)),
            };
            let found = self.along(parameter, at, &more)?;
            if best == 0 {
                low -= steps;
                tried.splice(0..0, found);
            } else {
                high += steps;
                tried.extend(found);
            }
        }
    }

    /// At most `rounds` Gauss-Newton steps from `start` in the parameters `active`.
    pub fn refine(&self, active: &[Parameter], start: Correction, rounds: usize) -> Result<Fit> {
        let units: Vec<f64> = active.iter().map(|p| p.pixel(&self.level.geometry)).collect();
        let mut slopes = vec![];
        let mut step = |(here, prediction): &(Correction, Prediction)| {
            slopes = self.slopes(active, &units, *here)?;
            let normal = Normal::of(&slopes, prediction);
            Ok(solved(normal.matrix, &normal.gradient))
        };
        let steps = Steps { active, units: &units, rounds };
        let (correction, prediction) = steps.down(start, &|c| self.predict(c), &|p| p.error, &mut step)?;
        Ok(Fit { correction, prediction, active: active.to_vec(), units, slopes })
    }

    /// The fit without the change of one parameter. The derivatives give the best values of the others.
    pub fn without(&self, fit: Fit, parameter: Parameter) -> Result<Fit> {
        let Fit { correction, mut active, mut units, mut slopes, prediction } = fit;
        let Some(k) = active.iter().position(|p| *p == parameter) else {
            return Ok(Fit { correction, prediction, active, units, slopes });
        };
        let matrix = Normal::of(&slopes, &prediction).matrix;
        let back = -correction.get(parameter) / units[k];
        let others = |row: &[f64]| row.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, x)| *x).collect::<Vec<_>>();
        let coupling = others(&matrix[k]);
        let rest = matrix.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, row)| others(row)).collect();
        active.remove(k);
        units.remove(k);
        slopes.remove(k);
        let mut correction = correction.with(parameter, 0.0);
        for ((&p, unit), row) in active.iter().zip(&units).zip(inverse(damped(rest)).unwrap_or_default()) {
            correction = correction.with(p, correction.get(p) - unit * back * inner(&row, &coupling));
        }
        let prediction = self.predict(&correction)?;
        Ok(Fit { correction, prediction, active, units, slopes })
    }

    /// Derivatives of the residuals by each parameter, per pixel of the level.
    fn slopes(&self, active: &[Parameter], units: &[f64], at: Correction) -> Result<Vec<Slopes>> {
        let ends = active
            .iter()
            .zip(units)
            .flat_map(|(&p, unit)| [REACH, -REACH].map(|side| at.with(p, at.get(p) + side * unit)));
        let found = self.all(&ends.collect::<Vec<_>>())?;
        let between = |pair: &[Prediction]| -> Slopes {
            let views = pair[0].views.iter().zip(&pair[1].views);
            views.map(|(a, b)| a.iter().zip(b).map(|(a, b)| (a - b) / (2.0 * REACH as f32)).collect()).collect()
        };
        Ok(found.chunks(2).map(between).collect())
    }

    /// The evidence of the views on each parameter of a fit.
    pub fn evidence(&self, fit: &Fit) -> Vec<Evidence> {
        let Fit { slopes, prediction, units, .. } = fit;
        let normal = Normal::of(slopes, prediction);
        let pixels: usize = prediction.views.iter().map(Vec::len).sum();
        let sensitivity = |k: usize| (normal.matrix[k][k] / pixels as f64).sqrt() / self.level.slope.max(1e-300);
        let covariance = normal.covariance();
        let deviation = |k: usize| covariance.as_ref().map_or(f64::INFINITY, |c| c[k][k].max(0.0).sqrt());
        // The change that such a correlation leads to.
        let systematic = |k: usize| ALIKE * prediction.error * self.level.top / (sensitivity(k) * self.level.slope);
        (0..slopes.len())
            .map(|k| Evidence {
                deviation: units[k] * deviation(k).hypot(systematic(k)),
                sensitivity: sensitivity(k),
                sure: true,
            })
            .collect()
    }
}

/// The normal equations of a step.
struct Normal {
    /// `JᵀJ`.
    matrix: Vec<Vec<f64>>,
    /// `Jᵀr`.
    gradient: Vec<f64>,
    /// `J_vᵀ·r_v` of each view.
    views: Vec<Vec<f64>>,
}

impl Normal {
    fn of(slopes: &[Slopes], prediction: &Prediction) -> Self {
        let n = slopes.len();
        let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
        let entry = |i: usize, j: usize| slopes[i].iter().zip(&slopes[j]).map(|(a, b)| dot(a, b)).sum();
        let matrix = (0..n).map(|i| (0..n).map(|j| entry(i, j)).collect()).collect();
        let view = |(v, r): (usize, &Vec<f32>)| slopes.iter().map(|s| dot(&s[v], r)).collect();
        let views: Vec<Vec<f64>> = prediction.views.iter().enumerate().map(view).collect();
        let gradient = (0..n).map(|k| views.iter().map(|g| g[k]).sum()).collect();
        Self { matrix, gradient, views }
    }

    /// The sandwich covariance; `None` if the matrix has no inverse.
    fn covariance(&self) -> Option<Vec<Vec<f64>>> {
        let (n, count) = (self.gradient.len(), self.views.len() as f64);
        let inverse = inverse(self.matrix.clone())?;
        // The sum is not exactly zero at the end of the search; this remainder belongs to no single view.
        let mean: Vec<f64> = self.gradient.iter().map(|g| g / count).collect();
        let spread = |i: usize, j: usize| {
            let sum: f64 = self.views.iter().map(|g| (g[i] - mean[i]) * (g[j] - mean[j])).sum();
            sum * count / (count - 1.0).max(1.0)
        };
        let middle: Vec<Vec<f64>> = (0..n).map(|i| (0..n).map(|j| spread(i, j)).collect()).collect();
        Some(product(&product(&inverse, &middle), &inverse))
    }
}

/// The step, in pixels of each parameter, that solves the equations of a `matrix` of second and a `gradient` of first
/// derivatives; `None` if they have no solution.
pub(crate) fn solved(matrix: Vec<Vec<f64>>, gradient: &[f64]) -> Option<Vec<f64>> {
    Some(inverse(damped(matrix))?.iter().map(|row| -inner(row, gradient)).collect())
}

/// The step in each active parameter from a correction with what was found there, or `None` at the end.
pub(crate) type NextStep<'a, T> = dyn FnMut(&(Correction, T)) -> Result<Option<Vec<f64>>> + 'a;

/// At most `rounds` steps in the parameters `active`, whose pixels are `units`.
pub(crate) struct Steps<'a> {
    pub active: &'a [Parameter],
    pub units: &'a [f64],
    pub rounds: usize,
}

impl Steps<'_> {
    /// From `start`, moves by the first of ever shorter parts of each `step` at which `error` falls. Ends if there is no
    /// step, if the error falls at none of its parts, or after a short step. Returns the last correction with what is found there.
    pub fn down<T>(
        &self,
        start: Correction,
        at: &dyn Fn(&Correction) -> Result<T>,
        error: &dyn Fn(&T) -> f64,
        step: &mut NextStep<'_, T>,
    ) -> Result<(Correction, T)> {
        let mut here = (start, at(&start)?);
        // Without parameters there is nothing to fit.
        let rounds = if self.active.is_empty() { 0 } else { self.rounds };
        'steps: for _ in 0..rounds {
            let Some(step) = step(&here)? else { break };
            let longest = step.iter().fold(0.0f64, |m, s| m.max(s.abs()));
            let mut share = (LONGEST / longest.max(1e-12)).min(1.0);
            for _ in 0..=CUTS {
                let moves = self.active.iter().zip(self.units).zip(&step);
                let there = moves.fold(here.0, |c, ((&p, unit), s)| c.with(p, c.get(p) + share * s * unit));
                let found = at(&there)?;
                if error(&found) < error(&here.1) {
                    here = (there, found);
                    if share * longest < SMALL { break 'steps } else { continue 'steps }
                }
                share /= 3.0;
            }
            break;
        }
        Ok(here)
    }
}

/// Adds a small number to the diagonal: a parameter that the views do not determine then keeps its value.
fn damped(mut matrix: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
    let most = (0..matrix.len()).map(|k| matrix[k][k]).fold(0.0, f64::max);
    for (k, row) in matrix.iter_mut().enumerate() {
        row[k] += 1e-6 * most;
    }
    matrix
}
