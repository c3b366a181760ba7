//! Behaviour of a stage with its inputs: sizes, buffers, threads, extreme numbers.

use crate::call::{
    Before, CALLERS, Guarded, Loaded, Subject, beside_others, differing, error, none, require, rows_of, settle,
    skipped, within,
};
use crate::{Options, Outcome};
use conefield_core::arena::{Block, Layout, Weights};
use conefield_core::stage::{Backward, GradKind, Grads, Tile, TileMut};
use std::collections::BTreeSet;

/// Rows of the tile that is split into others; more than a host uses, and not a multiple of anything.
const ROWS: usize = 301;

/// Counts and kinds are consistent, and an identity stage is one.
pub fn info(of: &Subject<'_>) -> Outcome {
    let info = of.stage.info();
    let channels = info.input > 0 && info.output > 0;
    require(channels, || format!("{} channels in, {} out", info.input, info.output))?;
    let right = (info.params == 0) == (info.grads == GradKind::None);
    require(right, || format!("{} parameters with gradients {:?}", info.params, info.grads))?;
    let right = info.grads != GradKind::Scatter || info.tape == 0;
    require(right, || format!("scattered gradients and a tape of {}", info.tape))?;
    if info.identity {
        let (x, _) = of.single().data(9);
        let [y, _] = of.single().forward(&x, 9);
        none(differing("an identity's output", &y, &x))?;
    }
    Ok(format!("{} to {} channels, {} parameters", info.input, info.output, info.params))
}

/// Blocks are consecutive, cover all parameters and have unique names.
pub fn parameters(of: &Subject<'_>) -> Outcome {
    let mut names = BTreeSet::new();
    let mut end = 0;
    for p in of.stage.parameters() {
        let r = p.range();
        require(r.start == end, || format!("{} starts at {}, the block before ends at {end}", p.name, r.start))?;
        let fresh = !p.name.is_empty() && names.insert(p.name.clone());
        require(fresh, || format!("a block is called {:?} as another one", p.name))?;
        end = r.end;
    }
    let total = of.stage.info().params;
    require(end == total, || format!("blocks hold {end} parameters, info says {total}"))?;
    Ok(format!("{} blocks", names.len()))
}

/// Initial parameters are finite, complete and repeatable.
pub fn init(of: &Subject<'_>) -> Outcome {
    let n = of.stage.info().params;
    let (mut a, mut b) = (vec![f32::NAN; n], vec![1e9; n]);
    of.stage.init(of.options.seed, &mut a);
    of.stage.init(of.options.seed, &mut b);
    let wild = a.iter().position(|v| !v.is_finite()).map(|i| format!("parameter {i} starts as {}", a[i]));
    settle(wild.or_else(|| differing("with the same seed, parameter", &a, &b)), "finite and repeatable")
}

/// Rows do not depend on their tile.
pub fn tile_outputs(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let (x, dy) = s.data(ROWS);
    let [y, _, dx] = s.pass(&x, &dy, ROWS);
    for size in [1, 7, 64, 256] {
        for at in (0..ROWS).step_by(size) {
            let n = size.min(ROWS - at);
            let (x, dy) = (rows_of(&x, ROWS, at, n), rows_of(&dy, ROWS, at, n));
            let [part, _, part_dx] = s.pass(&x, &dy, n);
            let what = |of: &str| format!("tiles of {size}, from row {at}: {of}");
            none(differing(&what("output"), &part, &rows_of(&y, ROWS, at, n)))?;
            none(differing(&what("input gradient"), &part_dx, &rows_of(&dx, ROWS, at, n)))?;
        }
    }
    Ok("1, 7, 64 and 256 rows give the bits of one tile".into())
}

