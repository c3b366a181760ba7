//! Properties of a loss: a correct derivative, a minimum where both values agree, behaviour for extreme numbers.

use crate::call::{Draw, beside_others, no_fault, require, settle, skipped, within};
use crate::gradients::slope;
use crate::{Outcome, Report};
use conefield_core::loss::{Loss, NoiseModel};
use conefield_core::runner::Runner;

/// Largest relative error of the derivative against differences.
const TOLERANCE: f64 = 1e-6;
/// Largest relative error of the WGSL in single precision.
const SINGLE: f64 = 1e-5;

/// Checks all properties of a loss.
pub fn check_loss(loss: &dyn Loss) -> Report {
    let mut report = Report::of(loss.describe());
    report.add("finite differences", || derivative(loss));
    report.add("least where values agree", || least(loss));
    report.add("extremes", || extremes(loss));
    report.add("poison", || poison(loss));
    report.add("repeatable", || {
        let changed = pairs().into_iter().find(|&[p, m]| bits(loss.at(p, m)) != bits(loss.at(p, m)));
        settle(changed.map(|[p, m]| format!("{}: another value", words(p, m))), "the same bits twice")
    });
    report.holds("threads", "several threads", || threads(loss));
    report.add("learns from a scan", || learns(loss));
    report.add("no fault", || no_fault(loss.fault()));
    report
}

/// Checks all properties of a loss's WGSL, which it must have.
pub fn check_loss_wgsl(loss: &dyn Loss, device: &dyn Runner) -> Report {
    let mut report = Report::of(loss.describe());
    report.add("WGSL parity", || parity(loss, device));
    report
}

/// Example noise of a scan.
const SHOWN: NoiseModel<'static> = NoiseModel { sigma: 0.01, growth: 0.7, measured: &[0.0, 0.1, 0.5, 1.0, 2.0] };

/// The loss as used in training, fitted to a scan if it adapts to one.
pub fn ready(loss: &dyn Loss) -> Option<Box<dyn Loss>> {
    loss.fitted(&SHOWN)
}

/// Predicted and measured values, exact in single precision: close and far apart, of both signs.
fn pairs() -> Vec<[f64; 2]> {
    let mut draw = Draw::new(3, 1);
    let mut pairs = vec![];
    for scale in [1e-3, 1e-2, 0.1, 1.0, 10.0] {
        for _ in 0..40 {
            let measured = draw.from(&(-0.5..3.0));
            pairs.push([f64::from((measured + draw.from(&(-scale..scale))) as f32), measured]);
        }
    }
    pairs
}

fn words(predicted: f64, measured: f64) -> String {
    format!("predicted {predicted}, measured {measured}")
}

fn bits((a, b): (f64, f64)) -> [u64; 2] {
    [a.to_bits(), b.to_bits()]
}

fn derivative(loss: &dyn Loss) -> Outcome {
    let (mut worst, mut seen) = (0.0f64, 0);
    for [predicted, measured] in pairs() {
        let at = |d: f64| loss.at(predicted + d, measured).0;
        // Where it is smooth, differences over one step and over four agree.
        let h = 1e-6;
        let [near, far] = [h, 4.0 * h].map(|h| (at(h) - at(-h)) / (2.0 * h));
        if (near - far).abs() > 1e-3 * near.abs().max(1e-3) {
            continue;
        }
        seen += 1;
        let (found, want) = (loss.at(predicted, measured).1, slope(h, at));
        // Differences of nearly zero losses are dominated by rounding.
        let e = (found - want).abs() / (found.abs().max(want.abs()) + 1e-4);
        let what = || format!("{}: derivative {found:e}, differences {want:e}", words(predicted, measured));
        require(e <= TOLERANCE, what)?;
        worst = worst.max(e);
    }
    require(seen >= 100, || format!("smooth at {seen} of 200 places"))?;
    within("derivative", worst, TOLERANCE)
}

fn least(loss: &dyn Loss) -> Outcome {
    for [predicted, measured] in pairs() {
        let (none, slope) = loss.at(measured, measured);
        let what = || format!("{none:e} and the derivative {slope:e} where both are {measured}");
        require(none == 0.0 && slope == 0.0, what)?;
        let (value, slope) = loss.at(predicted, measured);
        let downhill = slope.is_nan() || slope * (predicted - measured) < 0.0;
        require(value >= 0.0 && !downhill, || {
            format!("{}: loss {value:e}, derivative {slope:e}", words(predicted, measured))
        })?;
    }
    Ok("0 there, and nowhere a way down that leads away".into())
}

fn extremes(loss: &dyn Loss) -> Outcome {
    let values = [0.0, -0.0, 1e-40, -1e-40, 1.0, -1.0, 1e30, -1e30];
    for [p, m] in values.into_iter().flat_map(|p| values.map(|m| [p, m])) {
        let (value, slope) = loss.at(p, m);
        let what = || format!("predicted {p:e}, measured {m:e}: loss {value}, derivative {slope}");
        require(value.is_finite() && slope.is_finite(), what)?;
    }
    Ok("0, denormal, ±1e30 give finite numbers".into())
}

/// Runs are monitored by their loss: NaN must propagate to it.
fn poison(loss: &dyn Loss) -> Outcome {
    let hidden = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY].into_iter().find(|&p| loss.at(p, 0.5).0.is_finite());
    settle(hidden.map(|p| format!("predicted {p}: loss {}", loss.at(p, 0.5).0)), "NaN and infinities stay visible")
}

fn threads(loss: &dyn Loss) -> Option<String> {
    let all = pairs();
    // Each thread begins with other values.
    let run = |i: usize| -> Vec<[u64; 2]> {
        all.iter().cycle().skip(50 * i).take(all.len()).map(|&[p, m]| bits(loss.at(p, m))).collect()
    };
    beside_others(run, |a, b| (a != b).then(|| "another value beside other threads".into()))
}

/// An adaptive loss gives a loss with all other properties and of the same order.
fn learns(loss: &dyn Loss) -> Outcome {
    let Some(fitted) = ready(loss) else {
        require(!loss.needs_scan(), || "it needs a scan, and learns nothing from one".into())?;
        return skipped("it learns nothing");
    };
    require(loss.needs_scan(), || "it learns from a scan and does not say that it needs one".into())?;
    for property in [derivative, least, extremes, poison] {
        property(fitted.as_ref()).map_err(|unmet| unmet.at("after it learned".into()))?;
    }
    let mean = |l: &dyn Loss| SHOWN.measured.iter().map(|&m| l.at(m + 0.1, m).1).sum::<f64>();
    let ratio = mean(fitted.as_ref()) / mean(loss);
    settle(
        (!(0.5..=2.0).contains(&ratio)).then(|| format!("its derivatives are {ratio:.2e} times what they were")),
        &format!("{}; derivatives {ratio:.2} times what they were", fitted.describe()),
    )
}

fn parity(loss: &dyn Loss, device: &dyn Runner) -> Outcome {
    let pairs: Vec<[f32; 2]> = pairs().into_iter().map(|p| p.map(|v| v as f32)).collect();
    let found = device.losses(loss, &pairs)?;
    let mut worst = 0.0f64;
    for (&[p, m], found) in pairs.iter().zip(&found) {
        let (value, slope) = loss.at(f64::from(p), f64::from(m));
        for (found, want) in found.iter().zip([value, slope]) {
            let e = (f64::from(*found) - want).abs() / (want.abs() + 1e-6);
            worst = if e.is_nan() { f64::INFINITY } else { worst.max(e) };
        }
    }
    within(&format!("{} pairs", pairs.len()), worst, SINGLE)
}
