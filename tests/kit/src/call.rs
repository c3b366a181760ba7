//! Calls of a stage's kernels on random data, and comparisons.

use crate::{Options, Outcome};
use conefield_core::random::{mix, unit};
use conefield_core::simd::Real;
use conefield_core::stage::{Grads, Info, Kernel, Stage, Tile, TileMut};
use std::ops::Range;

/// A sequence of random numbers.
pub struct Draw(u64, u64);

impl Draw {
    pub fn new(seed: u64, stream: u64) -> Self {
        Self(mix(seed, stream), 0)
    }

    /// Uniform in `range`, exact in single precision.
    pub fn from(&mut self, range: &Range<f64>) -> f64 {
        self.1 += 1;
        let u = f64::from(unit(mix(self.0, self.1)));
        f64::from((range.start + u * (range.end - range.start)) as f32)
    }

    pub fn below(&mut self, n: usize) -> usize {
        self.1 += 1;
        (mix(self.0, self.1) % n as u64) as usize
    }

    pub fn many<R: Real>(&mut self, range: &Range<f64>, n: usize) -> Vec<R> {
        (0..n).map(|_| R::of(self.from(range))).collect()
    }
}

/// Parameters as defined by `options`.
pub fn params<R: Real>(stage: &dyn Stage, options: &Options) -> Vec<R> {
    let n = stage.info().params;
    match options.params {
        Some(range) => Draw::new(options.seed, 1).many(&(-range..range), n),
        None => {
            let mut p = vec![0.0f32; n];
            stage.init(options.seed, &mut p);
            p.into_iter().map(|v| R::of(f64::from(v))).collect()
        }
    }
}

/// Inputs and output gradients for `rows` rows.
pub fn data<R: Real>(info: &Info, options: &Options, rows: usize) -> (Vec<R>, Vec<R>) {
    let x = Draw::new(options.seed, 2).many(&options.inputs, info.input * rows);
    let dy = Draw::new(options.seed, 3).many(&(-1.0..1.0), info.output * rows);
    (x, dy)
}

const GUARD: usize = 64;
const SENTINEL: f64 = -1.25e-7;

/// A buffer between guards. All outputs are written to such buffers, so that a stage in another language that writes
/// out of bounds is detected and does no harm.
pub struct Guarded<R>(Vec<R>);

impl<R: Real> Guarded<R> {
    pub fn new(n: usize, value: R) -> Self {
        let mut v = vec![R::of(SENTINEL); n + 2 * GUARD];
        v[GUARD..GUARD + n].fill(value);
        Self(v)
    }

    pub fn inner(&mut self) -> &mut [R] {
        let n = self.0.len();
        &mut self.0[GUARD..n - GUARD]
    }

    pub fn into_inner(mut self) -> Vec<R> {
        self.0.truncate(self.0.len() - GUARD);
        self.0.split_off(GUARD)
    }

    /// Describes where the guards were overwritten.
    pub fn broken(&self, what: &str) -> Option<String> {
        let inside = GUARD..self.0.len() - GUARD;
        let i = (0..self.0.len()).find(|i| !inside.contains(i) && self.0[*i] != R::of(SENTINEL))?;
        Some(format!("{what}: wrote at {} of {}", i as i64 - GUARD as i64, inside.len()))
    }
}

/// Output and tape. Both hold NaN before the call.
pub fn forward<R: Real>(k: &dyn Kernel<R>, info: &Info, params: &[R], x: &[R], rows: usize) -> [Vec<R>; 2] {
    forward_over(k, info, params, x, rows, R::of(f64::NAN))
}

/// Output and tape. Both hold `before` before the call.
pub fn forward_over<R: Real>(
    k: &dyn Kernel<R>,
    info: &Info,
    params: &[R],
    x: &[R],
    rows: usize,
    before: R,
) -> [Vec<R>; 2] {
    let [mut y, mut tape] = [info.output, info.tape].map(|c| Guarded::new(c * rows, before));
    k.forward(params, Tile::new(x, rows), TileMut::new(y.inner(), rows), TileMut::new(tape.inner(), rows));
    [y.into_inner(), tape.into_inner()]
}