/// The kernel for points off any ray treats each row as a ray of one sample.
pub fn points(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let Some(kernel) = s.kernel.points() else { return skipped("none") };
    let n = 37;
    let (x, dy) = s.data(n);
    let [y, grads, dx] = Loaded { kernel, ..s.clone() }.pass(&x, &dy, n);
    let mut sum = vec![0.0; s.info.params];
    for i in 0..n {
        let (x, dy) = (rows_of(&x, n, i, 1), rows_of(&dy, n, i, 1));
        let [one, one_grads, one_dx] = s.pass(&x, &dy, 1);
        none(differing(&format!("row {i}: output"), &rows_of(&y, n, i, 1), &one))?;
        none(differing(&format!("row {i}: input gradient"), &rows_of(&dx, n, i, 1), &one_dx))?;
        sum.iter_mut().zip(one_grads).for_each(|(s, g)| *s += f64::from(g));
    }
    within("rows give the bits of single ones; sums of gradients", error(&grads, &sum), 1e-5)
}

/// All passes in order give the result of forward.
pub fn passes(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let n = 37;
    let (x, _) = s.data(n);
    let (whole, parts) = (s.forward(&x, n), s.forward_in_passes(&x, n));
    none(differing("in passes, output", &parts[0], &whole[0]))?;
    none(differing("in passes, tape", &parts[1], &whole[1]))?;
    Ok(format!("{}, together the bits of forward", s.kernel.passes()))
}

/// Gradients do not depend on the split into tiles, except for rounding.
pub fn tile_gradients(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let (x, dy) = s.data(ROWS);
    let [_, whole, _] = s.pass(&x, &dy, ROWS);
    let mut worst = 0.0f64;
    for size in [1, 7, 64, 256] {
        let mut sum = vec![0.0f64; s.info.params];
        for at in (0..ROWS).step_by(size) {
            let n = size.min(ROWS - at);
            let [_, g, _] = s.pass(&rows_of(&x, ROWS, at, n), &rows_of(&dy, ROWS, at, n), n);
            sum.iter_mut().zip(g).for_each(|(s, g)| *s += f64::from(g));
        }
        worst = worst.max(error(&whole, &sum));
    }
    within("sums over tiles", worst, 1e-5)
}

/// Previous contents of output and tape do not matter.
pub fn outputs_overwrite(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let n = 37;
    let (x, _) = s.data(n);
    let [want, _] = s.forward(&x, n);
    let [y, _] = s.forward_over(&x, n, 3.0);
    let hole = want.iter().position(|v| v.is_nan()).map(|i| format!("output {i} is NaN"));
    settle(hole.or_else(|| differing("output", &y, &want)), "every output is written")
}

/// Parameter gradients are accumulated, with and without an input gradient.
pub fn gradients_add(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let n = 37;
    let (x, dy) = s.data(n);
    let run = |grads, dx| s.backward(&x, &dy, n, 0..s.info.params, Before { grads, dx });
    let [_, plain, _] = run(0.0, Some(0.0));
    let [_, alone, _] = run(0.0, None);
    none(differing("without an input gradient, gradient", &alone, &plain))?;
    let start = plain.iter().fold(1.0f32, |m, g| m.max(g.abs()));
    let [_, added, _] = run(start, Some(0.0));
    let want: Vec<f64> = plain.iter().map(|&g| f64::from(start) + f64::from(g)).collect();
    within(&format!("on top of {start:.2}"), error(&added, &want), 1e-5)
}

/// The input gradient is overwritten.
pub fn input_gradient_overwrites(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let n = 37;
    let (x, dy) = s.data(n);
    let run = |dx| s.backward(&x, &dy, n, 0..s.info.params, Before { grads: 0.0, dx: Some(dx) });
    let [[.., clean], [.., seven], [.., nan]] = [0.0, 7.0, f32::NAN].map(run);
    let hole = nan.iter().position(|v| v.is_nan()).map(|i| format!("input gradient {i} was not written"));
    none(hole)?;
    none(differing("over 7, input gradient", &seven, &clean))?;
    settle(differing("over NaN, input gradient", &nan, &clean), "nothing of before is left")
}

