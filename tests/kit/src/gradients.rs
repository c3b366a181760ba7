//! Backward against differences of forward, and single against double precision.

use crate::call::{Draw, Loaded, Subject, error, failed, require, skipped, within};
use crate::{Options, Outcome, Unmet};
use conefield_core::simd::Real;
use conefield_core::stage::Scope;

/// Maximum number of parameters and inputs differenced one by one.
const SINGLES: usize = 400;
/// Number of random directions through all parameters.
const DIRECTIONS: u64 = 3;

/// Steps, the best first, and the largest error of differences over them. In single precision a stage that varies fast
/// is smooth only over short steps; its slopes are steep there, so that rounding still leaves two digits.
struct Steps {
    all: &'static [f64],
    tolerance: f64,
}

fn steps<R: Real>(options: &Options) -> Steps {
    if size_of::<R>() == 8 {
        Steps { all: &[4e-6], tolerance: options.tolerance }
    } else {
        Steps { all: &[4e-3, 1e-3, 2.5e-4, 6e-5], tolerance: 2e-2_f64.max(options.tolerance) }
    }
}

/// `Σ dy·y`, summed in double precision.
fn loss<R: Real>(of: &Loaded<'_, R>, x: &[R], dy: &[R], rows: usize) -> f64 {
    let [y, _] = of.forward(x, rows);
    y.iter().zip(dy).map(|(y, d)| y.f64() * d.f64()).sum()
}

/// Derivative of `f` at 0 by central differences over two steps (Richardson); the error is of fourth order.
pub fn slope(h: f64, mut f: impl FnMut(f64) -> f64) -> f64 {
    let mut central = |h: f64| (f(h) - f(-h)) / (2.0 * h);
    let (wide, narrow) = (central(h), central(0.5 * h));
    (4.0 * narrow - wide) / 3.0
}

/// Inputs around which the stage is smooth, with the longest step over which it is.
fn smooth_rows<'a, R: Real>(of: &'a Loaded<'_, R>) -> Option<&'a (Vec<R>, f64)> {
    let find = || steps::<R>(of.options).all.iter().find_map(|&h| rows_smooth_over(h, of).map(|x| (x, h)));
    of.smooth.get_or_init(find).as_ref()
}

fn rows_smooth_over<R: Real>(h: f64, of: &Loaded<'_, R>) -> Option<Vec<R>> {
    let (info, options, rows) = (&of.info, of.options, of.options.rows);
    let mut draw = Draw::new(options.seed, 4);
    // Rows of a ray are drawn together, others one by one.
    let each = if info.scope == Scope::Ray { rows } else { 1 };
    let dy: Vec<R> = draw.many(&(0.5..1.0), info.output * each);
    let mut found: Vec<Vec<R>> = vec![];
    for _ in 0..40 * rows / each {
        let mut x: Vec<R> = draw.many(&options.inputs, info.input * each);
        let mut at = |c: usize, d: f64| {
            let keep = x[c];
            x[c] = R::of(keep.f64() + d);
            let l = loss(of, &x, &dy, each);
            x[c] = keep;
            l
        };
        let slopes: Vec<[f64; 2]> =
            (0..info.input * each).map(|c| [h, 4.0 * h].map(|h| (at(c, h) - at(c, -h)) / (2.0 * h))).collect();
        let scale = slopes.iter().flatten().fold(1e-9f64, |m, s| m.max(s.abs()));
        if slopes.iter().all(|[a, b]| (a - b).abs() <= 3e-3 * scale.max(1e-2)) {
            found.push(x);
            if found.len() * each == rows {
                return Some(
                    (0..info.input)
                        .flat_map(|c| found.iter().flat_map(move |x| &x[c * each..(c + 1) * each]))
                        .copied()
                        .collect(),
                );
            }
        }
    }
    None
}

const NO_ROWS: &str = "no rows found around which the stage is smooth";

