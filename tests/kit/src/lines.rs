//! Line integrals computed by a field itself: derivatives, adjointness, precision, and agreement with the field's
//! values.

use crate::call::{Draw, differing, error, forward, params, settle, within};
use crate::rays::rays;
use crate::{Options, Outcome, Report};
use conefield_core::simd::Real;
use conefield_core::stage::{Field, Grads, Lines, UnitRay};
use std::ops::Range;

/// Points along a ray at which its line integral is compared with the field's values.
const POINTS: usize = 2000;
/// Largest relative difference of the two: a walk from plane to plane is not an exact integral.
const CLOSE: f64 = 0.15;

/// Adds the properties of a field's own line integrals to `report`, if it has any.
pub fn check(report: &mut Report, field: &dyn Field, options: &Options) {
    let (Some(single), reference) = (field.lines(), field.lines_reference()) else { return };
    let Some(double) = reference else {
        report.add("lines: reference", || Outcome::Failed("none in double precision".into()));
        return;
    };
    report.add("lines: finite differences", || differences(field, double, options));
    report.add("lines: adjoint", || adjoint(field, double, options));
    report.add("lines: single precision", || precision(field, single, double, options));
    report.add("lines: gradients add", || adds(field, single, options));
    report.add("lines: partition gradients", || partition(field, single, options));
    report.add("lines: rays that miss", || misses(field, single, options));
    report.add("lines: several callers", || callers(field, single, options));
    report.add("lines: the field's values", || values(field, double, options));
}

fn project<R: Real>(lines: &dyn Lines<R>, params: &[R], rays: &[UnitRay]) -> Vec<R> {
    let mut out = vec![R::of(f64::NAN); rays.len()];
    lines.project(params, rays, &mut out);
    out
}

