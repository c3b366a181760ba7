//! Behaviour of a stage with its inputs: sizes, buffers, threads, extreme numbers.

use crate::call::{
    Before, Guarded, backward, data, differing, error, forward, forward_in_passes, forward_over, gradients, params,
    rows_of, settle, within,
};
use crate::{Options, Outcome};
use conefield_core::arena::{Block, Layout, Weights};
use conefield_core::stage::{GradKind, Grads, Scope, Stage, Tile, TileMut};
use std::collections::BTreeSet;

/// Rows of the tile that is split into others; more than a host uses, and not a multiple of anything.
const ROWS: usize = 301;

/// Counts and kinds are consistent, and an identity stage is one.
pub fn info(stage: &dyn Stage, options: &Options) -> Outcome {
    let info = stage.info();
    let complaint = if info.input == 0 || info.output == 0 {
        Some(format!("{} channels in, {} out", info.input, info.output))
    } else if (info.params == 0) != (info.grads == GradKind::None) {
        Some(format!("{} parameters with gradients {:?}", info.params, info.grads))
    } else if info.grads == GradKind::Scatter && info.tape > 0 {
        Some(format!("scattered gradients and a tape of {}", info.tape))
    } else if info.identity {
        let (x, _) = data::<f32>(&info, options, 9);
        let [y, _] = forward(stage.kernel(), &info, &params(stage, options), &x, 9);
        differing("an identity's output", &y, &x)
    } else {
        None
    };
    settle(complaint, &format!("{} to {} channels, {} parameters", info.input, info.output, info.params))
}

/// Blocks are consecutive, cover all parameters and have unique names.
pub fn parameters(stage: &dyn Stage) -> Outcome {
    let mut names = BTreeSet::new();
    let mut end = 0;
    let mut complaint = None;
    for p in stage.parameters() {
        let r = p.range();
        if r.start != end {
            complaint = complaint.or(Some(format!("{} starts at {}, the block before ends at {end}", p.name, r.start)));
        }
        if p.name.is_empty() || !names.insert(p.name.clone()) {
            complaint = complaint.or(Some(format!("a block is called {:?} as another one", p.name)));
        }
        end = r.end;
    }
    let total = stage.info().params;
    if end != total {
        complaint = complaint.or(Some(format!("blocks hold {end} parameters, info says {total}")));
    }
    settle(complaint, &format!("{} blocks", names.len()))
}

/// Initial parameters are finite, complete and repeatable.
pub fn init(stage: &dyn Stage, options: &Options) -> Outcome {
    let n = stage.info().params;
    let (mut a, mut b) = (vec![f32::NAN; n], vec![1e9; n]);
    stage.init(options.seed, &mut a);
    stage.init(options.seed, &mut b);
    let wild = a.iter().position(|v| !v.is_finite()).map(|i| format!("parameter {i} starts as {}", a[i]));
    settle(wild.or_else(|| differing("with the same seed, parameter", &a, &b)), "finite and repeatable")
}

fn by_row(stage: &dyn Stage) -> Result<(), Outcome> {
    if stage.info().scope == Scope::Row { Ok(()) } else { Err(Outcome::Skipped("its rows look at each other".into())) }
}

/// Rows do not depend on their tile.
pub fn tile_outputs(stage: &dyn Stage, options: &Options) -> Outcome {
    if let Err(skip) = by_row(stage) {
        return skip;
    }
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    let (x, dy) = data(&info, options, ROWS);
    let [y, _] = forward(k, &info, &p, &x, ROWS);
    let [_, dx] = gradients(k, &info, &p, &x, &dy, ROWS);
    for size in [1, 7, 64, 256] {
        for at in (0..ROWS).step_by(size) {
            let n = size.min(ROWS - at);
            let (x, dy) = (rows_of(&x, ROWS, at, n), rows_of(&dy, ROWS, at, n));
            let [part, _] = forward(k, &info, &p, &x, n);
            let [_, part_dx] = gradients(k, &info, &p, &x, &dy, n);
            let what = format!("tiles of {size}, from row {at}: ");
            let complaint = differing(&(what.clone() + "output"), &part, &rows_of(&y, ROWS, at, n))
                .or_else(|| differing(&(what + "input gradient"), &part_dx, &rows_of(&dx, ROWS, at, n)));
            if complaint.is_some() {
                return settle(complaint, "");
            }
        }
    }
    Outcome::Passed("1, 7, 64 and 256 rows give the bits of one tile".into())
}

