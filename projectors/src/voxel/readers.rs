//! Readers: rays or voxels that interpolate between lines of numbers, shared by projectors and voxel-driven
//! back-projection.
//!
//! The rays of a detector column meet a plane of voxels on a straight line, and the voxels of a line project to a
//! straight line on the detector. Along that line the readers are at `q(i)`, a projective function of their index
//! (equal to i if nothing is tilted), and both coordinates of a position are linear in q. One coordinate counts lines,
//! the other numbers within them. Readers run upwards within lines, so a vector of them loads two neighbouring vectors
//! and shuffles; they change lines slowly.

use conefield_core::simd::{Real, Simd, SimdBase, SimdFloat, V, store};

/// Zero padding before and after a line: vectors may read this far beyond it.
pub const PAD: usize = 32;

/// Positions of readers at `q`: `at + per·q`, across the lines and along them. The first line and number are at 0.
#[derive(Debug, Clone, Copy)]
pub(super) struct Path<R> {
    pub across: [R; 2],
    pub along: [R; 2],
}

impl<R: Real> Path<R> {
    pub fn across(&self, q: R) -> R {
        q * self.across[1] + self.across[0]
    }

    pub fn along(&self, q: R) -> R {
        q * self.along[1] + self.along[0]
    }
}

impl Path<f64> {
    /// The same in another precision.
    pub fn narrow<R: Real>(&self) -> Path<R> {
        Path { across: self.across.map(R::of), along: self.along.map(R::of) }
    }
}

/// The lines between which a path runs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Among<R> {
    /// Number of lines; all others are zero.
    pub lines: R,
    /// Numbers per line.
    pub numbers: R,
    /// Range along the lines outside which all values are 0.
    pub span: [R; 2],
}

/// `q` of the first and the last reader of every vector.
#[derive(Default)]
pub(super) struct Ends<R> {
    first: Vec<R>,
    last: Vec<R>,
}

impl<R: Real> Ends<R> {
    /// Computes them for readers at `q`, in vectors of `len`.
    #[inline(always)]
    pub fn find(&mut self, q: &[R], len: usize) {
        self.first.clear();
        self.last.clear();
        for q in q.chunks_exact(len) {
            self.first.push(q[0]);
            self.last.push(q[len - 1]);
        }
    }
}

/// Positions of all vectors of readers on the lines of one path. The part common to a vector's readers is computed here
/// for many vectors at a time, which the compiler vectorizes again; computed per vector it took most of the time.
pub(super) struct Stands<R> {
    /// Start of the window on a line that a vector reads; or [`NOWHERE`], or [`FAR`].
    from: Vec<u32>,
    /// Offset added to `per·q` to get a reader's position in the window.
    along: Vec<R>,
    /// The first line, counted from line −1, and one after the last; `until` is 0 for a vector between two lines.
    low: Vec<u32>,
    until: Vec<u32>,
    /// Offset added to `per·q` to get a reader's distance from the first line.
    across: Vec<R>,
}

/// The readers of a vector read only zeros. No window begins here, because readers before the first number are within a
/// vector of it.
const NOWHERE: u32 = 0;
/// The readers of a vector are too far apart for a window. No window begins here either.
const FAR: u32 = 1;

impl<R: Real> Stands<R> {
    /// Buffers for at most `vectors` vectors.
    pub fn new(vectors: usize) -> Self {
        let zeros = || vec![R::ZERO; vectors];
        let numbers = || vec![0; vectors];
        Self { from: numbers(), along: zeros(), low: numbers(), until: numbers(), across: zeros() }
    }

    /// Computes the positions of vectors of `len` readers.
    #[inline(always)]
    pub fn place(&mut self, path: &Path<R>, among: &Among<R>, ends: &Ends<R>, len: usize) {
        self.place_along(path, among, ends, len);
        let below = R::of(-1.0);
        let n = ends.first.len();
        let (first, last) = (&ends.first[..n], &ends.last[..n]);
        let (from, low, until) = (&mut self.from[..n], &mut self.low[..n], &mut self.until[..n]);
        let across = &mut self.across[..n];
        for i in 0..n {
            let (a, b) = (path.across(first[i]), path.across(last[i]));
            let (lowest, highest) = if a < b { (a, b) } else { (b, a) };
            let nowhere = highest <= below || lowest >= among.lines;
            from[i] = if nowhere { NOWHERE } else { from[i] };
            let (at, to) = (lowest.floor(), highest.floor());
            let whole = lowest >= below && highest < among.lines && at == to;
            let at = if lowest < below { below } else { at };
            let to = if highest < among.lines { to } else { among.lines - R::ONE };
            low[i] = (at + R::ONE).count();
            until[i] = if whole { 0 } else { (to + R::of(3.0)).count() };
            across[i] = path.across[0] - at;
        }
    }

    /// Computes the positions of vectors of `len` readers along a line that they all share.
    #[inline(always)]
    pub fn place_along(&mut self, path: &Path<R>, among: &Among<R>, ends: &Ends<R>, len: usize) {
        let n = ends.first.len();
        let (first, last) = (&ends.first[..n], &ends.last[..n]);
        let (from, along) = (&mut self.from[..n], &mut self.along[..n]);
        let most = R::of(2.0 * len as f64 - 2.5);
        for i in 0..n {
            let (first, last) = (path.along(first[i]), path.along(last[i]));
            // Slightly below the first reader, so that rounding moves none before it.
            let base = (first - R::of(1.0 / 64.0)).floor();
            let window = if last - base <= most { (base + R::of(PAD as f64)).count() } else { FAR };
            from[i] = if last <= among.span[0] || first >= among.span[1] { NOWHERE } else { window };
            along[i] = path.along[0] - base;
        }
    }
}

