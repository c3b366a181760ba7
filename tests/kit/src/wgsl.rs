//! A stage's WGSL on a device against its Rust code: double precision, single precision and the device side by side.

use crate::call::{Draw, Subject, error, held, none, require, within};
use crate::gradients::{narrow, no_rows, shared};
use crate::rays::{rays, samples};
use crate::{Options, Outcome, Report};
use conefield_core::runner::Runner;
use conefield_core::stage::{Projector, Stage};

/// Repetitions of the rows around which a stage is smooth: several workgroups, the last one partly filled.
const ROUNDS: usize = 9;

/// Checks all properties of a stage's WGSL, which it must have.
pub fn check_wgsl(stage: &dyn Stage, options: &Options, device: &dyn Runner) -> Report {
    let mut report = Report::of(stage.describe());
    let of = Subject::new(stage, options);
    report.add("WGSL parity", || parity(&of, device));
    report.add("WGSL extremes", || extremes(&of, device));
    report
}

/// Outputs and gradients against double precision, reported beside single precision on the CPU. The device may have the
/// same error, and four times as much in gradients, because their sums have no fixed order.
fn parity(of: &Subject<'_>, device: &dyn Runner) -> Outcome {
    let (stage, options) = (of.stage, of.options);
    let rounds = |v: &[f64], change: bool| -> Vec<f64> {
        let n = options.rows;
        let of = |c: &[f64]| -> Vec<f64> {
            (0..ROUNDS)
                .flat_map(|r| c.iter().map(move |v| if change { v * (1.0 - 0.2 * r as f64) } else { *v }))
                .collect()
        };
        v.chunks_exact(n).flat_map(of).collect()
    };
    let rows = ROUNDS * options.rows;
    let Some(double) = of.double() else { return single_only(of, device) };
    let single = of.single();
    let Some([x, dy]) = shared(double) else { return no_rows::<f64>() };
    let (x, dy) = (rounds(&x, false), narrow(&rounds(&dy, true)));
    let dy64: Vec<f64> = dy.iter().map(|&v| f64::from(v)).collect();
    let [y64, g64, dx64] = double.pass(&x, &dy64, rows);
    let x = narrow(&x);
    let [y32, g32, dx32] = single.pass(&x, &dy, rows);
    let [y, g, dx] = device.pass(stage, &single.params, &x, &dy, rows)?;
    let mut words = vec![];
    let mut fine = true;
    for (what, found, cpu, exact, limit) in [
        ("outputs", &y, &y32, &y64, options.single),
        ("parameters", &g, &g32, &g64, 4.0 * options.single),
        ("inputs", &dx, &dx32, &dx64, 4.0 * options.single),
    ] {
        if exact.is_empty() {
            continue;
        }
        let (e, on_cpu) = (error(found, exact), error(cpu, exact));
        fine &= e <= limit;
        words.push(format!("{what} {e:.1e} (CPU {on_cpu:.1e}, limit {limit:.0e})"));
    }
    held(fine, words.join(", "))
}

/// Against single precision on the CPU, if there is no double precision.
fn single_only(of: &Subject<'_>, device: &dyn Runner) -> Outcome {
    let (single, rows) = (of.single(), ROUNDS * of.options.rows);
    let (x, dy) = single.data(rows);
    let [y32, g32, dx32] = single.pass(&x, &dy, rows);
    let [y, g, dx] = device.pass(of.stage, &single.params, &x, &dy, rows)?;
    let e = error(&y, &y32).max(error(&g, &g32) / 4.0).max(error(&dx, &dx32) / 4.0);
    within("against single precision on the CPU", e, 2.0 * of.options.single)
}

/// The device gives finite numbers wherever the CPU does: for zeros, denormals (which it may flush to zero) and huge
/// numbers.
fn extremes(of: &Subject<'_>, device: &dyn Runner) -> Outcome {
    let (single, options) = (of.single(), of.options);
    let rows = 70;
    for value in [0.0f32, -0.0, 1e-40, 1e-30, 1.0, -1.0, 1e30, -1e30] {
        let mut draw = Draw::new(options.seed, 41);
        let mut x: Vec<f32> = draw.many(&options.inputs, single.info.input * rows);
        x.iter_mut().step_by(3).for_each(|v| *v = value);
        let dy: Vec<f32> = draw.many(&(-1.0..1.0), single.info.output * rows);
        let [y32, g32, dx32] = single.pass(&x, &dy, rows);
        let [y, g, dx] = device.pass(of.stage, &single.params, &x, &dy, rows)?;
        for (what, found, cpu) in [("outputs", y, y32), ("gradients", g, g32), ("input gradients", dx, dx32)] {
            let lost = |(a, b): (&f32, &f32)| b.is_finite() && b.abs() < 1e35 && !a.is_finite();
            let at = found.iter().zip(&cpu).position(lost);
            none(at.map(|i| format!("inputs of {value:e}: {what} {i} is {}, on the CPU {}", found[i], cpu[i])))?;
        }
    }
    Ok("finite wherever the CPU is".into())
}

/// Checks all properties of a projector's WGSL, which it must have.
pub fn check_projector_wgsl(projector: &dyn Projector, device: &dyn Runner) -> Report {
    let mut report = Report::of(projector.describe());
    report.add("WGSL parity", || same_samples(projector, device));
    report
}

/// Largest difference of positions and weights, in cube sides: rounding of positions two cube sides from the origin.
const PLACES: f32 = 2e-6;

fn same_samples(projector: &dyn Projector, device: &dyn Runner) -> Outcome {
    let seeds = [None, Some(5), Some(0xfedc_ba98_7654_3210)];
    let all: Vec<_> = rays().into_iter().flat_map(|r| seeds.map(|s| (r, s))).collect();
    let found = device.samples(projector, &all)?;
    let mut worst = 0.0f32;
    for (i, ((ray, seed), found)) in all.iter().zip(&found).enumerate() {
        let want = &samples(projector, ray, *seed);
        let [n, most] = [want, found].map(|samples| samples.points.len());
        let enough = most >= n && found.weights[n..].iter().all(|w| *w == 0.0);
        require(enough, || format!("ray {i}: {most} samples against {n}"))?;
        for ((a, b), (v, w)) in found.points.iter().zip(&want.points).zip(found.weights.iter().zip(&want.weights)) {
            let place = (0..3).map(|k| (a[k] - b[k]).abs()).fold((v - w).abs(), f32::max);
            worst = if place.is_nan() { f32::INFINITY } else { worst.max(place) };
        }
    }
    let text = format!("{} rays, largest difference {worst:.1e} cube sides, limit {PLACES:.0e}", all.len());
    held(worst <= PLACES, text)
}