/// The gradient of every parameter, one by one and along directions through all of them.
pub fn parameters(of: &Subject<'_>) -> Outcome {
    of.double().map_or_else(|| coarse(parameters_in(of.single())), parameters_in)
}

/// The outcome of a stage whose differences are in single precision.
fn coarse(found: Outcome) -> Outcome {
    let may = "a kink or a high frequency may cause this; kernels in double precision settle it";
    found.map_err(|unmet| match unmet {
        Unmet::Failed(what) => Unmet::Failed(format!("{what}, in single precision: {may}")),
        skipped => skipped,
    })
}

fn parameters_in<R: Real>(of: &Loaded<'_, R>) -> Outcome {
    let Some((x, _)) = smooth_rows(of) else { return no_rows::<R>() };
    let (info, options, rows) = (&of.info, of.options, of.options.rows);
    let dy: Vec<R> = Draw::new(options.seed, 5).many(&(-1.0..1.0), info.output * rows);
    let [_, g, _] = of.pass(x, &dy, rows);
    let mut moved = of.clone();
    let Steps { all, tolerance } = steps::<R>(options);
    let h = all[0];
    let largest = g.iter().map(|g| g.f64().abs()).fold(0.0, f64::max);
    let mut draw = Draw::new(options.seed, 6);
    let mut worst = 0.0f64;
    // One by one: half of them with a non-zero gradient, half anywhere.
    let touched: Vec<usize> = (0..info.params).filter(|&i| g[i] != R::ZERO).collect();
    let chosen: Vec<usize> = if info.params <= SINGLES {
        (0..info.params).collect()
    } else {
        let some = (0..SINGLES / 2).filter(|_| !touched.is_empty()).map(|_| touched[draw.below(touched.len())]);
        let some: Vec<usize> = some.collect();
        some.into_iter().chain((0..SINGLES / 2).map(|_| draw.below(info.params))).collect()
    };
    for &i in &chosen {
        let keep = of.params[i];
        let want = slope(h, |d| {
            moved.params[i] = R::of(keep.f64() + d);
            loss(&moved, x, &dy, rows)
        });
        moved.params[i] = keep;
        let scale = g[i].f64().abs().max(want.abs()) + 1e-2 * largest + 1e-9;
        let e = (g[i].f64() - want).abs() / scale;
        require(e <= tolerance, || format!("parameter {i}: gradient {:e}, differences {want:e}", g[i].f64()))?;
        worst = worst.max(e);
    }
    for direction in 0..DIRECTIONS {
        let v: Vec<f64> = {
            let mut draw = Draw::new(options.seed, 100 + direction);
            (0..info.params).map(|_| draw.from(&(-1.0..1.0))).collect()
        };
        let want = slope(h, |d| {
            for ((p, start), v) in moved.params.iter_mut().zip(&of.params).zip(&v) {
                *p = R::of(start.f64() + d * v);
            }
            loss(&moved, x, &dy, rows)
        });
        let found: f64 = g.iter().zip(&v).map(|(g, v)| g.f64() * v).sum();
        let norm = g.iter().map(|g| g.f64() * g.f64()).sum::<f64>().sqrt();
        let e = (found - want).abs() / (found.abs().max(want.abs()) + 1e-2 * norm + 1e-9);
        require(e <= tolerance, || format!("direction {direction}: gradient {found:e}, differences {want:e}"))?;
        worst = worst.max(e);
    }
    let n = chosen.len();
    Ok(format!("{n} of {} and {DIRECTIONS} directions, worst error {worst:.1e}", info.params))
}

/// The gradient of every input.
pub fn inputs(of: &Subject<'_>) -> Outcome {
    of.double().map_or_else(|| coarse(inputs_in(of.single())), inputs_in)
}