/// The values of the readers of vector `i`, at `q`, by bilinear interpolation; `None` if they are 0. `line` returns a
/// line with [`PAD`] zeros on both sides, counted from line −1.
#[inline(always)]
pub(super) fn read<'a, S: Simd, R: Real>(
    s: S,
    path: &Path<R>,
    among: &Among<R>,
    stands: &Stands<R>,
    i: usize,
    q: V<S, R>,
    line: impl Fn(usize) -> &'a [R],
) -> Option<V<S, R>> {
    let number = |x: R| V::<S, R>::splat(s, x);
    let stand = stand::<S, R>(s, path, among, stands, i, q)?;
    let y = q.mul_add(number(path.across[1]), number(stands.across[i]));
    let (low, until) = (stands.low[i] as usize, stands.until[i] as usize);
    if until == 0 {
        let (a, b) = (between(s, line(low), &stand), between(s, line(low + 1), &stand));
        return Some(y.mul_add(b - a, a));
    }
    // Between more than two lines: each is weighted by its distance.
    let (zero, one) = (number(R::ZERO), number(R::ONE));
    let mut sum = zero;
    let mut away = y;
    for l in low..until {
        let found = between(s, line(l), &stand);
        sum = (one - away.abs()).max(zero).mul_add(found, sum);
        away -= one;
    }
    Some(sum)
}

/// The values of the readers of vector `i`, at `q`, on a line that they all share; `None` if they are 0.
#[inline(always)]
pub(super) fn read_on<S: Simd, R: Real>(
    s: S,
    path: &Path<R>,
    among: &Among<R>,
    stands: &Stands<R>,
    i: usize,
    q: V<S, R>,
    line: &[R],
) -> Option<V<S, R>> {
    Some(between(s, line, &stand(s, path, among, stands, i, q)?))
}

/// Positions of readers along the lines: a `share` of the way from number `cell` to the next one, relative to the
/// window at `from`, if there is one.
struct Stand<S: Simd, R: Real> {
    from: Option<usize>,
    cell: V<S, R>,
    share: V<S, R>,
}

/// The positions of the readers of vector `i` along the lines; `None` if all lines are zero.
#[inline(always)]
fn stand<S: Simd, R: Real>(
    s: S,
    path: &Path<R>,
    among: &Among<R>,
    stands: &Stands<R>,
    i: usize,
    q: V<S, R>,
) -> Option<Stand<S, R>> {
    let number = |x: R| V::<S, R>::splat(s, x);
    let per = number(path.along[1]);
    match stands.from[i] {
        NOWHERE => None,
        FAR => {
            let far = number(among.numbers + R::of(PAD as f64));
            let z =
                q.mul_add(per, number(path.along[0] + R::of(PAD as f64))).max(number(R::of(PAD as f64 - 1.0))).min(far);
            let cell = z.floor();
            Some(Stand { from: None, cell, share: z - cell })
        }
        from => {
            let z = q.mul_add(per, number(stands.along[i]));
            let cell = z.floor();
            Some(Stand { from: Some(from as usize), cell, share: z - cell })
        }
    }
}

/// `line = (1 − share)·a + share·b`, in whole vectors.
#[inline(always)]
pub(super) fn mix<S: Simd, R: Real>(s: S, a: &[R], b: &[R], share: R, line: &mut [R]) {
    let len = V::<S, R>::LEN;
    let share = V::<S, R>::splat(s, share);
    for ((a, b), line) in a.chunks_exact(len).zip(b.chunks_exact(len)).zip(line.chunks_exact_mut(len)) {
        let (a, b) = (V::<S, R>::from_slice(s, a), V::<S, R>::from_slice(s, b));
        share.mul_add(b - a, a).store_slice(line);
    }
}

/// The values of readers on one line.
/// (No closure: the compiler would decide whether to inline it into code for an instruction set.)
#[inline(always)]
fn between<S: Simd, R: Real>(s: S, line: &[R], stand: &Stand<S, R>) -> V<S, R> {
    let [a, b] = match stand.from {
        Some(at) => R::window::<S, 2, 2>(s, &line[at..at + 2 * V::<S, R>::LEN], stand.cell),
        None => R::neighbours::<S, 2>(s, line, stand.cell),
    };
    stand.share.mul_add(b - a, a)
}

/// `q` of readers from `from` on: `ρ/(1 + bend·ρ)` with ρ the distance from `middle`. Indices outside `valid` get the
/// nearest valid value.
#[inline(always)]
pub(super) fn places<S: Simd, R: Real>(s: S, from: f64, [middle, bend]: [f64; 2], valid: [f64; 2], q: &mut [R]) {
    let len = V::<S, R>::LEN;
    let number = |x: f64| V::<S, R>::splat(s, R::of(x));
    let lanes = V::<S, R>::from_fn(s, |i| R::of(i as f64));
    let [low, high] = valid.map(|r| number(r - middle));
    for i in (0..q.len()).step_by(len) {
        let r = (lanes + number(from + i as f64 - middle)).max(low).min(high);
        let place = if bend == 0.0 { r } else { r / r.mul_add(number(bend), number(1.0)) };
        store::<S, R>(place, q, i);
    }
}
