//! Stages reduced to some of their channels.

use crate::call::{Loaded, channels_of, differing, error, none, require, skipped};
use crate::{Options, Outcome, Unmet, check};
use conefield_core::error::Error;
use conefield_core::stage::{Encoder, Field, Normalizer, Reduced, Stage};
use std::collections::BTreeSet;
use std::ops::Range;

const ROWS: usize = 37;

/// Nothing, or what is wrong.
type Checked = Result<(), Unmet>;

/// Some channels of `n`: all, all but the last, the first, the last, every second one.
fn choices(n: usize) -> Vec<Vec<usize>> {
    let mut all = vec![
        (0..n).collect(),
        (0..n.max(2) - 1).collect(),
        vec![0],
        vec![n - 1],
        (0..n).step_by(2).collect(),
        (n / 2..n).collect(),
    ];
    all.dedup();
    all
}

/// Gradients may be summed in a different order.
const ROUNDING: f64 = 1e-5;

fn gather(ranges: &[Range<usize>], params: &[f32]) -> Vec<f32> {
    ranges.iter().flat_map(|r| params[r.clone()].iter().copied()).collect()
}

/// Properties of every reduced stage: its counts are consistent, and its names are unchanged.
fn counts(full: &dyn Stage, small: &dyn Stage, params: &[Range<usize>], input: usize, output: usize) -> Checked {
    let (info, params) = (small.info(), params.iter().map(Range::len).sum::<usize>());
    let names: BTreeSet<String> = full.parameters().into_iter().map(|p| p.name).collect();
    let new = small.parameters().into_iter().find(|p| !names.contains(&p.name));
    let channels = || format!("{} to {} channels instead of {input} to {output}", info.input, info.output);
    require(info.input == input && info.output == output, channels)?;
    require(info.params == params, || format!("{} parameters, {params} were kept", info.params))?;
    none(new.map(|p| format!("a block has the new name {}", p.name)))
}

/// Runs the kit on a reduced stage.
fn whole(stage: &dyn Stage, options: &Options) -> Checked {
    let report = check(stage, options);
    require(report.passed(), || format!("the smaller stage fails {:?}:\n{report}", report.failed()))
}

/// A stage with its parameters, and the smaller one with those `ranges` of them.
fn pair<'a>(
    full: &'a dyn Stage,
    small: &'a dyn Stage,
    ranges: &[Range<usize>],
    options: &'a Options,
) -> (Loaded<'a, f32>, Loaded<'a, f32>) {
    let full = Loaded::of(full, options);
    let params = gather(ranges, &full.params);
    (full, Loaded { params, ..Loaded::of(small, options) })
}

/// Kept channels are bit-identical; gradients are those for a zero gradient of the removed channels.
fn same_outputs(
    full: &dyn Stage,
    small: &dyn Stage,
    ranges: &[Range<usize>],
    inputs: &[usize],
    keep: &[usize],
    options: &Options,
) -> Checked {
    counts(full, small, ranges, inputs.len(), keep.len())?;
    let (full, small) = pair(full, small, ranges, options);
    let (x, mut dy) = full.data(ROWS);
    for c in (0..full.info.output).filter(|c| !keep.contains(c)) {
        dy[c * ROWS..(c + 1) * ROWS].fill(0.0);
    }
    let (x1, dy1) = (channels_of(&x, ROWS, inputs), channels_of(&dy, ROWS, keep));
    let ([y, g, dx], [y1, g1, dx1]) = (full.pass(&x, &dy, ROWS), small.pass(&x1, &dy1, ROWS));
    none(differing("output", &y1, &channels_of(&y, ROWS, keep)))?;
    let e = error(&g1, &gather(ranges, &g)).max(error(&dx1, &channels_of(&dx, ROWS, inputs)));
    require(e <= ROUNDING, || format!("gradients are off by {e:.1e}"))
}

/// Calls `one` with each choice of `n` channels.
fn each(n: usize, mut one: impl FnMut(&[usize]) -> Checked) -> Outcome {
    let all = choices(n);
    for keep in &all {
        one(keep).map_err(|unmet| unmet.at(format!("keeping {keep:?}")))?;
    }
    Ok(format!("{} choices", all.len()))
}

/// The reduced stage. One that cannot be reduced has no such property, and says so.
fn reduced<S: ?Sized>(found: Result<Reduced<S>, Error>) -> Result<Reduced<S>, Unmet> {
    found.map_err(|e| match (e.to_string(), e) {
        (why, _) if why.is_empty() => Unmet::Failed("refused with an empty message".into()),
        (why, Error::Unsupported { .. }) => Unmet::Skipped(why),
        (why, _) => Unmet::Failed(why),
    })
}

