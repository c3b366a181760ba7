//! Readers that stand in a row between lines of numbers: what projectors and the voxel-driven back-projection have in common.
//!
//! The rays of a detector column meet a plane of voxels on a straight line, and so do the voxels of a line on the detector.
//! Along that line readers stand at `q(i)`, a projective function of their number (of i itself where nothing is tilted), and
//! both coordinates of a place are linear in q. One coordinate counts lines, the other numbers within them. Readers go
//! upwards within lines, so a vector of them reads two vectors of neighbours and shuffles; they change lines slowly.

use conefield_core::simd::{Real, Simd, SimdBase, SimdFloat, V, load, store};

/// Zeros before the first and after the last number of a line: vectors read up to so many beyond it.
pub const PAD: usize = 32;

/// Where readers are at `q`: `at + per·q`, across the lines and along them. The first line and number are at 0.
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

/// The lines that a path goes between.
#[derive(Debug, Clone, Copy)]
pub(super) struct Among<R> {
    /// How many lines there are; all others are zero.
    pub lines: R,
    /// How many numbers a line has.
    pub numbers: R,
    /// Places along the lines between which something other than 0 may be read.
    pub span: [R; 2],
}

/// What readers at `q`, whose first and last are `ends`, find by bilinear interpolation; `None` if that is 0. `line` gives a
/// line between [`PAD`] zeros, from −1 to the number of lines.
#[inline(always)]
pub(super) fn read<'a, S: Simd, R: Real>(
    s: S,
    path: &Path<R>,
    among: &Among<R>,
    q: V<S, R>,
    ends: [R; 2],
    line: impl Fn(isize) -> &'a [R],
) -> Option<V<S, R>> {
    let number = |x: R| V::<S, R>::splat(s, x);
    let [a, b] = ends.map(|q| path.across(q));
    let (low, high) = if a < b { (a, b) } else { (b, a) };
    let below = R::of(-1.0);
    if high <= below || low >= among.lines {
        return None;
    }
    let stand = stand::<S, R>(s, path, among, q, ends)?;
    let whole = low >= below && high < among.lines;
    let low = if low < below { below } else { low.floor() };
    let high = if high < among.lines { high.floor() } else { among.lines - R::ONE };
    let y = q.mul_add(number(path.across[1]), number(path.across[0] - low));
    let l = low.int() as isize;
    if whole && low == high {
        let (a, b) = (between(s, line(l), &stand), between(s, line(l + 1), &stand));
        return Some(y.mul_add(b - a, a));
    }
    // Between more than two lines: each counts by its distance.
    let (zero, one) = (number(R::ZERO), number(R::ONE));
    let mut sum = zero;
    let mut away = y;
    for l in l..=high.int() as isize + 1 {
        let found = between(s, line(l), &stand);
        sum = (one - away.abs()).max(zero).mul_add(found, sum);
        away -= one;
    }
    Some(sum)
}

/// What readers at `q`, whose first and last are `ends`, find on a line that stands where they all do; `None` if that is 0.
#[inline(always)]
pub(super) fn read_on<S: Simd, R: Real>(
    s: S,
    path: &Path<R>,
    among: &Among<R>,
    q: V<S, R>,
    ends: [R; 2],
    line: &[R],
) -> Option<V<S, R>> {
    Some(between(s, line, &stand(s, path, among, q, ends)?))
}

/// Where readers stand along the lines: a `share` of the way from number `cell` to the next one, counted from `from` where
/// all are near.
struct Stand<S: Simd, R: Real> {
    from: Option<usize>,
    cell: V<S, R>,
    share: V<S, R>,
}

/// Where readers stand along the lines; `None` where all lines are zero.
#[inline(always)]
fn stand<S: Simd, R: Real>(s: S, path: &Path<R>, among: &Among<R>, q: V<S, R>, ends: [R; 2]) -> Option<Stand<S, R>> {
    let len = V::<S, R>::LEN;
    let number = |x: R| V::<S, R>::splat(s, x);
    let [first, last] = ends.map(|q| path.along(q));
    if last <= among.span[0] || first >= among.span[1] {
        return None;
    }
    // A little below the first reader, so that rounding puts none before it.
    let base = (first - R::of(1.0 / 64.0)).floor();
    if last - base <= R::of(2.0 * len as f64 - 2.5) {
        let z = q.mul_add(number(path.along[1]), number(path.along[0] - base));
        let cell = z.floor();
        return Some(Stand { from: Some((base.int() + PAD as i64) as usize), cell, share: z - cell });
    }
    let far = number(among.numbers + R::of(PAD as f64));
    let z = (q.mul_add(number(path.along[1]), number(path.along[0] + R::of(PAD as f64))))
        .max(number(R::of(PAD as f64 - 1.0)))
        .min(far);
    let cell = z.floor();
    Some(Stand { from: None, cell, share: z - cell })
}

/// `line = (1 − share)·a + share·b`.
#[inline(always)]
pub(super) fn mix<S: Simd, R: Real>(s: S, a: &[R], b: &[R], share: R, line: &mut [R]) {
    let share = V::<S, R>::splat(s, share);
    for i in (0..line.len()).step_by(V::<S, R>::LEN) {
        let a = load::<S, R>(s, a, i);
        store::<S, R>(share.mul_add(load::<S, R>(s, b, i) - a, a), line, i);
    }
}

/// What readers find on one line.
/// (No closure: whether one is inlined into code for an instruction set is the compiler's choice.)
#[inline(always)]
fn between<S: Simd, R: Real>(s: S, line: &[R], stand: &Stand<S, R>) -> V<S, R> {
    let [a, b] = match stand.from {
        Some(at) => R::window::<S, 2>(s, &line[at..at + 2 * V::<S, R>::LEN], stand.cell),
        None => R::neighbours::<S, 2>(s, line, stand.cell),
    };
    stand.share.mul_add(b - a, a)
}

/// `q` of readers from `from` on, of which the numbers `valid` count: `ρ/(1 + bend·ρ)` with ρ the distance from `middle`.
/// Numbers beyond have the nearest one's.
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