/// The kernel for points off any ray treats each row as a ray of one sample.
pub fn points(stage: &dyn Stage, options: &Options) -> Outcome {
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    let Some(points) = k.points() else { return Outcome::Skipped("none".into()) };
    let n = 37;
    let (x, dy) = data(&info, options, n);
    let [y, _] = forward(points, &info, &p, &x, n);
    let [grads, dx] = gradients(points, &info, &p, &x, &dy, n);
    let mut sum = vec![0.0; info.params];
    for i in 0..n {
        let (x, dy) = (rows_of(&x, n, i, 1), rows_of(&dy, n, i, 1));
        let [one, _] = forward(k, &info, &p, &x, 1);
        let [one_grads, one_dx] = gradients(k, &info, &p, &x, &dy, 1);
        let complaint = differing(&format!("row {i}: output"), &rows_of(&y, n, i, 1), &one)
            .or_else(|| differing(&format!("row {i}: input gradient"), &rows_of(&dx, n, i, 1), &one_dx));
        if complaint.is_some() {
            return settle(complaint, "");
        }
        sum.iter_mut().zip(one_grads).for_each(|(s, g)| *s += f64::from(g));
    }
    within("rows give the bits of single ones; sums of gradients", error(&grads, &sum), 1e-5)
}

/// All passes in order give the result of forward.
pub fn passes(stage: &dyn Stage, options: &Options) -> Outcome {
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    let n = 37;
    let (x, _) = data(&info, options, n);
    let (whole, parts) = (forward(k, &info, &p, &x, n), forward_in_passes(k, &info, &p, &x, n));
    let complaint = differing("in passes, output", &parts[0], &whole[0]);
    settle(
        complaint.or_else(|| differing("in passes, tape", &parts[1], &whole[1])),
        &format!("{}, together the bits of forward", k.passes()),
    )
}

/// Gradients do not depend on the split into tiles, except for rounding.
pub fn tile_gradients(stage: &dyn Stage, options: &Options) -> Outcome {
    if let Err(skip) = by_row(stage) {
        return skip;
    }
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    if info.params == 0 {
        return Outcome::Skipped("no parameters".into());
    }
    let (x, dy) = data(&info, options, ROWS);
    let [whole, _] = gradients(k, &info, &p, &x, &dy, ROWS);
    let mut worst = 0.0f64;
    for size in [1, 7, 64, 256] {
        let mut sum = vec![0.0f64; info.params];
        for at in (0..ROWS).step_by(size) {
            let n = size.min(ROWS - at);
            let [g, _] = gradients(k, &info, &p, &rows_of(&x, ROWS, at, n), &rows_of(&dy, ROWS, at, n), n);
            sum.iter_mut().zip(g).for_each(|(s, g)| *s += f64::from(g));
        }
        worst = worst.max(error(&whole, &sum));
    }
    within("sums over tiles", worst, 1e-5)
}

/// Previous contents of output and tape do not matter.
pub fn outputs_overwrite(stage: &dyn Stage, options: &Options) -> Outcome {
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    let n = 37;
    let (x, _) = data(&info, options, n);
    let [want, _] = forward(k, &info, &p, &x, n);
    let [y, _] = forward_over(k, &info, &p, &x, n, 3.0);
    let hole = want.iter().position(|v| v.is_nan()).map(|i| format!("output {i} is NaN"));
    settle(hole.or_else(|| differing("output", &y, &want)), "every output is written")
}

/// Parameter gradients are accumulated, with and without an input gradient.
pub fn gradients_add(stage: &dyn Stage, options: &Options) -> Outcome {
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    if info.params == 0 {
        return Outcome::Skipped("no parameters".into());
    }
    let n = 37;
    let (x, dy) = data(&info, options, n);
    let run = |grads, dx| backward(k, &info, &p, &x, &dy, n, 0..info.params, Before { grads, dx });
    let [plain, _] = run(0.0, Some(0.0));
    let [alone, _] = run(0.0, None);
    if let Some(complaint) = differing("without an input gradient, gradient", &alone, &plain) {
        return Outcome::Failed(complaint);
    }
    let start = plain.iter().fold(1.0f32, |m, g| m.max(g.abs()));
    let [added, _] = run(start, Some(0.0));
    let want: Vec<f64> = plain.iter().map(|&g| f64::from(start) + f64::from(g)).collect();
    within(&format!("on top of {start:.2}"), error(&added, &want), 1e-5)
}

/// The input gradient is overwritten.
pub fn input_gradient_overwrites(stage: &dyn Stage, options: &Options) -> Outcome {
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    let n = 37;
    let (x, dy) = data(&info, options, n);
    let run = |dx| backward(k, &info, &p, &x, &dy, n, 0..info.params, Before { grads: 0.0, dx: Some(dx) });
    let [[_, clean], [_, seven], [_, nan]] = [0.0, 7.0, f32::NAN].map(run);
    let hole = nan.iter().position(|v| v.is_nan()).map(|i| format!("input gradient {i} was not written"));
    let complaint = hole.or_else(|| differing("over 7, input gradient", &seven, &clean));
    settle(complaint.or_else(|| differing("over NaN, input gradient", &nan, &clean)), "nothing of before is left")
}