/// Ranges are disjoint and cover every parameter.
pub fn partition(of: &Subject<'_>) -> Outcome {
    let params = of.stage.info().params;
    let mut ranges = of.stage.partition();
    ranges.sort_by_key(|r| r.start);
    let mut end = 0;
    for r in &ranges {
        require(r.start == end && r.end > r.start, || format!("{r:?} follows on {end}"))?;
        end = r.end;
    }
    require(end == params, || format!("ranges end at {end} of {params}"))?;
    Ok(format!("{} ranges", ranges.len()))
}

/// A range's gradients are bit-identical to that part of all gradients.
pub fn partition_gradients(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let (x, dy) = s.data(ROWS);
    let [_, all, _] = s.pass(&x, &dy, ROWS);
    let ranges = of.stage.partition();
    for r in &ranges {
        let before = Before { grads: 0.0, dx: None };
        let [_, part, _] = s.backward(&x, &dy, ROWS, r.clone(), before);
        none(differing(&format!("range {r:?}, gradient"), &part, &all[r.clone()]))?;
    }
    Ok(format!("{} ranges", ranges.len()))
}

/// Nothing outside the buffers is written, and inputs stay unchanged.
pub fn guards(of: &Subject<'_>) -> Outcome {
    // Parameters that no call has seen.
    let s = &Loaded::of(of.stage, of.options);
    let ranges = if s.info.grads == GradKind::Scatter { of.stage.partition() } else { vec![] };
    for n in [1, 7, 64] {
        let (x, dy) = s.data(n);
        let (p1, x1, dy1) = (s.params.clone(), x.clone(), dy.clone());
        for range in ranges.iter().cloned().chain([0..s.info.params]) {
            let [mut y, mut tape] = s.outputs(n, 0.0);
            let [mut grads, mut dx] = [range.len(), s.info.input * n].map(|len| Guarded::new(len, 0.0));
            let (to, left) = (TileMut::new(y.inner(), n), TileMut::new(tape.inner(), n));
            s.kernel.forward(&s.params, Tile::new(&x, n), to, left);
            s.kernel.backward(Backward {
                params: &s.params,
                x: Tile::new(&x, n),
                tape: TileMut::new(tape.inner(), n),
                dy: Tile::new(&dy, n),
                grads: Grads { values: grads.inner(), range },
                dx: Some(TileMut::new(dx.inner(), n)),
            });
            let complaint = y
                .broken("output")
                .or_else(|| tape.broken("tape"))
                .or_else(|| grads.broken("gradients"))
                .or_else(|| dx.broken("input gradient"));
            none(complaint.map(|complaint| format!("{n} rows, {complaint}")))?;
        }
        let changed = differing("changed: parameter", &s.params, &p1)
            .or_else(|| differing("changed: input", &x, &x1))
            .or_else(|| differing("changed: output gradient", &dy, &dy1));
        none(changed.map(|changed| format!("{n} rows, {changed}")))?;
    }
    Ok("on either side of every buffer".into())
}

/// Concurrent calls from several threads, each with rows of its own, are bit-identical to single calls.
pub fn threads(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let (n, all) = (100, 100 * CALLERS);
    let (x, dy) = s.data(all);
    let run = |i| s.pass(&rows_of(&x, all, i * n, n), &rows_of(&dy, all, i * n, n), n).concat();
    settle(beside_others(run, |a, b| differing("number", a, b)), &format!("{CALLERS} threads with {n} rows each"))
}

