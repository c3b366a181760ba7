//! Stages reduced to some of their channels.

use crate::call::{Loaded, channels_of, differing, error};
use crate::{Options, Outcome, check};
use conefield_core::error::{Error, Result};
use conefield_core::stage::{Encoder, Field, Normalizer, Stage};
use std::collections::BTreeSet;
use std::ops::Range;

const ROWS: usize = 37;

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
fn counts(full: &dyn Stage, small: &dyn Stage, params: &[Range<usize>], input: usize, output: usize) -> Option<String> {
    let (info, params) = (small.info(), params.iter().map(Range::len).sum::<usize>());
    let names: BTreeSet<String> = full.parameters().into_iter().map(|p| p.name).collect();
    let new = small.parameters().into_iter().find(|p| !names.contains(&p.name));
    if info.input != input || info.output != output {
        Some(format!("{} to {} channels instead of {input} to {output}", info.input, info.output))
    } else if info.params != params {
        Some(format!("{} parameters, {params} were kept", info.params))
    } else {
        new.map(|p| format!("a block has the new name {}", p.name))
    }
}

/// Runs the kit on a reduced stage.
fn whole(stage: &dyn Stage, options: &Options) -> Option<String> {
    let report = check(stage, options);
    (!report.passed()).then(|| format!("the smaller stage fails {:?}:\n{report}", report.failed()))
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
) -> Option<String> {
    if let Some(complaint) = counts(full, small, ranges, inputs.len(), keep.len()) {
        return Some(complaint);
    }
    let (full, small) = pair(full, small, ranges, options);
    let (x, mut dy) = full.data(ROWS);
    for c in (0..full.info.output).filter(|c| !keep.contains(c)) {
        dy[c * ROWS..(c + 1) * ROWS].fill(0.0);
    }
    let (x1, dy1) = (channels_of(&x, ROWS, inputs), channels_of(&dy, ROWS, keep));
    let ([y, g, dx], [y1, g1, dx1]) = (full.pass(&x, &dy, ROWS), small.pass(&x1, &dy1, ROWS));
    if let Some(complaint) = differing("output", &y1, &channels_of(&y, ROWS, keep)) {
        return Some(complaint);
    }
    let e = error(&g1, &gather(ranges, &g)).max(error(&dx1, &channels_of(&dx, ROWS, inputs)));
    (e > ROUNDING).then(|| format!("gradients are off by {e:.1e}"))
}

fn each(n: usize, mut one: impl FnMut(&[usize]) -> Result<Option<String>>) -> Outcome {
    let all = choices(n);
    for keep in &all {
        match one(keep) {
            Ok(None) => {}
            Ok(Some(complaint)) => return Outcome::Failed(format!("keeping {keep:?}: {complaint}")),
            Err(e) if e.to_string().is_empty() => return Outcome::Failed("refused with an empty message".into()),
            Err(e @ Error::Unsupported { .. }) => return Outcome::Skipped(e.to_string()),
            Err(e) => return Outcome::Failed(format!("keeping {keep:?}: {e}")),
        }
    }
    Outcome::Passed(format!("{} choices", all.len()))
}

/// An encoder with fewer outputs.
pub fn encoder_outputs(stage: &dyn Encoder, options: &Options) -> Outcome {
    let n = stage.info().output;
    each(n, |keep| {
        let r = stage.keep_outputs(keep)?;
        let mut complaint = same_outputs(stage, r.stage.as_ref(), &r.params, &r.channels, keep, options);
        // Removing channels in two steps equals removing them at once.
        if complaint.is_none() && keep.len() > 1 {
            let again: Vec<usize> = (0..keep.len()).skip(1).step_by(2).collect();
            let second = r.stage.keep_outputs(&again)?;
            complaint = same_outputs(
                r.stage.as_ref(),
                second.stage.as_ref(),
                &second.params,
                &second.channels,
                &again,
                options,
            )
            .or_else(|| whole(second.stage.as_ref(), options))
            .map(|c| format!("then {again:?}: {c}"));
        }
        Ok(complaint)
    })
}