/// Ranges are disjoint and cover every parameter.
pub fn partition(stage: &dyn Stage) -> Outcome {
    let info = stage.info();
    if info.grads != GradKind::Scatter {
        return Outcome::Skipped("gradients are not scattered".into());
    }
    let mut ranges = stage.partition();
    ranges.sort_by_key(|r| r.start);
    let mut end = 0;
    for r in &ranges {
        if r.start != end || r.end <= r.start {
            return Outcome::Failed(format!("{r:?} follows on {end}"));
        }
        end = r.end;
    }
    let complaint = (end != info.params).then(|| format!("ranges end at {end} of {}", info.params));
    settle(complaint, &format!("{} ranges", ranges.len()))
}

/// A range's gradients are bit-identical to that part of all gradients.
pub fn partition_gradients(stage: &dyn Stage, options: &Options) -> Outcome {
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    if info.grads != GradKind::Scatter {
        return Outcome::Skipped("gradients are not scattered".into());
    }
    let (x, dy) = data(&info, options, ROWS);
    let [all, _] = gradients(k, &info, &p, &x, &dy, ROWS);
    let ranges = stage.partition();
    for r in &ranges {
        let before = Before { grads: 0.0, dx: None };
        let [part, _] = backward(k, &info, &p, &x, &dy, ROWS, r.clone(), before);
        if let Some(complaint) = differing(&format!("range {r:?}, gradient"), &part, &all[r.clone()]) {
            return Outcome::Failed(complaint);
        }
    }
    Outcome::Passed(format!("{} ranges", ranges.len()))
}

/// Nothing outside the buffers is written, and inputs stay unchanged.
pub fn guards(stage: &dyn Stage, options: &Options) -> Outcome {
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    let ranges = if info.grads == GradKind::Scatter { stage.partition() } else { vec![] };
    for n in [1, 7, 64] {
        let (x, dy) = data(&info, options, n);
        let (p1, x1, dy1) = (p.clone(), x.clone(), dy.clone());
        for range in ranges.iter().cloned().chain([0..info.params]) {
            let [mut y, mut tape, mut grads, mut dx] =
                [info.output * n, info.tape * n, range.len(), info.input * n].map(|len| Guarded::new(len, 0.0));
            k.forward(&p, Tile::new(&x, n), TileMut::new(y.inner(), n), TileMut::new(tape.inner(), n));
            k.backward(
                &p,
                Tile::new(&x, n),
                TileMut::new(tape.inner(), n),
                Tile::new(&dy, n),
                Grads { values: grads.inner(), range },
                Some(TileMut::new(dx.inner(), n)),
            );
            let complaint = y
                .broken("output")
                .or_else(|| tape.broken("tape"))
                .or_else(|| grads.broken("gradients"))
                .or_else(|| dx.broken("input gradient"));
            if let Some(complaint) = complaint {
                return Outcome::Failed(format!("{n} rows, {complaint}"));
            }
        }
        let changed = differing("changed: parameter", &p, &p1)
            .or_else(|| differing("changed: input", &x, &x1))
            .or_else(|| differing("changed: output gradient", &dy, &dy1));
        if let Some(changed) = changed {
            return Outcome::Failed(format!("{n} rows, {changed}"));
        }
    }
    Outcome::Passed("on either side of every buffer".into())
}

/// Concurrent calls from several threads are bit-identical to a single call.
pub fn threads(stage: &dyn Stage, options: &Options) -> Outcome {
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    let n = 100;
    let (x, dy) = data(&info, options, n);
    let all = || {
        let [y, _] = forward(k, &info, &p, &x, n);
        let [g, dx] = gradients(k, &info, &p, &x, &dy, n);
        [y, g, dx].concat()
    };
    let want = all();
    let found: Vec<Vec<f32>> = std::thread::scope(|scope| {
        let started: Vec<_> = (0..4).map(|_| scope.spawn(|| (0..3).map(|_| all()).collect::<Vec<_>>())).collect();
        started.into_iter().flat_map(|t| t.join().unwrap_or_default()).collect()
    });
    let missing = (found.len() != 12).then(|| "a thread panicked".to_string());
    let complaint = missing.or_else(|| found.iter().find_map(|f| differing("number", f, &want)));
    settle(complaint, "4 threads, 3 calls each")
}

