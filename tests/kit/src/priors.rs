//! Properties of a prior of a field: a correct gradient, additive sums, behaviour for extreme numbers.

use crate::call::{Draw, Guarded, beside_others, error, no_fault, require, settle, within};
use crate::gradients::slope;
use crate::{Outcome, Report};
use conefield_core::prior::Prior;
use conefield_core::runner::Runner;

/// Largest error of the gradient against differences, relative to the largest derivative.
const TOLERANCE: f64 = 1e-6;
/// Largest error of the WGSL in single precision, relative to the penalty or the largest derivative.
const SINGLE: f64 = 2e-5;
/// Maximum number of values differenced one by one.
const SINGLES: usize = 200;

/// Checks all properties of a prior.
pub fn check_prior(prior: &dyn Prior) -> Report {
    let mut report = Report::of(prior.describe());
    report.add("blocks", || {
        let blocks = prior.blocks();
        let refused = blocks.validate().err().map(|e| e.to_string());
        settle(refused, &format!("{} blocks of {}³ points", blocks.count, blocks.edge))
    });
    report.add("finite differences", || gradient(prior));
    report.add("gradients add", || adds(prior));
    report.add("scale", || scale(prior));
    report.add("guards", || guards(prior));
    report.add("extremes", || extremes(prior));
    report.add("poison", || poison(prior));
    report.add("repeatable", || {
        let [a, b] = [(); 2].map(|()| bits(prior, 1));
        settle((a != b).then(|| "other numbers the second time".into()), "the same bits twice")
    });
    report.holds("threads", "several threads", || {
        let run = |i: usize| bits(prior, 1 + i as u64);
        beside_others(run, |a, b| (a != b).then(|| "other numbers beside other threads".into()))
    });
    report.add("no fault", || no_fault(prior.fault()));
    report
}

/// Checks all properties of a prior's WGSL, which it must have.
pub fn check_prior_wgsl(prior: &dyn Prior, device: &dyn Runner) -> Report {
    let mut report = Report::of(prior.describe());
    report.add("WGSL parity", || parity(prior, device));
    report
}

/// Random values of a block, exact in single precision.
fn drawn(prior: &dyn Prior) -> Vec<f64> {
    Draw::new(4, 1).many(&(0.0..1.0), prior.blocks().points())
}

/// Penalty and `scale` times its gradient.
fn run(prior: &dyn Prior, values: &[f64], scale: f64) -> (f64, Vec<f64>) {
    let mut gradient = Guarded::new(values.len(), 0.0);
    let value = prior.block(values, scale, gradient.inner());
    (value, gradient.into_inner())
}

/// Bits of the penalty and of its gradient for the values of this number.
fn bits(prior: &dyn Prior, number: u64) -> (u64, Vec<u64>) {
    let values: Vec<f64> = Draw::new(4, number).many(&(0.0..1.0), prior.blocks().points());
    let (value, slopes) = run(prior, &values, 1.0);
    (value.to_bits(), slopes.into_iter().map(f64::to_bits).collect())
}

fn gradient(prior: &dyn Prior) -> Outcome {
    let mut values = drawn(prior);
    let (value, found) = run(prior, &values, 1.0);
    require(value >= 0.0 && value.is_finite(), || format!("the penalty is {value}"))?;
    let largest = found.iter().fold(1e-9, |m: f64, g| m.max(g.abs()));
    let mut worst = 0.0f64;
    for i in (0..values.len()).step_by(values.len().div_ceil(SINGLES)) {
        let keep = values[i];
        let want = slope(1e-5, |d| {
            values[i] = keep + d;
            run(prior, &values, 1.0).0
        });
        values[i] = keep;
        let e = (found[i] - want).abs() / largest;
        require(e <= TOLERANCE, || format!("point {i}: gradient {:e}, differences {want:e}", found[i]))?;
        worst = worst.max(e);
    }
    within("gradient", worst, TOLERANCE)
}

fn adds(prior: &dyn Prior) -> Outcome {
    let values = drawn(prior);
    let (_, clean) = run(prior, &values, 1.0);
    let mut added = Guarded::new(values.len(), 3.0);
    prior.block(&values, 1.0, added.inner());
    let want: Vec<f64> = clean.iter().map(|g| 3.0 + g).collect();
    within("on top of 3", error(&added.into_inner(), &want), 1e-12)
}

/// The gradient is multiplied by the scale, the penalty is not.
fn scale(prior: &dyn Prior) -> Outcome {
    let values = drawn(prior);
    let ((plain, slopes), (value, scaled)) = (run(prior, &values, 1.0), run(prior, &values, 0.25));
    let want: Vec<f64> = slopes.iter().map(|g| 0.25 * g).collect();
    within("a quarter", error(&scaled, &want).max((value - plain).abs() / plain.abs().max(1e-30)), 1e-12)
}

fn guards(prior: &dyn Prior) -> Outcome {
    let values = drawn(prior);
    let mut gradient = Guarded::new(values.len(), 0.0);
    prior.block(&values, 1.0, gradient.inner());
    settle(gradient.broken("gradient"), "on either side of the gradient")
}

fn extremes(prior: &dyn Prior) -> Outcome {
    let values = drawn(prior);
    for v in [0.0, -0.0, 1e-40, 1.0, -1.0, 1e30, -1e30] {
        let flat = vec![v; values.len()];
        let mixed: Vec<f64> = values.iter().enumerate().map(|(i, x)| if i % 3 == 0 { v } else { *x }).collect();
        for block in [flat, mixed] {
            let (value, slopes) = run(prior, &block, 1.0);
            let finite = value.is_finite() && slopes.iter().all(|g| g.is_finite());
            require(finite, || format!("values of {v:e}: penalty {value}, or a derivative, is not finite"))?;
        }
    }
    Ok("0, denormal, ±1e30 give finite numbers".into())
}

/// Runs are monitored by their sums: NaN must propagate to them.
fn poison(prior: &dyn Prior) -> Outcome {
    let mut values = drawn(prior);
    let middle = values.len() / 2;
    values[middle] = f64::NAN;
    let (value, _) = run(prior, &values, 1.0);
    settle(value.is_finite().then(|| format!("the penalty is {value} where a value is NaN")), "NaN stays visible")
}

fn parity(prior: &dyn Prior, device: &dyn Runner) -> Outcome {
    let values = drawn(prior);
    let (value, slopes) = run(prior, &values, 1.0);
    let single: Vec<f32> = values.iter().map(|&v| v as f32).collect();
    let (found, found_slopes) = device.penalty(prior, &single)?;
    within("penalty and derivatives", error(&[found], &[value]).max(error(&found_slopes, &slopes)), SINGLE)
}
