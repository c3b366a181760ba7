//! Calls of a stage's kernels on random data, and comparisons.

use crate::{Options, Outcome, Unmet};
use conefield_core::parallel;
use conefield_core::random::{mix, unit};
use conefield_core::simd::Real;
use conefield_core::stage::{Backward, Grads, Info, Kernel, Stage, Tile, TileMut};
use rayon::ThreadPoolBuilder;
use std::ops::Range;
use std::sync::{Barrier, OnceLock};
use std::time::{Duration, Instant};

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

/// A stage under test. What its checks draw is drawn once.
pub struct Subject<'a> {
    pub stage: &'a dyn Stage,
    pub options: &'a Options,
    single: OnceLock<Loaded<'a, f32>>,
    double: OnceLock<Option<Loaded<'a, f64>>>,
}

impl<'a> Subject<'a> {
    pub fn new(stage: &'a dyn Stage, options: &'a Options) -> Self {
        Self { stage, options, single: OnceLock::new(), double: OnceLock::new() }
    }

    /// The kernel that trains.
    pub fn single(&self) -> &Loaded<'a, f32> {
        self.single.get_or_init(|| Loaded::of(self.stage, self.options))
    }

    /// The kernel in double precision, if there is one.
    pub fn double(&self) -> Option<&Loaded<'a, f64>> {
        let reference = || self.stage.reference().map(|kernel| Loaded::new(self.stage, kernel, self.options));
        self.double.get_or_init(reference).as_ref()
    }
}

/// A kernel with parameters.
#[derive(Clone)]
pub struct Loaded<'a, R: Real> {
    pub kernel: &'a dyn Kernel<R>,
    pub info: Info,
    pub options: &'a Options,
    pub params: Vec<R>,
    /// Inputs around which the kernel is smooth; see `gradients`.
    pub smooth: OnceLock<Option<(Vec<R>, f64)>>,
}

/// State before [`Loaded::backward`].
#[derive(Clone, Copy)]
pub struct Before<R> {
    /// Gradients before the call.
    pub grads: R,
    /// Input gradient before the call; `None` if it is not requested.
    pub dx: Option<R>,
}

impl<'a> Loaded<'a, f32> {
    /// The kernel of `stage` that trains.
    pub fn of(stage: &'a dyn Stage, options: &'a Options) -> Self {
        Self::new(stage, stage.kernel(), options)
    }
}

impl<'a, R: Real> Loaded<'a, R> {
    /// A kernel of `stage` with parameters as defined by `options`.
    pub fn new(stage: &dyn Stage, kernel: &'a dyn Kernel<R>, options: &'a Options) -> Self {
        let info = stage.info();
        let params = match options.params {
            Some(range) => Draw::new(options.seed, 1).many(&(-range..range), info.params),
            None => {
                let mut p = vec![0.0f32; info.params];
                stage.init(options.seed, &mut p);
                p.into_iter().map(|v| R::of(f64::from(v))).collect()
            }
        };
        Self { kernel, info, options, params, smooth: OnceLock::new() }
    }

    /// Inputs and output gradients for `rows` rows.
    pub fn data(&self, rows: usize) -> (Vec<R>, Vec<R>) {
        let x = Draw::new(self.options.seed, 2).many(&self.options.inputs, self.info.input * rows);
        let dy = Draw::new(self.options.seed, 3).many(&(-1.0..1.0), self.info.output * rows);
        (x, dy)
    }

    /// Output and tape. Both hold NaN before the call.
    pub fn forward(&self, x: &[R], rows: usize) -> [Vec<R>; 2] {
        self.forward_over(x, rows, R::of(f64::NAN))
    }

    /// Output and tape. Both hold `before` before the call.
    pub fn forward_over(&self, x: &[R], rows: usize, before: R) -> [Vec<R>; 2] {
        parallel::look();
        let [mut y, mut tape] = self.outputs(rows, before);
        let (to, left) = (TileMut::new(y.inner(), rows), TileMut::new(tape.inner(), rows));
        self.kernel.forward(&self.params, Tile::new(x, rows), to, left);
        [y.into_inner(), tape.into_inner()]
    }

    /// [`Self::forward`] in separate passes.
    pub fn forward_in_passes(&self, x: &[R], rows: usize) -> [Vec<R>; 2] {
        let [mut y, mut tape] = self.outputs(rows, R::of(f64::NAN));
        for pass in 0..self.kernel.passes() {
            let (to, left) = (TileMut::new(y.inner(), rows), TileMut::new(tape.inner(), rows));
            self.kernel.forward_pass(pass, &self.params, Tile::new(x, rows), to, left);
        }
        [y.into_inner(), tape.into_inner()]
    }