/// Finite inputs at the limits of their range give finite outputs, and backward does not panic.
pub fn extremes(stage: &dyn Stage, options: &Options) -> Outcome {
    let (info, k) = (stage.info(), stage.kernel());
    let mut p = vec![0.0; info.params];
    stage.init(options.seed, &mut p);
    let values = [0.0f32, -0.0, 1e-40, -1e-40, f32::MIN_POSITIVE, 1.0, -1.0, 1e30, -1e30];
    let rows: Vec<Vec<f32>> = values
        .iter()
        .flat_map(|&v| {
            let first = |c: usize| if c == 0 { v } else { 0.5 };
            let signs = |c: usize| if c.is_multiple_of(2) { v } else { -v };
            [
                vec![v; info.input],
                (0..info.input).map(first).collect(),
                (0..info.input).map(signs).collect::<Vec<f32>>(),
            ]
        })
        .collect();
    let n = rows.len();
    let x: Vec<f32> = (0..info.input).flat_map(|c| rows.iter().map(move |r| r[c])).collect();
    let [y, _] = forward(k, &info, &p, &x, n);
    gradients(k, &info, &p, &x, &vec![1.0; info.output * n], n);
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
pub fn finite(stage: &dyn Stage, options: &Options) -> Outcome {
    if let Err(skip) = by_row(stage) {
        return skip;
    }
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    let n = SIDE.pow(3);
    let (mut x, dy) = data::<f32>(&info, options, n);
    if info.input == 3 {
        let (low, width) = (options.inputs.start, options.inputs.end - options.inputs.start);
        let at = |i: usize| (low + width * (i % SIDE) as f64 / (SIDE - 1) as f64) as f32;
        x = [SIDE * SIDE, SIDE, 1].iter().flat_map(|step| (0..n).map(move |i| at(i / step))).collect();
    }
    let [y, _] = forward(k, &info, &p, &x, n);
    let [_, dx] = gradients(k, &info, &p, &x, &dy, n);
    let wild = |what: &str, values: &[f32]| {
        let i = values.iter().position(|v| !v.is_finite())?;
        let inputs: Vec<String> = (0..info.input.min(3)).map(|c| format!("{:.3}", x[c * n + i % n])).collect();
        Some(format!("{what} {} is {} where the inputs are {}", i / n, values[i], inputs.join(", ")))
    };
    settle(wild("channel", &y).or_else(|| wild("input gradient", &dx)), &format!("at {n} inputs"))
}

/// NaN and infinities do not leave their rows.
pub fn poison(stage: &dyn Stage, options: &Options) -> Outcome {
    if let Err(skip) = by_row(stage) {
        return skip;
    }
    let (info, k, p) = (stage.info(), stage.kernel(), params::<f32>(stage, options));
    let n = 83;
    let (clean, dy) = data::<f32>(&info, options, n);
    let mut x = clean.clone();
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    let poisoned = |i: usize| i % 5 == 2;
    for i in (0..n).filter(|&i| poisoned(i)) {
        for c in 0..info.input {
            // Some rows are poisoned in one channel, others in all.
            if i % 2 == 0 || c == i % info.input {
                x[c * n + i] = bad[i % 3];
            }
        }
    }
    let pure = |x: &[f32]| {
        let [y, _] = forward(k, &info, &p, x, n);
        let [_, dx] = gradients(k, &info, &p, x, &dy, n);
        let keep = |v: Vec<f32>| -> Vec<f32> {
            v.into_iter().enumerate().filter(|(j, _)| !poisoned(j % n)).map(|(_, v)| v).collect()
        };
        [keep(y), keep(dx)]
    };
    let ([y, dx], [y0, dx0]) = (pure(&x), pure(&clean));
    let complaint = differing("beside a poisoned row, output", &y, &y0);
    settle(
        complaint.or_else(|| differing("beside a poisoned row, input gradient", &dx, &dx0)),
        "NaN and infinities stay in their rows",
    )
}

/// Parameters are restored by name.
pub fn save_and_load(stage: &dyn Stage, options: &Options) -> Outcome {
    let p: Vec<f32> = params(stage, options);
    let block = |b: conefield_core::stage::Parameter| Block {
        range: b.range(),
        name: format!("stage.{}", b.name),
        shape: b.shape,
    };
    let layout = Layout { blocks: stage.parameters().into_iter().map(block).collect() };
    let saved = Weights::from_arena(&layout, &p, |_| true);
    let mut back = vec![f32::NAN; p.len()];
    match saved.load("conformance", &layout, &mut back, |_| true) {
        Err(e) => Outcome::Failed(e.to_string()),
        Ok(report) => {
            let unused = report.unused.first().map(|u| format!("{} was not loaded", u.0));
            settle(unused.or_else(|| differing("parameter", &back, &p)), &format!("{} tensors", report.loaded.len()))
        }
    }
}