fn backproject<R: Real>(
    lines: &dyn Lines<R>,
    params: &[R],
    rays: &[UnitRay],
    dlines: &[R],
    before: R,
    range: Range<usize>,
) -> Vec<R> {
    let mut values = vec![before; range.len()];
    lines.backproject(params, rays, dlines, Grads { values: &mut values, range });
    values
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Inputs of every property: rays, parameters and `∂L/∂lines`.
fn drawn<R: Real>(field: &dyn Field, options: &Options) -> (Vec<UnitRay>, Vec<R>, Vec<R>) {
    let rays = rays();
    let dlines = Draw::new(options.seed, 21).many(&(-1.0..1.0), rays.len());
    (rays, params(field, options), dlines)
}

/// Differences of `Σ dlines·lines` along random directions through the parameters, and along single ones.
fn differences(field: &dyn Field, lines: &dyn Lines<f64>, options: &Options) -> Outcome {
    let (rays, p, dlines) = drawn::<f64>(field, options);
    let gradient = backproject(lines, &p, &rays, &dlines, 0.0, 0..p.len());
    let loss = |p: &[f64]| dot(&project(lines, p, &rays), &dlines);
    let mut draw = Draw::new(options.seed, 22);
    let mut worst: f64 = 0.0;
    let most = gradient.iter().fold(1e-12, |m: f64, g| m.max(g.abs()));
    for i in 0..24 {
        let direction: Vec<f64> = if i < 4 {
            draw.many(&(-1.0..1.0), p.len())
        } else {
            let one = draw.below(p.len());
            (0..p.len()).map(|k| f64::from(u8::from(k == one))).collect()
        };
        let h = 1e-4;
        let at = |t: f64| loss(&p.iter().zip(&direction).map(|(p, d)| p + t * d).collect::<Vec<_>>());
        let slope = (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h);
        let scale = most * dot(&direction, &direction).sqrt();
        worst = worst.max((slope - dot(&gradient, &direction)).abs() / scale);
    }
    within("24 directions", worst, options.tolerance)
}

/// If line integrals are linear in the parameters: `<Aμ, y> = <μ, Aᵀy>`.
fn adjoint(field: &dyn Field, lines: &dyn Lines<f64>, options: &Options) -> Outcome {
    let (rays, p, y) = drawn::<f64>(field, options);
    let twice: Vec<f64> = p.iter().map(|p| 2.0 * p).collect();
    let (found, doubled) = (project(lines, &p, &rays), project(lines, &twice, &rays));
    let linear = found.iter().zip(&doubled).all(|(a, b)| (2.0 * a - b).abs() <= 1e-12 * b.abs());
    if !linear {
        return Outcome::Skipped("line integrals are not linear in the parameters".into());
    }
    let (left, right) = (dot(&found, &y), dot(&p, &backproject(lines, &p, &rays, &y, 0.0, 0..p.len())));
    let size = found.iter().zip(&y).map(|(a, b)| (a * b).abs()).sum::<f64>().max(1e-300);
    within("<Aμ, y> and <μ, Aᵀy>", (left - right).abs() / size, 1e-12)
}

fn precision(field: &dyn Field, single: &dyn Lines<f32>, double: &dyn Lines<f64>, options: &Options) -> Outcome {
    let ((rays, p, d), (_, p64, d64)) = (drawn::<f32>(field, options), drawn::<f64>(field, options));
    let out = error(&project(single, &p, &rays), &project(double, &p64, &rays));
    let all = 0..p.len();
    let back = |e: f64| e / 4.0;
    let (a, b) =
        (backproject(single, &p, &rays, &d, 0.0, all.clone()), backproject(double, &p64, &rays, &d64, 0.0, all));
    within("lines, and a quarter of gradients", out.max(back(error(&a, &b))), options.single)
}

fn adds(field: &dyn Field, lines: &dyn Lines<f32>, options: &Options) -> Outcome {
    let (rays, p, d) = drawn::<f32>(field, options);
    let clean = backproject(lines, &p, &rays, &d, 0.0, 0..p.len());
    let over = backproject(lines, &p, &rays, &d, 3.0, 0..p.len());
    let less: Vec<f32> = over.iter().map(|g| g - 3.0).collect();
    within("over 3", error(&less, &clean), 1e-5)
}

/// Gradients of parameter ranges are bit-identical to those of all parameters together.
fn partition(field: &dyn Field, lines: &dyn Lines<f32>, options: &Options) -> Outcome {
    let (rays, p, d) = drawn::<f32>(field, options);
    let whole = backproject(lines, &p, &rays, &d, 0.0, 0..p.len());
    let parts = field.partition();
    let n = p.len();
    let mut choices = vec![parts.clone()];
    choices.push(
        [0..n / 3, n / 3..n / 3 + 1, n / 3 + 1..n].into_iter().filter(|r| r.end <= n && r.start < r.end).collect(),
    );
    for ranges in choices {
        let found: Vec<f32> = ranges.iter().flat_map(|r| backproject(lines, &p, &rays, &d, 0.0, r.clone())).collect();
        if let Some(complaint) = differing("gradient", &found, &whole) {
            return Outcome::Failed(format!("in {} ranges: {complaint}", ranges.len()));
        }
    }
    Outcome::Passed(format!("{} ranges", parts.len()))
}

/// Rays that miss the box give exactly 0 and leave gradients unchanged.
fn misses(field: &dyn Field, lines: &dyn Lines<f32>, options: &Options) -> Outcome {
    let (mut rays, p, d) = drawn::<f32>(field, options);
    rays.iter_mut().for_each(|r| r.inside = [0.0; 2]);
    let found = project(lines, &p, &rays).into_iter().find(|a| *a != 0.0).map(|a| format!("a line integral of {a:e}"));
    let back = backproject(lines, &p, &rays, &d, 3.0, 0..p.len());
    settle(found.or_else(|| back.iter().find(|g| **g != 3.0).map(|g| format!("a gradient of {g:e}"))), "0")
}

fn callers(field: &dyn Field, lines: &dyn Lines<f32>, options: &Options) -> Outcome {
    let (rays, p, d) = drawn::<f32>(field, options);
    let both = || [project(lines, &p, &rays), backproject(lines, &p, &rays, &d, 0.0, 0..p.len())].concat();
    let want = both();
    let found: Vec<Vec<f32>> = std::thread::scope(|scope| {
        let started: Vec<_> = (0..3).map(|_| scope.spawn(both)).collect();
        started.into_iter().filter_map(|t| t.join().ok()).collect()
    });
    let missing = (found.len() != 3).then(|| "a caller panicked".to_string());
    settle(missing.or_else(|| found.iter().find_map(|f| differing("number", f, &want))), "3 callers")
}

/// A line integral is approximately the sum of the field's values along the ray.
fn values(field: &dyn Field, lines: &dyn Lines<f64>, options: &Options) -> Outcome {
    let Some(kernel) = field.reference() else {
        return Outcome::Skipped("no reference kernel".into());
    };
    // Parameters of one sign: sums of both signs would be small, with large relative errors.
    let p: Vec<f64> = params::<f64>(field, options).into_iter().map(|p| 1.0 + 0.3 * p).collect();
    let rays = rays();
    let sums: Vec<f64> = rays
        .iter()
        .map(|ray| {
            let [from, to] = ray.inside.map(f64::from);
            let t = |i: usize| from + (to - from) * (i as f64 + 0.5) / POINTS as f64;
            let x: Vec<f64> = (0..3)
                .flat_map(|k| (0..POINTS).map(move |i| f64::from(ray.origin[k]) + t(i) * f64::from(ray.direction[k])))
                .collect();
            let [y, _] = forward(kernel, &field.info(), &p, &x, POINTS);
            y.iter().sum::<f64>() * (to - from) / POINTS as f64
        })
        .collect();
    within("lines and sums of values", error(&project(lines, &p, &rays), &sums), CLOSE)
}
