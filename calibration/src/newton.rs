//! The search for the geometry in which pairs of views say the same.
//!
//! The residuals of pairs are mostly noise, and their derivatives are too: `JᵀJ` of Gauss and Newton would take noise for a criterion
//! that is steep. The curvature of the criterion itself has no such part, since noise adds the same in every geometry. So these are
//! Newton's steps, `H·δ = −g`, with gradient and curvature from differences of the criterion.
//!
//! The uncertainty is the jackknife's: how far the step would go without one of the views, for each of them (Efron and Stein, Annals of
//! Statistics 9, 1981). It sees the noise of the curvature too.

use crate::CLEAR;
use crate::consistency::Consistency;
use crate::parameters::{Correction, Parameter};
use crate::search::{LONGEST, Meter, REACH, SMALL, Told, damped, inner, inverse};
use conefield_core::Result;
use rayon::prelude::*;

/// How often a step that does not help is cut to a third.
const CUTS: usize = 3;

/// The pairs with what counts the work on them.
#[derive(Clone, Copy)]
pub(crate) struct Newton<'a> {
    pub pairs: &'a Consistency,
    pub meter: &'a Meter<'a>,
}

/// Where Newton's steps ended.
pub(crate) struct Place {
    pub correction: Correction,
    /// The parameters that were looked for.
    pub active: Vec<Parameter>,
    /// What the pairs tell of each.
    pub told: Vec<Told>,
}

/// A correction with the misfit of each pair.
type Misfits = (Correction, Vec<f64>);

/// The criterion around a place, of each pair: all in pixels of the parameters.
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

    /// The errors of `values` for one parameter, all else as in `at`.
    pub fn along(&self, parameter: Parameter, at: Correction, values: &[f64]) -> Result<Vec<(f64, f64)>> {
        let error = |&x: &f64| Ok((x, self.pairs.error(&self.misfits(&at.with(parameter, x))?)));
        values.par_iter().map(error).collect()
    }

    /// Steps from `start` in some parameters, at most `rounds`.
    pub fn refine(&self, active: &[Parameter], start: Correction, rounds: usize) -> Result<Place> {
        let units: Vec<f64> = active.iter().map(|p| p.pixel(&self.pairs.geometry)).collect();
        let mut here = (start, self.misfits(&start)?);
        let mut told = vec![];
        for _ in 0..rounds.min(rounds * active.len()) {
            let around = self.around(active, &units, &here)?;
            told = self.told(&around, &units);
            let Some(step) = around.step(None) else { break };
            let longest = step.iter().fold(0.0f64, |m, s| m.max(s.abs()));
            let share = (LONGEST / longest.max(1e-12)).min(1.0);
            let Some((next, share)) = self.better(active, &units, &here, &step, share)? else { break };
            here = next;
            if share * longest < SMALL {
                break;
            }
        }
        for (told, &p) in told.iter_mut().zip(active) {
            told.sure = self.surely_better(&here.1, &self.misfits(&here.0.with(p, 0.0))?);
        }
        Ok(Place { correction: here.0, active: active.to_vec(), told })
    }

    /// The first of ever shorter steps with a smaller criterion.
    fn better(
        &self,
        active: &[Parameter],
        units: &[f64],
        here: &Misfits,
        step: &[f64],
        mut share: f64,
    ) -> Result<Option<(Misfits, f64)>> {
        let before: f64 = here.1.iter().sum();
        for _ in 0..=CUTS {
            let moves = active.iter().zip(units).zip(step);
            let there = moves.fold(here.0, |c, ((&p, unit), s)| c.with(p, c.get(p) + share * s * unit));
            let found = self.misfits(&there)?;
            if found.iter().sum::<f64>() < before {
                return Ok(Some(((there, found), share)));
            }
            share /= 3.0;
        }
        Ok(None)
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
        let found: Vec<Vec<f64>> = places.par_iter().map(|c| self.misfits(c)).collect::<Result<_>>()?;
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

    /// Whether the criterion falls by more than the pairs of single views can make it fall: noise alone has lows too, far off where the
    /// object tells little, and each of them looks like a bowl from inside.
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

    /// What the pairs tell of each parameter.
    fn told(&self, around: &Around, units: &[f64]) -> Vec<Told> {
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
        let of = |(k, unit): (usize, &f64)| Told {
            deviation: unit * deviation(k),
            sensitivity: sensitivity(k),
            sure: false,
        };
        units.iter().enumerate().map(of).collect()
    }
}

/// The standard deviation of an estimate from its values without each of the views, or from what each view adds to it.
fn jackknife(values: &[f64]) -> f64 {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    (values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() * (n - 1.0) / n).sqrt()
}

impl Around {
    /// Newton's step by some of the pairs; `None` where they have no curvature.
    fn step(&self, some: Option<&dyn Fn(usize) -> bool>) -> Option<Vec<f64>> {
        let sum = |of: &Vec<f64>| {
            of.iter().enumerate().filter(|(p, _)| some.is_none_or(|s| s(*p))).map(|(_, x)| x).sum::<f64>()
        };
        let matrix = self.curvature.iter().map(|row| row.iter().map(sum).collect()).collect();
        let gradient: Vec<f64> = self.gradient.iter().map(sum).collect();
        Some(inverse(damped(matrix))?.iter().map(|row| -inner(row, &gradient)).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::consistency::tests::scan;
    use crate::search::Watch;
    use std::sync::Mutex;

    struct Nobody;

    impl Watch for Nobody {
        fn cancelled(&self) -> bool {
            false
        }
        fn progress(&self, _: f64) {}
    }

    #[test]
    fn distance_and_step_are_found_within_what_is_said_of_them() {
        let active = [Parameter::OffsetV, Parameter::Distance, Parameter::Step];
        let right = scan(24, 0.003);
        let meter = Meter { watch: &Nobody, total: 1.0, done: Mutex::new(0.0) };
        for off in
            [Correction::default(), Correction::default().with(Parameter::Distance, -40.0).with(Parameter::Step, 0.01)]
        {
            let mut told = right.clone();
            told.geometry.views = off.views(&told.geometry.views);
            let pairs = Consistency::new(&told, 96, &Correction::default()).unwrap();
            let found = Newton { pairs: &pairs, meter: &meter }.refine(&active, Correction::default(), 8).unwrap();
            for (p, told) in active.iter().zip(&found.told) {
                // The step is a factor: 1.01 is taken back by 1/1.01.
                let truth = -off.get(*p) / if *p == Parameter::Step { 1.0 + off.get(*p) } else { 1.0 };
                let (value, pixel) = (found.correction.get(*p), p.pixel(&pairs.geometry));
                let allowed = 3.0 * told.deviation + 0.05 * pixel;
                assert!((value - truth).abs() < allowed, "{p}: {value} ± {} of {truth}", told.deviation);
                assert!(told.deviation < 0.5 * pixel, "{p}: ± {} of {pixel}", told.deviation);
            }
        }
    }
}
