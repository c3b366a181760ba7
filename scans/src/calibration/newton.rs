//! The search for the geometry in which pairs of views are consistent.
//!
//! The residuals of pairs are mostly noise, and so are their derivatives: in `JᵀJ` of Gauss-Newton, noise would appear
//! as steepness of the criterion. The curvature of the criterion itself has no such term, because noise contributes the
//! same in every geometry. So the steps are Newton's, `H·δ = −g`, with gradient and curvature from differences of the
//! criterion.
//!
//! The jackknife gives the uncertainty: the scatter of the step when each view in turn is removed (Efron and Stein,
//! Annals of Statistics 9, 1981). It includes the noise of the curvature.

use crate::calibration::CLEAR;
use crate::calibration::consistency::Consistency;
use crate::calibration::parameters::{Correction, Parameter};
use crate::calibration::search::{Evidence, Meter, REACH, Steps, solved};
use conefield_core::Result;
use conefield_core::parallel;

/// The pairs with their progress meter.
#[derive(Clone, Copy)]
pub(crate) struct Newton<'a> {
    pub pairs: &'a Consistency,
    pub meter: &'a Meter<'a>,
}

/// The result of Newton's steps.
pub(crate) struct Place {
    pub correction: Correction,
    /// The fitted parameters.
    pub active: Vec<Parameter>,
    /// The evidence of the pairs on each.
    pub evidence: Vec<Evidence>,
}

/// A correction with the misfit of each pair.
type Misfits = (Correction, Vec<f64>);

/// Derivatives of each pair's criterion, per pixel of each parameter.
struct Around {
    /// By parameter.
    gradient: Vec<Vec<f64>>,
    /// By two parameters.
    curvature: Vec<Vec<Vec<f64>>>,
}

impl Newton<'_> {
    pub fn misfits(&self, correction: &Correction) -> Result<Vec<f64>> {
        let found = self.pairs.misfits(correction);
        self.meter.count(self.pairs.work())?;
        Ok(found)
    }

    /// The errors for `values` of one parameter, with the others as in `at`.
    pub fn along(&self, parameter: Parameter, at: Correction, values: &[f64]) -> Result<Vec<(f64, f64)>> {
        let error = |&x: &f64| Ok((x, self.pairs.error(&self.misfits(&at.with(parameter, x))?)));
        parallel::map(values, |_, x| error(x)).into_iter().collect()
    }

    /// At most `rounds` steps from `start` in the parameters `active`.
    pub fn refine(&self, active: &[Parameter], start: Correction, rounds: usize) -> Result<Place> {
        let units: Vec<f64> = active.iter().map(|p| p.pixel(&self.pairs.geometry)).collect();
        let mut evidence = vec![];
        let mut step = |here: &Misfits| {
            let around = self.around(active, &units, here)?;
            evidence = self.evidence(&around, &units);
            Ok(around.step(None))
        };
        let steps = Steps { active, units: &units, rounds };
        let here = steps.down(start, &|c| self.misfits(c), &|m| m.iter().sum(), &mut step)?;
        for (one, &p) in evidence.iter_mut().zip(active) {
            one.sure = self.surely_better(&here.1, &self.misfits(&here.0.with(p, 0.0))?);
        }
        Ok(Place { correction: here.0, active: active.to_vec(), evidence })
    }

    fn around(&self, active: &[Parameter], units: &[f64], here: &Misfits) -> Result<Around> {
        let n = active.len();
        let moved = |sides: &[(usize, f64)]| {
            let to = |c: Correction, &(k, side): &(usize, f64)| c.with(active[k], c.get(active[k]) + side * units[k]);
            sides.iter().fold(here.0, to)
        };
        let ends = (0..n).flat_map(|k| [REACH, -REACH].map(|side| moved(&[(k, side)])));
        let corners = (0..n).flat_map(|k| (0..k).map(move |l| [(k, REACH), (l, REACH)]));
        let places: Vec<Correction> = ends.chain(corners.map(|sides| moved(&sides))).collect();
        let found = parallel::map(&places, |_, c| self.misfits(c)).into_iter().collect::<Result<Vec<_>>>()?;
        let (ends, corners) = found.split_at(2 * n);
        let pairs = 0..here.1.len();
        let [up, down] = [0, 1].map(|side| (0..n).map(|k| &ends[2 * k + side]).collect::<Vec<_>>());
        let gradient = |k: usize| pairs.clone().map(|p| (up[k][p] - down[k][p]) / (4.0 * REACH)).collect();
        let curvature = |k: usize, l: usize| -> Vec<f64> {
            let (k, l) = (k.max(l), k.min(l));
            let of = |p: usize| match k == l {
                true => up[k][p] + down[k][p] - 2.0 * here.1[p],
                false => corners[k * (k - 1) / 2 + l][p] - up[k][p] - up[l][p] + here.1[p],
            };
            pairs.clone().map(|p| of(p) / (2.0 * REACH * REACH)).collect()
        };
        Ok(Around {
            gradient: (0..n).map(gradient).collect(),
            curvature: (0..n).map(|k| (0..n).map(|l| curvature(k, l)).collect()).collect(),
        })
    }

    /// Whether the criterion falls by more than the pairs of single views can explain. Noise alone also has minima, far
    /// from the truth where the object contributes little, and each has a positive curvature.
    fn surely_better(&self, here: &[f64], there: &[f64]) -> bool {
        let pairs = self.pairs.pairs();
        let mut views = vec![0.0; self.pairs.geometry.views.len()];
        for ((a, b), pair) in there.iter().zip(here).zip(&pairs) {
            pair.iter().for_each(|&v| views[v] += a - b);
        }
        // Every pair belongs to two views.
        let all = views.iter().sum::<f64>() / 2.0;
        all > CLEAR * jackknife(&views)
    }

    /// The evidence of the pairs on each parameter.
    fn evidence(&self, around: &Around, units: &[f64]) -> Vec<Evidence> {
        let pairs = self.pairs.pairs();
        let views = pairs.iter().flatten().max().map_or(0, |v| v + 1);
        let without = |v: usize| around.step(Some(&|p: usize| !pairs[p].contains(&v)));
        let steps: Option<Vec<Vec<f64>>> = (0..views).map(without).collect();
        let deviation = |k: usize| {
            let Some(steps) = &steps else { return f64::INFINITY };
            jackknife(&steps.iter().map(|s| s[k]).collect::<Vec<_>>())
        };
        let sensitivity = |k: usize| {
            let sum: f64 = around.curvature[k][k].iter().sum();
            (sum.max(0.0) / self.pairs.planes() as f64).sqrt() / self.pairs.steepness.max(1e-300)
        };
        let of = |(k, unit): (usize, &f64)| Evidence {
            deviation: unit * deviation(k),
            sensitivity: sensitivity(k),
            sure: false,
        };
        units.iter().enumerate().map(of).collect()
    }
}

