//! The numbers that a [`RowMap`](crate::by_row::RowMap) computes with: one of each of several rows, side by side.

use crate::simd::{ExtractToken, Real, Select, Simd, SimdBase, SimdFloat, SimdMask, V, load, store};
use std::f64::consts::{FRAC_2_PI, TAU};
use std::ops::{Add, AddAssign, Div, Mul, MulAssign, Neg, Sub, SubAssign};

/// One number of each of several rows. A processor computes with all of them at once, in single precision with the
/// widest instructions that it has. Everything acts row by row: `a + b` adds the numbers of each row, and `a * w` with a
/// single number `w`, such as a parameter, multiplies all of them.
///
/// `x.each(f)` applies any other function `f`, number by number.
pub trait Lanes:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
    + MulAssign
    + Add<Self::Real, Output = Self>
    + Sub<Self::Real, Output = Self>
    + Mul<Self::Real, Output = Self>
    + Div<Self::Real, Output = Self>
{
    /// A single number: `f32`, or `f64` when gradients are checked.
    type Real: Real;
    /// `value` in every row. (`self` says how many rows there are.)
    fn same(self, value: f64) -> Self;
    /// `self·factor + term`, rounded once where the processor can.
    fn mul_add(self, factor: Self, term: Self) -> Self;
    /// `then` where `self` is below `limit`, else `otherwise`.
    fn below(self, limit: Self, then: Self, otherwise: Self) -> Self;
    /// `f` of each number: for functions that are missing here.
    fn each(self, f: impl Fn(Self::Real) -> Self::Real) -> Self;
    /// The larger number; NaN if one of them is.
    fn max(self, other: Self) -> Self;
    /// The smaller number; NaN if one of them is.
    fn min(self, other: Self) -> Self;
    /// Magnitude.
    fn abs(self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Exponential; `f32`: relative error below 5e-7.
    fn exp(self) -> Self;
    /// Natural logarithm.
    fn ln(self) -> Self {
        self.each(Self::Real::ln)
    }
    /// Natural logarithm of `1 + exp(x)` without overflow.
    fn softplus(self) -> Self {
        self.each(Self::Real::softplus)
    }
    /// Sine and cosine; `f32`: error below 2e-7.
    fn sin_cos(self) -> (Self, Self);
    /// Sine and cosine of an angle in turns, `sin(2π·t)` and `cos(2π·t)`. Whole turns cancel exactly, before any rounding.
    fn sin_cos_turns(self) -> (Self, Self);
    /// Numbers of `from` from `at` on; those past the end are 0.
    #[doc(hidden)]
    fn load(self, from: &[Self::Real], at: usize) -> Self;
    /// Stores the numbers that fit into `to` from `at` on.
    #[doc(hidden)]
    fn store(self, to: &mut [Self::Real], at: usize);
    /// Sum over the first `rows` rows, in an order that depends on the processor's instructions alone.
    fn sum(self, rows: usize) -> Self::Real;
}

/// [`Lanes`] as `K` vectors of the instructions `S`. With several vectors, work that is done once for all rows costs
/// less per row, and the processor has more independent work.
#[derive(Clone, Copy)]
pub(crate) struct Vectors<S: Simd, R: Real, const K: usize>([V<S, R>; K]);

/// `f` of every vector. A loop: a closure for `map` might not be inlined into the code for an instruction set.
macro_rules! every {
    ($all:expr, |$k:ident| $f:expr) => {{
        let mut all = $all;
        for $k in 0..K {
            all[$k] = $f;
        }
        Self(all)
    }};
}

macro_rules! operators {
    ($($operator:ident $function:ident,)*) => {
        $(
            impl<S: Simd, R: Real, const K: usize> $operator for Vectors<S, R, K> {
                type Output = Self;
                #[inline(always)]
                fn $function(self, other: Self) -> Self {
                    every!(self.0, |k| self.0[k].$function(other.0[k]))
                }
            }
            impl<S: Simd, R: Real, const K: usize> $operator<R> for Vectors<S, R, K> {
                type Output = Self;
                #[inline(always)]
                fn $function(self, other: R) -> Self {
                    let other = V::<S, R>::splat(self.0[0].token(), other);
                    every!(self.0, |k| self.0[k].$function(other))
                }
            }
        )*
    };
}

operators! { Add add, Sub sub, Mul mul, Div div, }

macro_rules! assigning {
    ($($operator:ident $function:ident $plain:ident,)*) => {
        $(
            impl<S: Simd, R: Real, const K: usize> $operator for Vectors<S, R, K> {
                #[inline(always)]
                fn $function(&mut self, other: Self) {
                    *self = self.$plain(other);
                }
            }
        )*
    };
}

assigning! { AddAssign add_assign add, SubAssign sub_assign sub, MulAssign mul_assign mul, }

impl<S: Simd, R: Real, const K: usize> Neg for Vectors<S, R, K> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        every!(self.0, |k| -self.0[k])
    }
}