/// Resolutions of channels: one number each, the same for that channel in a reduced encoder.
pub fn resolutions(stage: &dyn Encoder) -> Outcome {
    let Some(cells) = stage.resolutions() else {
        return Outcome::Skipped("it does not say how fine its channels are".into());
    };
    let n = stage.info().output;
    if cells.len() != n {
        return Outcome::Failed(format!("{} numbers for {n} channels", cells.len()));
    }
    if let Some(c) = cells.iter().position(|v| !(v.is_finite() && *v > 0.0)) {
        return Outcome::Failed(format!("channel {c} resolves {} cells", cells[c]));
    }
    if stage.coarse_to_fine() && !cells.is_sorted() {
        return Outcome::Failed(format!("channels stand from coarse to fine, their cells do not: {cells:?}"));
    }
    for keep in choices(n) {
        // Whether it can remove channels is a separate property.
        let Ok(smaller) = stage.keep_outputs(&keep) else { continue };
        let want: Vec<f64> = keep.iter().map(|&c| cells[c]).collect();
        let found = smaller.stage.resolutions();
        if found.as_ref() != Some(&want) {
            return Outcome::Failed(format!("keeping {keep:?}: {found:?} instead of {want:?}"));
        }
    }
    let range = [f64::INFINITY, 0.0];
    let [low, high] = cells.iter().fold(range, |[a, b], &v| [a.min(v), b.max(v)]);
    Outcome::Passed(format!("{low} to {high} cells along the cube's side"))
}

/// Runs the kit on a stage with some of `n` inputs. With all of them its outputs are compared, and the kit is not run again.
fn some(n: usize, stage: &dyn Stage, options: &Options) -> Option<String> {
    if stage.info().input < n { whole(stage, options) } else { None }
}

/// A normalizer with fewer inputs is a reduced stage of the same kind.
pub fn normalizer_inputs(stage: &dyn Normalizer, options: &Options) -> Outcome {
    let info = stage.info();
    each(info.input, |keep| {
        let r = stage.keep_inputs(keep)?;
        let small: &dyn Stage = r.stage.as_ref();
        let outputs = &r.channels;
        if !outputs.is_sorted_by(|a, b| a < b) || outputs.last().is_some_and(|&c| c >= info.output) {
            return Ok(Some(format!("outputs {outputs:?} of {}", info.output)));
        }
        let mut complaint = counts(stage, small, &r.params, keep.len(), outputs.len());
        if complaint.is_none() && keep.len() == info.input {
            complaint = same_outputs(stage, small, &r.params, keep, outputs, options);
        }
        Ok(complaint.or_else(|| some(info.input, small, options)))
    })
}

/// A field with fewer inputs equals the field with zeros there.
pub fn field_inputs(stage: &dyn Field, options: &Options) -> Outcome {
    let info = stage.info();
    each(info.input, |keep| {
        let r = stage.keep_inputs(keep)?;
        let small: &dyn Stage = r.stage.as_ref();
        if let Some(c) = counts(stage, small, &r.params, keep.len(), info.output) {
            return Ok(Some(c));
        }
        let (full, less) = pair(stage, small, &r.params, options);
        let (mut x, dy) = full.data(ROWS);
        for c in (0..info.input).filter(|c| !keep.contains(c)) {
            x[c * ROWS..(c + 1) * ROWS].fill(0.0);
        }
        let x1 = channels_of(&x, ROWS, keep);
        let ([y, g, dx], [y1, g1, dx1]) = (full.pass(&x, &dy, ROWS), less.pass(&x1, &dy, ROWS));
        let e = error(&y1, &y).max(error(&g1, &gather(&r.params, &g))).max(error(&dx1, &channels_of(&dx, ROWS, keep)));
        Ok((e > ROUNDING).then(|| format!("off by {e:.1e}")).or_else(|| some(info.input, small, options)))
    })
}