/// The standard deviation of an estimate, from its values without each view or from the contribution of each view.
fn jackknife(values: &[f64]) -> f64 {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    (values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() * (n - 1.0) / n).sqrt()
}

impl Around {
    /// Newton's step from some of the pairs; `None` if they have no curvature.
    fn step(&self, some: Option<&dyn Fn(usize) -> bool>) -> Option<Vec<f64>> {
        let sum = |of: &Vec<f64>| {
            of.iter().enumerate().filter(|(p, _)| some.is_none_or(|s| s(*p))).map(|(_, x)| x).sum::<f64>()
        };
        let matrix = self.curvature.iter().map(|row| row.iter().map(sum).collect()).collect();
        let gradient: Vec<f64> = self.gradient.iter().map(sum).collect();
        solved(matrix, &gradient)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::consistency::tests::{Silent, scan};
    use std::sync::Mutex;

    #[test]
    fn distance_and_step_are_found_within_their_uncertainty() {
        let active = [Parameter::OffsetV, Parameter::Distance, Parameter::Step];
        let right = scan(24, 0.003);
        let meter = Meter { watch: &Silent, total: 1.0, done: Mutex::new(0.0) };
        for off in
            [Correction::default(), Correction::default().with(Parameter::Distance, -40.0).with(Parameter::Step, 0.01)]
        {
            let mut wrong = right.clone();
            wrong.geometry.views = off.views(&wrong.geometry.views);
            let pairs = Consistency::new(&wrong, 96, &Correction::default()).unwrap();
            let found = Newton { pairs: &pairs, meter: &meter }.refine(&active, Correction::default(), 8).unwrap();
            for (p, evidence) in active.iter().zip(&found.evidence) {
                // The step is a factor: 1/1.01 reverses 1.01.
                let truth = -off.get(*p) / if *p == Parameter::Step { 1.0 + off.get(*p) } else { 1.0 };
                let (value, pixel) = (found.correction.get(*p), p.pixel(&pairs.geometry));
                let allowed = 3.0 * evidence.deviation + 0.05 * pixel;
                assert!((value - truth).abs() < allowed, "{p}: {value} ± {} of {truth}", evidence.deviation);
                assert!(evidence.deviation < 0.5 * pixel, "{p}: ± {} of {pixel}", evidence.deviation);
            }
        }
    }
}