fn inputs_in<R: Real>(of: &Loaded<'_, R>) -> Outcome {
    let Some((x, h)) = smooth_rows(of) else { return no_rows::<R>() };
    let (mut x, h, rows) = (x.clone(), *h, of.options.rows);
    let dy: Vec<R> = Draw::new(of.options.seed, 7).many(&(-1.0..1.0), of.info.output * rows);
    let [y, _, dx] = of.pass(&x, &dy, rows);
    // Rounding of the loss, which differences divide by the step. Layer normalization of two channels has hardly any slope.
    let size: f64 = y.iter().zip(&dy).map(|(y, d)| (y.f64() * d.f64()).abs()).sum();
    let rounding = 8.0 * f64::EPSILON * size / h;
    let tolerance = steps::<R>(of.options).tolerance;
    let largest = dx.iter().map(|g| g.f64().abs()).fold(0.0, f64::max);
    let mut worst = 0.0f64;
    let stride = x.len().div_ceil(SINGLES);
    for i in (0..x.len()).step_by(stride) {
        let keep = x[i];
        let want = slope(h, |d| {
            x[i] = R::of(keep.f64() + d);
            loss(of, &x, &dy, rows)
        });
        x[i] = keep;
        let scale = dx[i].f64().abs().max(want.abs()) + 1e-2 * largest + 1e-9;
        let difference = (dx[i].f64() - want).abs();
        let e = if difference <= rounding { 0.0 } else { difference / scale };
        let (c, row, found) = (i / rows, i % rows, dx[i].f64());
        require(e <= tolerance, || format!("channel {c} of row {row}: gradient {found:e}, differences {want:e}"))?;
        worst = worst.max(e);
    }
    Ok(format!("{} inputs, worst error {worst:.1e}", x.len().div_ceil(stride)))
}

pub fn no_rows<R: Real>() -> Outcome {
    let shortest = steps::<R>(&Options::encoder()).all.last().copied().unwrap_or_default();
    let text = format!("{NO_ROWS} over steps of {shortest:.0e}");
    if size_of::<R>() == 8 { failed(text) } else { skipped(text) }
}

/// Inputs at which both precisions select the same cells and sides of kinks, and output gradients.
pub fn shared(of: &Loaded<'_, f64>) -> Option<[Vec<f64>; 2]> {
    let (x, _) = smooth_rows(of)?;
    let dy = Draw::new(of.options.seed, 8).many(&(-1.0..1.0), of.info.output * of.options.rows);
    Some([x.clone(), dy])
}

pub fn narrow(v: &[f64]) -> Vec<f32> {
    v.iter().map(|&v| v as f32).collect()
}

/// The outcome of a check that needs double precision, for a stage without. A plugin in C may have the functions and not
/// declare them, and would see no other sign.
pub fn no_double() -> Outcome {
    skipped("no double precision (in C, info leaves double_precision 0: functions ending in _f64 are not called)")
}

/// Calls `compare` with the reference, inputs and output gradients.
fn with_double(of: &Subject<'_>, compare: impl FnOnce(&Loaded<'_, f64>, &[f64], &[f64]) -> Outcome) -> Outcome {
    let Some(double) = of.double() else { return no_double() };
    let Some([x, dy]) = shared(double) else { return no_rows::<f64>() };
    compare(double, &x, &dy)
}

/// Outputs of the training kernel against the reference.
pub fn single_outputs(of: &Subject<'_>) -> Outcome {
    with_double(of, |double, x, _| {
        let [want, _] = double.forward(x, of.options.rows);
        let [y, _] = of.single().forward(&narrow(x), of.options.rows);
        within("outputs", error(&y, &want), of.options.single)
    })
}

/// Gradients of the training kernel against the reference.
pub fn single_gradients(of: &Subject<'_>) -> Outcome {
    with_double(of, |double, x, dy| {
        let [_, g, dx] = double.pass(x, dy, of.options.rows);
        let [_, g32, dx32] = of.single().pass(&narrow(x), &narrow(dy), of.options.rows);
        within("parameters and inputs", error(&g32, &g).max(error(&dx32, &dx)), 4.0 * of.options.single)
    })
}