/// [`forward`] in separate passes.
pub fn forward_in_passes<R: Real>(k: &dyn Kernel<R>, info: &Info, params: &[R], x: &[R], rows: usize) -> [Vec<R>; 2] {
    let [mut y, mut tape] = [info.output, info.tape].map(|c| Guarded::new(c * rows, R::of(f64::NAN)));
    for pass in 0..k.passes() {
        let (y, tape) = (TileMut::new(y.inner(), rows), TileMut::new(tape.inner(), rows));
        k.forward_pass(pass, params, Tile::new(x, rows), y, tape);
    }
    [y.into_inner(), tape.into_inner()]
}

/// State before [`backward`].
#[derive(Clone, Copy)]
pub struct Before<R> {
    /// Gradients before the call.
    pub grads: R,
    /// Input gradient before the call; `None` if it is not requested.
    pub dx: Option<R>,
}

impl<R: Real> Before<R> {
    pub fn clean() -> Self {
        Self { grads: R::ZERO, dx: Some(R::ZERO) }
    }
}

/// Gradients of the parameters `range`, and the input gradient (empty if not requested).
pub fn backward<R: Real>(
    k: &dyn Kernel<R>,
    info: &Info,
    params: &[R],
    x: &[R],
    dy: &[R],
    rows: usize,
    range: Range<usize>,
    before: Before<R>,
) -> [Vec<R>; 2] {
    let [_, left] = forward(k, info, params, x, rows);
    let mut tape = Guarded::new(left.len(), R::ZERO);
    tape.inner().copy_from_slice(&left);
    let mut grads = Guarded::new(range.len(), before.grads);
    let mut dx = before.dx.map(|v| Guarded::new(info.input * rows, v));
    k.backward(
        params,
        Tile::new(x, rows),
        TileMut::new(tape.inner(), rows),
        Tile::new(dy, rows),
        Grads { values: grads.inner(), range },
        dx.as_mut().map(|dx| TileMut::new(dx.inner(), rows)),
    );
    [grads.into_inner(), dx.map(Guarded::into_inner).unwrap_or_default()]
}

/// Gradients of all parameters, and the input gradient.
pub fn gradients<R: Real>(k: &dyn Kernel<R>, info: &Info, params: &[R], x: &[R], dy: &[R], rows: usize) -> [Vec<R>; 2] {
    backward(k, info, params, x, dy, rows, 0..info.params, Before::clean())
}

/// Rows `at..at + n` of channels with `rows` rows.
pub fn rows_of<R: Real>(data: &[R], rows: usize, at: usize, n: usize) -> Vec<R> {
    data.chunks_exact(rows).flat_map(|c| c[at..at + n].iter().copied()).collect()
}

/// Channels `which` of `data`.
pub fn channels_of<R: Real>(data: &[R], rows: usize, which: &[usize]) -> Vec<R> {
    which.iter().flat_map(|&c| data[c * rows..(c + 1) * rows].iter().copied()).collect()
}

/// Describes the first bitwise difference of two slices. NaN equals NaN.
pub fn differing(what: &str, a: &[f32], b: &[f32]) -> Option<String> {
    if a.len() != b.len() {
        return Some(format!("{what}: {} numbers against {}", a.len(), b.len()));
    }
    let differ = |(a, b): (&f32, &f32)| a.to_bits() != b.to_bits() && !(a.is_nan() && b.is_nan());
    let i = a.iter().zip(b).position(differ)?;
    Some(format!("{what} {i}: {:e} against {:e}", a[i], b[i]))
}

/// Largest difference relative to the largest magnitude of `b`; infinite if one side is not finite or has other lengths.
pub fn error<A: Real, B: Real>(a: &[A], b: &[B]) -> f64 {
    if a.len() != b.len() {
        return f64::INFINITY;
    }
    let scale = b.iter().map(|v| v.f64().abs()).fold(1e-30, f64::max);
    let of = |(a, b): (&A, &B)| {
        let d = (a.f64() - b.f64()).abs() / scale;
        if d.is_nan() { f64::INFINITY } else { d }
    };
    a.iter().zip(b).map(of).fold(0.0, f64::max)
}

/// The outcome of a comparison.
pub fn within(what: &str, found: f64, limit: f64) -> Outcome {
    let text = format!("{what}: error {found:.1e}, limit {limit:.0e}");
    if found <= limit { Outcome::Passed(text) } else { Outcome::Failed(text) }
}

/// Failed with the complaint, or passed without one.
pub fn settle(complaint: Option<String>, fine: &str) -> Outcome {
    complaint.map_or_else(|| Outcome::Passed(fine.into()), Outcome::Failed)
}
