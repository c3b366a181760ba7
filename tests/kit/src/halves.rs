//! Half-precision parameters: the same arithmetic on rounded numbers.

use crate::call::{data, differing, error, forward, forward_in_passes, gradients as backward, params, settle};
use crate::{Options, Outcome};
use conefield_core::half::{Half, round};
use conefield_core::stage::{Halves, Kernel, Reader, Stage};

/// Largest error against the training kernel on the rounded parameters.
const SAME: f64 = 1e-6;
/// Largest error of outputs, in roundings of the largest parameter.
const ROUNDINGS: f64 = 4.0;

/// Errors of a half-precision kernel (outputs or gradients), on the same rounded numbers and due to rounding.
type Off = fn(&dyn Stage, &dyn Kernel<f32>, &Options, [&[f32]; 2]) -> [f64; 2];

/// Outputs equal those of the rounded parameters, and differ from unrounded ones only by rounding.
pub fn outputs(stage: &dyn Stage, options: &Options) -> Outcome {
    let off: Off = |stage, halves, options, [exact, rounded]| {
        let info = stage.info();
        let (x, _) = data::<f32>(&info, options, options.rows);
        let of = |k: &dyn Kernel<f32>, p: &[f32]| forward(k, &info, p, &x, options.rows)[0].clone();
        let y = of(halves, rounded);
        [error(&y, &of(stage.kernel(), rounded)), error(&y, &of(stage.kernel(), exact))]
    };
    compared(stage, options, off)
}

/// Gradients of parameters and inputs equal those at the rounded parameters, in single precision.
pub fn gradients(stage: &dyn Stage, options: &Options) -> Outcome {
    let off: Off = |stage, halves, options, [_, rounded]| {
        let info = stage.info();
        let (x, dy) = data::<f32>(&info, options, options.rows);
        let [g, dx] = backward(halves, &info, rounded, &x, &dy, options.rows);
        let [want, want_dx] = backward(stage.kernel(), &info, rounded, &x, &dy, options.rows);
        [error(&g, &want).max(error(&dx, &want_dx)), 0.0]
    };
    compared(stage, options, off)
}

/// All passes in order give the result of forward.
pub fn passes(stage: &dyn Stage, options: &Options) -> Outcome {
    let Some(Halves { f16, bf16 }) = stage.halves() else { return not_read() };
    let (info, n) = (stage.info(), 37);
    let (x, _) = data::<f32>(&info, options, n);
    let differs = |name: &str, k: &dyn Kernel<f32>| {
        let (whole, parts) = (forward(k, &info, &[], &x, n), forward_in_passes(k, &info, &[], &x, n));
        differing(&format!("{name} in passes, output"), &parts[0], &whole[0])
    };
    let exact = params(stage, options);
    let complaint = differs("f16", &Reader { kernel: f16, params: &rounded(&exact) });
    let complaint = complaint.or_else(|| differs("bf16", &Reader { kernel: bf16, params: &rounded(&exact) }));
    settle(complaint, &format!("{}, together the bits of forward", f16.passes()))
}

fn rounded<H: Half>(exact: &[f32]) -> Vec<H> {
    let mut halves = vec![H::default(); exact.len()];
    round(exact, &mut halves);
    halves
}

fn not_read() -> Outcome {
    Outcome::Skipped("it reads parameters as they are".into())
}

fn compared(stage: &dyn Stage, options: &Options, off: Off) -> Outcome {
    let Some(Halves { f16, bf16 }) = stage.halves() else { return not_read() };
    let (mut words, mut fine) = (vec![], true);
    for (name, [same, rounding], bits) in
        [("f16", of(stage, f16, options, off), 11), ("bf16", of(stage, bf16, options, off), 8)]
    {
        let limit = ROUNDINGS * 0.5f64.powi(bits);
        fine &= same <= SAME && rounding <= limit;
        words.push(format!("{name} {same:.1e} (limit {SAME:.0e}), by rounding {rounding:.1e} (limit {limit:.0e})"));
    }
    let words = words.join(", ");
    if fine { Outcome::Passed(words) } else { Outcome::Failed(words) }
}

fn of<H: Half>(stage: &dyn Stage, kernel: &dyn Kernel<f32, H>, options: &Options, off: Off) -> [f64; 2] {
    let exact: Vec<f32> = params(stage, options);
    let halves: Vec<H> = rounded(&exact);
    let rounded: Vec<f32> = halves.iter().map(|h| h.value()).collect();
    off(stage, &Reader { kernel, params: &halves }, options, [&exact, &rounded])
}