/// An encoder with fewer outputs.
pub fn encoder_outputs(stage: &dyn Encoder, options: &Options) -> Outcome {
    let n = stage.info().output;
    each(n, |keep| {
        let r = reduced(stage.keep_outputs(keep))?;
        let first = r.stage.as_ref();
        same_outputs(stage, first, &r.params, &r.channels, keep, options)?;
        // Removing channels in two steps equals removing them at once.
        let again: Vec<usize> = (0..keep.len()).skip(1).step_by(2).collect();
        if again.is_empty() {
            return Ok(());
        }
        let r = reduced(first.keep_outputs(&again))?;
        let second = r.stage.as_ref();
        let same = same_outputs(first, second, &r.params, &r.channels, &again, options);
        same.and_then(|()| whole(second, options)).map_err(|unmet| unmet.at(format!("then {again:?}")))
    })
}

/// Resolutions of channels: one number each, the same for that channel in a reduced encoder.
pub fn resolutions(stage: &dyn Encoder) -> Outcome {
    let Some(cells) = stage.resolutions() else {
        return skipped("it does not say how fine its channels are");
    };
    let n = stage.info().output;
    require(cells.len() == n, || format!("{} numbers for {n} channels", cells.len()))?;
    let wrong = cells.iter().position(|v| !(v.is_finite() && *v > 0.0));
    none(wrong.map(|c| format!("channel {c} resolves {} cells", cells[c])))?;
    let ordered = !stage.coarse_to_fine() || cells.is_sorted();
    require(ordered, || format!("channels stand from coarse to fine, their cells do not: {cells:?}"))?;
    for keep in choices(n) {
        // Whether it can remove channels is a separate property.
        let Ok(smaller) = stage.keep_outputs(&keep) else { continue };
        let want: Vec<f64> = keep.iter().map(|&c| cells[c]).collect();
        let found = smaller.stage.resolutions();
        require(found.as_ref() == Some(&want), || format!("keeping {keep:?}: {found:?} instead of {want:?}"))?;
    }
    let range = [f64::INFINITY, 0.0];
    let [low, high] = cells.iter().fold(range, |[a, b], &v| [a.min(v), b.max(v)]);
    Ok(format!("{low} to {high} cells along the cube's side"))
}

/// Runs the kit on a stage with some of `n` inputs. With all of them its outputs are compared, and the kit is not run again.
fn some(n: usize, stage: &dyn Stage, options: &Options) -> Checked {
    if stage.info().input < n { whole(stage, options) } else { Ok(()) }
}

/// A normalizer with fewer inputs is a reduced stage of the same kind.
pub fn normalizer_inputs(stage: &dyn Normalizer, options: &Options) -> Outcome {
    let info = stage.info();
    each(info.input, |keep| {
        let r = reduced(stage.keep_inputs(keep))?;
        let small: &dyn Stage = r.stage.as_ref();
        let outputs = &r.channels;
        let rising = outputs.is_sorted_by(|a, b| a < b) && outputs.last().is_none_or(|&c| c < info.output);
        require(rising, || format!("outputs {outputs:?} of {}", info.output))?;
        counts(stage, small, &r.params, keep.len(), outputs.len())?;
        if keep.len() == info.input {
            same_outputs(stage, small, &r.params, keep, outputs, options)?;
        }
        some(info.input, small, options)
    })
}

/// A field with fewer inputs equals the field with zeros there.
pub fn field_inputs(stage: &dyn Field, options: &Options) -> Outcome {
    let info = stage.info();
    each(info.input, |keep| {
        let r = reduced(stage.keep_inputs(keep))?;
        let small: &dyn Stage = r.stage.as_ref();
        counts(stage, small, &r.params, keep.len(), info.output)?;
        let (full, less) = pair(stage, small, &r.params, options);
        let (mut x, dy) = full.data(ROWS);
        for c in (0..info.input).filter(|c| !keep.contains(c)) {
            x[c * ROWS..(c + 1) * ROWS].fill(0.0);
        }
        let x1 = channels_of(&x, ROWS, keep);
        let ([y, g, dx], [y1, g1, dx1]) = (full.pass(&x, &dy, ROWS), less.pass(&x1, &dy, ROWS));
        let e = error(&y1, &y).max(error(&g1, &gather(&r.params, &g))).max(error(&dx1, &channels_of(&dx, ROWS, keep)));
        require(e <= ROUNDING, || format!("off by {e:.1e}"))?;
        some(info.input, small, options)
    })
}