/// Finite inputs at the limits of their range give finite outputs, and backward does not panic.
pub fn extremes(of: &Subject<'_>) -> Outcome {
    let as_it_starts = Options { params: None, ..of.options.clone() };
    let s = Loaded::of(of.stage, &as_it_starts);
    let values = [0.0f32, -0.0, 1e-40, -1e-40, f32::MIN_POSITIVE, 1.0, -1.0, 1e30, -1e30];
    let rows: Vec<Vec<f32>> = values
        .iter()
        .flat_map(|&v| {
            let first = |c: usize| if c == 0 { v } else { 0.5 };
            let signs = |c: usize| if c.is_multiple_of(2) { v } else { -v };
            [
                vec![v; s.info.input],
                (0..s.info.input).map(first).collect(),
                (0..s.info.input).map(signs).collect::<Vec<f32>>(),
            ]
        })
        .collect();
    let n = rows.len();
    let x: Vec<f32> = (0..s.info.input).flat_map(|c| rows.iter().map(move |r| r[c])).collect();
    let [y, ..] = s.pass(&x, &vec![1.0; s.info.output * n], n);
    let wild = y.iter().position(|v| !v.is_finite()).map(|i| {
        let row = &rows[i % n];
        format!("channel {} is {} where the inputs are {:e}, {:e}, …", i / n, y[i], row[0], row[row.len().min(2) - 1])
    });
    settle(wild, "0, denormal, ±1e30 give finite outputs")
}

/// Points along each side of the grid of [`finite`].
const SIDE: usize = 17;

/// Outputs and input gradients are finite for all usual inputs: for a stage that reads points, a grid that includes the
/// faces and corners of the cube, since random points miss a corner.
pub fn finite(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let n = SIDE.pow(3);
    let (mut x, dy) = s.data(n);
    if s.info.input == 3 {
        let inputs = &of.options.inputs;
        let (low, width) = (inputs.start, inputs.end - inputs.start);
        let at = |i: usize| (low + width * (i % SIDE) as f64 / (SIDE - 1) as f64) as f32;
        x = [SIDE * SIDE, SIDE, 1].iter().flat_map(|step| (0..n).map(move |i| at(i / step))).collect();
    }
    let [y, _, dx] = s.pass(&x, &dy, n);
    let wild = |what: &str, values: &[f32]| {
        let i = values.iter().position(|v| !v.is_finite())?;
        let inputs: Vec<String> = (0..s.info.input.min(3)).map(|c| format!("{:.3}", x[c * n + i % n])).collect();
        Some(format!("{what} {} is {} where the inputs are {}", i / n, values[i], inputs.join(", ")))
    };
    settle(wild("channel", &y).or_else(|| wild("input gradient", &dx)), &format!("at {n} inputs"))
}

/// NaN and infinities do not leave their rows.
pub fn poison(of: &Subject<'_>) -> Outcome {
    let s = of.single();
    let n = 83;
    let (clean, dy) = s.data(n);
    let mut x = clean.clone();
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    let poisoned = |i: usize| i % 5 == 2;
    for i in (0..n).filter(|&i| poisoned(i)) {
        for c in 0..s.info.input {
            // Some rows are poisoned in one channel, others in all.
            if i % 2 == 0 || c == i % s.info.input {
                x[c * n + i] = bad[i % 3];
            }
        }
    }
    let pure = |x: &[f32]| {
        let [y, _, dx] = s.pass(x, &dy, n);
        let keep = |v: Vec<f32>| -> Vec<f32> {
            v.into_iter().enumerate().filter(|(j, _)| !poisoned(j % n)).map(|(_, v)| v).collect()
        };
        [keep(y), keep(dx)]
    };
    let ([y, dx], [y0, dx0]) = (pure(&x), pure(&clean));
    none(differing("beside a poisoned row, output", &y, &y0))?;
    settle(differing("beside a poisoned row, input gradient", &dx, &dx0), "NaN and infinities stay in their rows")
}

/// Parameters are restored by name.
pub fn save_and_load(of: &Subject<'_>) -> Outcome {
    let p = &of.single().params;
    let block = |b: conefield_core::stage::Parameter| Block {
        range: b.range(),
        name: format!("stage.{}", b.name),
        shape: b.shape,
    };
    let layout = Layout { blocks: of.stage.parameters().into_iter().map(block).collect() };
    let saved = Weights::from_arena(&layout, p, |_| true);
    let mut back = vec![f32::NAN; p.len()];
    let report = saved.load("conformance", &layout, &mut back, |_| true)?;
    none(report.unused.first().map(|u| format!("{} was not loaded", u.0)))?;
    settle(differing("parameter", &back, p), &format!("{} tensors", report.loaded.len()))
}