    /// Room for output and tape, filled with `before`.
    pub fn outputs(&self, rows: usize, before: R) -> [Guarded<R>; 2] {
        [self.info.output, self.info.tape].map(|c| Guarded::new(c * rows, before))
    }

    /// Output, gradients of the parameters `range`, and the input gradient (empty if not requested).
    pub fn backward(&self, x: &[R], dy: &[R], rows: usize, range: Range<usize>, before: Before<R>) -> [Vec<R>; 3] {
        let [y, left] = self.forward(x, rows);
        let mut tape = Guarded::new(left.len(), R::ZERO);
        tape.inner().copy_from_slice(&left);
        let mut grads = Guarded::new(range.len(), before.grads);
        let mut dx = before.dx.map(|v| Guarded::new(self.info.input * rows, v));
        self.kernel.backward(Backward {
            params: &self.params,
            x: Tile::new(x, rows),
            tape: TileMut::new(tape.inner(), rows),
            dy: Tile::new(dy, rows),
            grads: Grads { values: grads.inner(), range },
            dx: dx.as_mut().map(|dx| TileMut::new(dx.inner(), rows)),
        });
        [y, grads.into_inner(), dx.map(Guarded::into_inner).unwrap_or_default()]
    }

    /// Output, gradients of all parameters, and the input gradient.
    pub fn pass(&self, x: &[R], dy: &[R], rows: usize) -> [Vec<R>; 3] {
        self.backward(x, dy, rows, 0..self.info.params, Before { grads: R::ZERO, dx: Some(R::ZERO) })
    }
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
    held(found <= limit, format!("{what}: error {found:.1e}, limit {limit:.0e}"))
}

/// Passed or failed with this text.
pub fn held(holds: bool, text: String) -> Outcome {
    if holds { Ok(text) } else { failed(text) }
}

/// Failed, with the finding.
pub fn failed<T>(what: impl Into<String>) -> Result<T, Unmet> {
    Err(Unmet::Failed(what.into()))
}

/// Not applicable, with the reason.
pub fn skipped(why: impl Into<String>) -> Outcome {
    Err(Unmet::Skipped(why.into()))
}

/// Fails with the complaint, if there is one.
pub fn none(complaint: Option<String>) -> Result<(), Unmet> {
    complaint.map_or(Ok(()), failed)
}

/// Failed with the complaint, or passed without one.
pub fn settle(complaint: Option<String>, fine: &str) -> Outcome {
    none(complaint).map(|()| fine.into())
}

/// Fails unless it holds.
pub fn require(holds: bool, why: impl FnOnce() -> String) -> Result<(), Unmet> {
    none((!holds).then(why))
}

/// The first difference between the results of `run` on one and on three threads and here; `differ` gets a word of where,
/// what was found and what is wanted.
pub fn on_threads<T: Send>(
    run: impl Fn() -> T + Sync,
    differ: impl Fn(&str, &T, &T) -> Option<String>,
) -> Option<String> {
    let want = run();
    [1, 3].into_iter().find_map(|n| {
        let Ok(pool) = ThreadPoolBuilder::new().num_threads(n).build() else {
            return Some(format!("no pool of {n} threads"));
        };
        differ(&format!("{n} threads"), &pool.install(&run), &want)
    })
}

/// Threads of [`beside_others`].
pub const CALLERS: usize = 4;
/// Least calls of each thread, and the time for more: on a busy core, a thread has its turn for some milliseconds.
const CALLS: usize = 3;
const TIME: Duration = Duration::from_millis(50);

/// The first difference between results of `run` on several threads at once and alone. Each thread has its own number, so
/// that what they share shows.
pub fn beside_others<T: Send + Sync>(
    run: impl Fn(usize) -> T + Sync,
    differ: impl Fn(&T, &T) -> Option<String> + Sync,
) -> Option<String> {
    let alone: Vec<T> = (0..CALLERS).map(&run).collect();
    // Threads take as long to start as some calls.
    let start = Barrier::new(CALLERS);
    let caller = |(i, want): (usize, &T)| {
        start.wait();
        let begin = Instant::now();
        (0..).take_while(|n| *n < CALLS || begin.elapsed() < TIME).find_map(|_| differ(&run(i), want))
    };
    std::thread::scope(|scope| {
        let callers: Vec<_> = (0..).zip(&alone).map(|of| scope.spawn(move || caller(of))).collect();
        let ends = callers.into_iter().map(|t| t.join().unwrap_or_else(|_| Some("a thread panicked".into())));
        ends.reduce(Option::or).flatten()
    })
}

/// Passed if no function reported a fault.
pub fn no_fault(fault: conefield_core::Result<()>) -> Outcome {
    settle(fault.err().map(|e| e.to_string()), "none was reported")
}