/// Bytes that a cache moves at once.
const LINE: usize = 64;

/// Hints that `to[at]` is written soon.
#[inline(always)]
#[allow(unsafe_code)]
fn soon<R>(to: &[R], at: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_ET0, _mm_prefetch};
        // SAFETY: a hint reads and writes nothing, and every address is allowed.
        unsafe { _mm_prefetch::<_MM_HINT_ET0>(to.as_ptr().wrapping_add(at).cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (to, at);
}

/// `π/2 = first + second + third`, of which the first two have so few bits that their products with the number of
/// quarter turns are exact up to [`FAR`] (Cody & Waite 1980).
const QUARTER: [f64; 3] = [1.570_312_5, 4.837_512_969_970_703e-4, 7.549_789_954_891_882e-8];
/// Larger angles are reduced one by one.
const FAR: f64 = 8192.0;
/// Beyond, [`Real::exp_lanes`] has reached the end of its range.
const STEEP: f64 = 87.0;

impl<S: Simd, R: Real, const K: usize> Vectors<S, R, K> {
    /// The number of rows.
    pub const ROWS: usize = K * V::<S, R>::LEN;

    /// `value` in every row.
    #[inline(always)]
    pub fn splat(s: S, value: R) -> Self {
        Self([V::<S, R>::splat(s, value); K])
    }

    /// `1 − a²/((last − 1)·last)·(…)` of a square `a²`, evaluated from the last term inwards.
    #[inline(always)]
    fn series(self, last: usize) -> Self {
        let one = self.same(1.0);
        let mut sum = one;
        let mut k = last;
        while k >= 2 {
            sum = (self * sum).mul_add(self.same(-1.0 / (k * (k - 1)) as f64), one);
            k -= 2;
        }
        sum
    }

    /// Sine and cosine of `self` plus `quarters` quarter turns, for a magnitude of `self` up to an eighth of a turn, where
    /// the truncation error of the Taylor series is below half a unit in the last place.
    #[inline(always)]
    fn sin_cos_of(self, quarters: Self) -> (Self, Self) {
        let single = size_of::<R>() == 4;
        let [zero, one, two, three] = [0.0, 1.0, 2.0, 3.0].map(|v| V::<S, R>::splat(self.0[0].token(), R::of(v)));
        let square = self * self;
        let mut sin = self * square.series(if single { 9 } else { 17 });
        let mut cos = square.series(if single { 10 } else { 18 });
        for k in 0..K {
            let q = quarters.0[k];
            let q = q - (q * R::of(0.25)).floor() * R::of(4.0);
            let odd = q.simd_eq(one) | q.simd_eq(three);
            let (s, c) = (odd.select(cos.0[k], sin.0[k]), odd.select(sin.0[k], cos.0[k]));
            sin.0[k] = q.simd_ge(two).select(zero - s, s);
            cos.0[k] = (q.simd_eq(one) | q.simd_eq(two)).select(zero - c, c);
        }
        (sin, cos)
    }

    /// The nearest integers; even ones halfway.
    #[inline(always)]
    fn round(self) -> Self {
        every!(self.0, |k| self.0[k].round_ties_even())
    }

    /// These values of a function at `x`, with those of `f` where the magnitude of `x` is above `limit` or NaN: each row by
    /// itself, so that it does not depend on its neighbours.
    #[inline(always)]
    fn up_to(self, limit: f64, x: Self, f: impl Fn(R) -> R) -> Self {
        let mut inside = true;
        for k in 0..K {
            inside &= x.0[k].abs().simd_le(self.same(limit).0[k]).all_true();
        }
        if inside { self } else { self.beyond(R::of(limit), x, f) }
    }

    #[cold]
    #[inline(never)]
    fn beyond(mut self, limit: R, x: Self, f: impl Fn(R) -> R) -> Self {
        for k in 0..K {
            for (y, &x) in self.0[k].as_mut_slice().iter_mut().zip(x.0[k].as_slice()) {
                if !(-limit..=limit).contains(&x) {
                    *y = f(x);
                }
            }
        }
        self
    }
}

impl<S: Simd, R: Real, const K: usize> Lanes for Vectors<S, R, K> {
    type Real = R;

    #[inline(always)]
    fn same(self, value: f64) -> Self {
        Self::splat(self.0[0].token(), R::of(value))
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        every!(self.0, |k| self.0[k].mul_add(factor.0[k], term.0[k]))
    }

    #[inline(always)]
    fn below(self, limit: Self, then: Self, otherwise: Self) -> Self {
        every!(self.0, |k| self.0[k].simd_lt(limit.0[k]).select(then.0[k], otherwise.0[k]))
    }

    #[inline(always)]
    fn each(mut self, f: impl Fn(R) -> R) -> Self {
        for v in &mut self.0 {
            for number in v.as_mut_slice() {
                *number = f(*number);
            }
        }
        self
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        // A comparison with NaN is false.
        let larger = |a: V<S, R>, b: V<S, R>| a.simd_gt(b) | a.simd_ne(a);
        every!(self.0, |k| larger(self.0[k], other.0[k]).select(self.0[k], other.0[k]))
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        let smaller = |a: V<S, R>, b: V<S, R>| a.simd_lt(b) | a.simd_ne(a);
        every!(self.0, |k| smaller(self.0[k], other.0[k]).select(self.0[k], other.0[k]))
    }

    #[inline(always)]
    fn abs(self) -> Self {
        every!(self.0, |k| self.0[k].abs())
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        every!(self.0, |k| self.0[k].sqrt())
    }

    #[inline(always)]
    fn exp(self) -> Self {
        let all: Self = every!(self.0, |k| R::exp_lanes(self.0[k].token(), self.0[k]));
        all.up_to(STEEP, self, R::exp)
    }

    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        if size_of::<R>() == 8 {
            return (self.each(|x| x.sin_cos().0), self.each(|x| x.sin_cos().1));
        }
        let quarters = (self * R::of(FRAC_2_PI)).round();
        let [first, second, third] = QUARTER.map(|part| self.same(-part));
        let rest = quarters.mul_add(third, quarters.mul_add(second, quarters.mul_add(first, self)));
        let (sin, cos) = rest.sin_cos_of(quarters);
        (sin.up_to(FAR, self, |x| x.sin_cos().0), cos.up_to(FAR, self, |x| x.sin_cos().1))
    }

    #[inline(always)]
    fn sin_cos_turns(self) -> (Self, Self) {
        // From here on every float is an integer. NaN compares false and stays.
        let far = self.same(if size_of::<R>() == 4 { 16_777_216.0 } else { 9_007_199_254_740_992.0 });
        let zero = self.same(0.0);
        let t = every!(self.0, |k| self.0[k].abs().simd_ge(far.0[k]).select(zero.0[k], self.0[k]));
        let quarters = (t * R::of(4.0)).round();
        (quarters.mul_add(self.same(-0.25), t) * R::of(TAU)).sin_cos_of(quarters)
    }

    #[inline(always)]
    fn load(mut self, from: &[R], at: usize) -> Self {
        let (s, len) = (self.0[0].token(), V::<S, R>::LEN);
        if at + Self::ROWS <= from.len() {
            for k in 0..K {
                self.0[k] = V::<S, R>::from_slice(s, &from[at + k * len..][..len]);
            }
        } else {
            for k in 0..K {
                self.0[k] = load(s, from, at + k * len);
            }
        }
        self
    }

    #[inline(always)]
    fn store(self, to: &mut [R], at: usize) {
        let len = V::<S, R>::LEN;
        if at + Self::ROWS <= to.len() {
            for k in 0..K {
                self.0[k].store_slice(&mut to[at + k * len..][..len]);
            }
            // The channels of a tile are far apart, so that no processor foresees where the next rows are written.
            for line in (0..Self::ROWS).step_by(LINE / size_of::<R>()) {
                soon(to, at + Self::ROWS + line);
            }
        } else {
            for k in 0..K {
                if at + k * len < to.len() {
                    store::<S, R>(self.0[k], to, at + k * len);
                }
            }
        }
    }

    #[inline(always)]
    fn sum(mut self, rows: usize) -> R {
        if rows < Self::ROWS {
            for (k, v) in self.0.iter_mut().enumerate() {
                let kept = rows.saturating_sub(k * V::<S, R>::LEN).min(V::<S, R>::LEN);
                v.as_mut_slice()[kept..].fill(R::ZERO);
            }
        }
        let mut sum = self.0[0];
        for k in 1..K {
            sum += self.0[k];
        }
        sum.reduce_sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Op, run};

    /// `f` of all numbers of a list, each a row.
    struct Each<'a, R, F>(&'a [R], F);

    trait Function<R: Real> {
        fn of<N: Lanes<Real = R>>(&self, x: N) -> N;
    }

    impl<R: Real, F: Function<R>> Op for Each<'_, R, F> {
        type Number = R;
        type Out = Vec<R>;
        #[inline(always)]
        fn call<S: Simd>(self, s: S) -> Vec<R> {
            let mut out = vec![R::ZERO; self.0.len()];
            for at in (0..out.len()).step_by(Vectors::<S, R, 4>::ROWS) {
                self.1.of(Vectors::<S, R, 4>::splat(s, R::ZERO).load(self.0, at)).store(&mut out, at);
            }
            out
        }
    }

    macro_rules! function {
        ($name:ident: |$x:ident| $f:expr) => {
            struct $name;
            impl<R: Real> Function<R> for $name {
                #[inline(always)]
                fn of<N: Lanes<Real = R>>(&self, $x: N) -> N {
                    $f
                }
            }
        };
    }

    function!(Sine: |x| x.sin_cos().0);
    function!(Cosine: |x| x.sin_cos().1);
    function!(Exp: |x| x.exp());
    function!(Larger: |x| x.max(x.same(1.0)));
    function!(Smaller: |x| x.min(x.same(1.0)));
    function!(Sign: |x| x.below(x.same(0.0), x.same(-1.0), x.same(1.0)));
    function!(Rest: |x| x - x * R::of(0.5) + R::ONE / R::of(2.0) - x.abs() / R::of(4.0));

    /// 4 numbers a unit, so that some are near multiples of a quarter turn, up to where each is reduced by itself.
    fn angles() -> Vec<f32> {
        (-40_003..40_000).map(|i| i as f32 * 0.25).collect()
    }

    #[test]
    fn sines_are_as_accurate_as_single_precision_allows() {
        let x = angles();
        let (sin, cos) = (run(Each(&x, Sine)), run(Each(&x, Cosine)));
        for (i, &x) in x.iter().enumerate() {
            let (s, c) = f64::from(x).sin_cos();
            let [ds, dc] = [f64::from(sin[i]) - s, f64::from(cos[i]) - c];
            assert!(ds.abs() < 2e-7 && dc.abs() < 2e-7, "{x}: {ds:e} {dc:e}");
        }
        let wide: Vec<f64> = x.iter().map(|&x| x.into()).collect();
        assert_eq!(run(Each(&wide, Sine)), wide.iter().map(|x| x.sin()).collect::<Vec<_>>());
    }

    #[test]
    fn the_ends_of_single_precision_are_exact() {
        let ends = [f32::INFINITY, f32::NEG_INFINITY, f32::NAN, 88.5, 1e4, -100.0, -1e4, 0.0];
        let exp = run(Each(&ends, Exp));
        for (x, y) in ends.iter().zip(&exp) {
            assert!(x.exp().to_bits() == y.to_bits() || (x.is_nan() && y.is_nan()), "exp({x}) = {y}");
        }
        let sin = run(Each(&ends[..5], Sine));
        assert!(sin[..3].iter().all(|s| s.is_nan()) && sin[4] == 1e4f32.sin(), "{sin:?}");
        let (larger, smaller) = (run(Each(&ends[..4], Larger)), run(Each(&ends[..4], Smaller)));
        assert!(larger[2].is_nan() && smaller[2].is_nan());
        assert_eq!((larger[0], larger[1], larger[3]), (f32::INFINITY, 1.0, 88.5));
        assert_eq!((smaller[0], smaller[1], smaller[3]), (1.0, f32::NEG_INFINITY, 1.0));
    }

    #[test]
    fn rows_do_not_mix() {
        let x: Vec<f32> = (0..131).map(|i| (i as f32 - 60.0) * 0.5).collect();
        for (x, y) in x.iter().zip(run(Each(&x, Sign))) {
            assert_eq!(y, if *x < 0.0 { -1.0 } else { 1.0 });
        }
        for (x, y) in x.iter().zip(run(Each(&x, Rest))) {
            assert_eq!(y, 0.5 * x + 0.5 - x.abs() / 4.0);
        }
    }

    struct Sums<'a, R>(&'a [R]);
    impl<R: Real> Op for Sums<'_, R> {
        type Number = R;
        type Out = Vec<R>;
        #[inline(always)]
        fn call<S: Simd>(self, s: S) -> Vec<R> {
            let x = Vectors::<S, R, 4>::splat(s, R::ZERO).load(self.0, 0);
            (0..=Vectors::<S, R, 4>::ROWS).map(|rows| x.sum(rows)).collect()
        }
    }

    #[test]
    fn a_sum_leaves_out_what_is_no_row() {
        let x: Vec<f32> = (0..200).map(|i| (i + 1) as f32).collect();
        for (rows, sum) in run(Sums(&x)).into_iter().enumerate() {
            assert_eq!(sum, (rows * (rows + 1) / 2) as f32);
        }
    }
}
