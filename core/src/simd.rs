//! One source for all precisions and instruction sets.
//!
//! A kernel is written once over a number type [`Real`] (`f32` for work, `f64` for checking gradients) and a SIMD token
//! `S`; [`run`] selects the best instruction set of the machine at run time.

use fearless_simd::Bytes;
pub use fearless_simd::{
    ExtractToken, Level, Select, Simd, SimdBase, SimdFloat, SimdFloatElement, SimdInt, SimdMask, f32x4, i32x4,
};
use std::fmt::{Debug, Display};
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, Mul, MulAssign, Sub, SubAssign};
use std::sync::OnceLock;

/// A native vector of `R` under the token `S`.
pub type V<S, R> = <R as SimdFloatElement>::Native<S>;

/// The number types of stages.
pub trait Real:
    SimdFloatElement
    + Copy
    + Default
    + Debug
    + Display
    + PartialOrd
    + Send
    + Sync
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + AddAssign
    + SubAssign
    + MulAssign
    + Sum
    + 'static
{
    /// Four numbers side by side, on all machines.
    type Four<S: Simd>: SimdFloat<S, Element = Self, Array = [Self; 4]>;
    /// 0.
    const ZERO: Self;
    /// 1.
    const ONE: Self;
    /// The nearest number to `x`.
    fn of(x: f64) -> Self;
    /// Exact conversion to `f64`.
    fn f64(self) -> f64;
    /// Largest integer not above.
    fn floor(self) -> Self;
    /// As a signed integer, rounded towards zero, saturating.
    fn int(self) -> i64;
    /// As an unsigned integer, rounded towards zero, saturating.
    fn count(self) -> u32;
    /// Writes the integer part of every lane (at least 0 and below 2³¹) to `out`, as many as fit.
    fn cells<S: Simd>(s: S, x: V<S, Self>, out: &mut [u32]);
    /// `K` neighbours of every lane: `line[at]`, `line[at + 1]`, … The lanes of `at` are integers in non-decreasing
    /// order. If they span less than four vectors, and `line` is long enough from the first one, registers are shuffled
    /// instead of reading memory lane by lane.
    #[inline(always)]
    fn neighbours<S: Simd, const K: usize>(s: S, line: &[Self], at: V<S, Self>) -> [V<S, Self>; K] {
        one_by_one(s, line, at)
    }
    /// `K` neighbours of every lane within the first `W` vectors of `line`, 2 to 4: `line[at]`, `line[at + 1]`, … The
    /// lanes of `at` are integers, and all neighbours are in range.
    #[inline(always)]
    fn window<S: Simd, const K: usize, const W: usize>(s: S, line: &[Self], at: V<S, Self>) -> [V<S, Self>; K] {
        one_by_one(s, line, at)
    }
    /// Exponential of every lane.
    fn exp_lanes<S: Simd>(s: S, x: V<S, Self>) -> V<S, Self>;
    /// 2 to the power of every lane, which is at most 0; `f32`: relative error below 2e-7, and at least 2^-126.
    fn exp2_lanes<S: Simd>(s: S, x: V<S, Self>) -> V<S, Self>;
    /// Reciprocal square root of every lane, which is positive and neither very large nor very small; `f32`: relative
    /// error below 3e-7.
    fn inverse_root_lanes<S: Simd>(s: S, x: V<S, Self>) -> V<S, Self>;
    /// Distribution function and density of the standard normal, `(Φ(x), φ(x))`, of every lane. `f32`: |error| < 3e-7,
    /// by Abramowitz & Stegun 7.1.26, which shares its exponential with φ. Several vectors at once hide the latency.
    fn normal_lanes<S: Simd, const K: usize>(s: S, x: [V<S, Self>; K]) -> [[V<S, Self>; K]; 2];
    /// Exponential.
    fn exp(self) -> Self;
    /// Natural logarithm.
    fn ln(self) -> Self;
    /// Sine and cosine.
    fn sin_cos(self) -> (Self, Self);
    /// Natural logarithm of `1 + exp(x)` without overflow.
    fn softplus(self) -> Self;
    /// Runs `op` with the instructions for which its kernels are compiled.
    #[inline]
    fn dispatch<O: Op>(op: O) -> O::Out {
        at_baseline(op)
    }
}

/// The functions of single numbers.
macro_rules! functions {
    ($number:ident) => {
        #[inline(always)]
        fn floor(self) -> Self {
            $number::floor(self)
        }
        #[inline(always)]
        fn int(self) -> i64 {
            self as i64
        }
        #[inline(always)]
        fn count(self) -> u32 {
            self as u32
        }
        #[inline(always)]
        fn exp(self) -> Self {
            $number::exp(self)
        }
        #[inline(always)]
        fn ln(self) -> Self {
            $number::ln(self)
        }
        #[inline(always)]
        fn sin_cos(self) -> (Self, Self) {
            $number::sin_cos(self)
        }
        #[inline(always)]
        fn softplus(self) -> Self {
            self.max(0.0) + (-self.abs()).exp().ln_1p()
        }
    };
}

/// 2^r for |r| ≤ ½, highest power first (Remez, relative error 8e-8).
const POWER_OF_TWO: [f32; 6] =
    [1.327_647_2e-3, 9.675_541e-3, 5.550_713_3e-2, 2.402_211_9e-1, 6.931_469_7e-1, 1.000_000_1];

impl Real for f32 {
    functions!(f32);
    type Four<S: Simd> = fearless_simd::f32x4<S>;
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    #[inline(always)]
    fn of(x: f64) -> Self {
        x as f32
    }
    #[inline(always)]
    fn f64(self) -> f64 {
        f64::from(self)
    }
    #[inline(always)]
    fn cells<S: Simd>(_: S, x: V<S, Self>, out: &mut [u32]) {
        let cells: S::u32s = x.to_int();
        let n = out.len().min(S::u32s::LEN);
        if n == S::u32s::LEN {
            cells.store_slice(&mut out[..n]);
        } else {
            out.copy_from_slice(&cells.as_slice()[..n]);
        }
    }
    #[inline(always)]
    fn neighbours<S: Simd, const K: usize>(s: S, line: &[Self], at: V<S, Self>) -> [V<S, Self>; K] {
        if !shuffles(s) {
            return one_by_one(s, line, at);
        }
        let len = S::f32s::LEN;
        let (first, last) = (at.as_slice()[0], at.as_slice()[len - 1]);
        let base = first as usize;
        let span = (last - first) as usize + K;
        let lane = at - first;
        if span <= 2 * len && base + 2 * len <= line.len() {
            return Self::window::<S, K, 2>(s, &line[base..], lane);
        }
        if span <= 4 * len && base + 4 * len <= line.len() {
            return Self::window::<S, K, 4>(s, &line[base..], lane);
        }
        one_by_one(s, line, at)
    }
    #[inline(always)]
    fn window<S: Simd, const K: usize, const W: usize>(s: S, line: &[Self], at: V<S, Self>) -> [V<S, Self>; K] {
        if !shuffles(s) {
            return one_by_one(s, line, at);
        }
        let len = S::f32s::LEN;
        let line = &line[..W * len];
        let register = |k: usize| S::f32s::from_slice(s, &line[k.min(W - 1) * len..][..len]);
        let (near, far) = ([register(0), register(1)], [register(2), register(3)]);
        let first = numbers::<S>(at);
        let mut all = [at; K];
        // A loop: a closure might not be inlined into the code for an instruction set.
        for (k, taken) in all.iter_mut().enumerate() {
            let number = first + k as u32;
            *taken = pick::<S>(s, near[0], near[1], number);
            if W > 2 {
                // Indices into the far vectors count from their start; those into the near two are ignored.
                let far = pick::<S>(s, far[0], far[1], number - 2 * len as u32);
                *taken = at.simd_ge(S::f32s::splat(s, (2 * len - k) as f32)).select(far, *taken);
            }
        }
        all
    }
    #[inline(always)]
    fn exp_lanes<S: Simd>(s: S, x: V<S, Self>) -> V<S, Self> {
        // Range reduction to |r| ≤ ln2/2, then a degree-6 polynomial (relative error 2e-7), then the exponent's bits.
        // In this order NaN stays NaN: x86 returns the second number if one is NaN.
        let x = S::f32s::splat(s, 88.0).min(S::f32s::splat(s, -87.0).max(x));
        let n = (x * std::f32::consts::LOG2_E).round_ties_even();
        let r = n.mul_add(S::f32s::splat(s, -0.693_359_4), x);
        let r = n.mul_add(S::f32s::splat(s, 2.121_944_4e-4), r);
        let mut p = S::f32s::splat(s, 1.388_889e-3);
        for c in [8.333_334e-3, 4.166_666_8e-2, 1.666_666_7e-1, 0.5, 1.0, 1.0] {
            p = p.mul_add(r, S::f32s::splat(s, c));
        }
        let bits: S::i32s = n.to_int();
        let scale: S::f32s = ((bits + 127) << 23).bitcast();
        p * scale
    }
    #[inline(always)]
    fn exp2_lanes<S: Simd>(s: S, x: V<S, Self>) -> V<S, Self> {
        let x = S::f32s::splat(s, -126.0).max(x);
        let n = x.round_ties_even();
        let r = x - n;
        let mut p = S::f32s::splat(s, POWER_OF_TWO[0]);
        for &c in &POWER_OF_TWO[1..] {
            p = p.mul_add(r, S::f32s::splat(s, c));
        }
        // Adds to the exponent: |r| ≤ ½ keeps `p` between 0.7 and 1.5, and n is at least -126.
        let (bits, n): (S::i32s, S::i32s) = (p.bitcast(), n.to_int());
        (bits + (n << 23)).bitcast()
    }
    #[inline(always)]
    fn inverse_root_lanes<S: Simd>(s: S, x: V<S, Self>) -> V<S, Self> {
        #[cfg(target_arch = "x86_64")]
        if let Level::Avx512(avx512) = s.level() {
            // 14 bits, then one Newton step: y·(3/2 - x·y²/2).
            let guess = wide::inverse_root::<S>(s, avx512, x);
            let less = (x * guess * -0.5).mul_add(guess, S::f32s::splat(s, 1.5));
            return guess * less;
        }
        S::f32s::splat(s, 1.0) / x.sqrt()
    }
    #[inline(always)]
    fn normal_lanes<S: Simd, const K: usize>(s: S, x: [V<S, Self>; K]) -> [[V<S, Self>; K]; 2] {
        let number = |v: f32| S::f32s::splat(s, v);
        let (zero, one) = (number(0.0), number(1.0));
        let [mut e, mut t, mut p, mut cdf, mut pdf] = [[zero; K]; 5];
        // exp(-x²/2) = 2^(n + r), |r| ≤ ½. Below 2^-40 (|x| > 7.45)
        // it is 0: products of tails would end among the denormals, which some processors compute far more slowly.
        let least = number(-40.0);
        for k in 0..K {
            let exponent = x[k] * x[k] * (-0.5 * std::f32::consts::LOG2_E);
            let inside = exponent.simd_ge(least);
            let exponent = exponent.max(least);
            let n = exponent.round_ties_even();
            t[k] = exponent - n;
            let bits: S::i32s = n.to_int();
            let power: S::f32s = ((bits + 127) << 23).bitcast();
            e[k] = inside.select(power, zero);
            p[k] = number(POWER_OF_TWO[0]);
        }
        for &c in &POWER_OF_TWO[1..] {
            for k in 0..K {
                p[k] = p[k].mul_add(t[k], number(c));
            }
        }
        for k in 0..K {
            e[k] *= p[k];
            let d = x[k].abs().mul_add(number(0.327_591_1 * std::f32::consts::FRAC_1_SQRT_2), one);
            let guess = d.approximate_recip();
            t[k] = guess * (number(2.0) - d * guess);
            p[k] = number(0.5 * 1.061_405_4);
        }
        for c in [-1.453_152, 1.421_413_8, -0.284_496_74, 0.254_829_6] {
            for k in 0..K {
                p[k] = p[k].mul_add(t[k], number(0.5 * c));
            }
        }
        for k in 0..K {
            let tail = p[k] * t[k] * e[k];
            cdf[k] = x[k].simd_ge(zero).select(one - tail, tail);
            pdf[k] = e[k] * 0.398_942_3;
        }
        [cdf, pdf]
    }
    #[inline]
    fn dispatch<O: Op>(op: O) -> O::Out {
        #[cfg(target_arch = "x86_64")]
        match level() {
            Level::Avx512(s) if const { O::WIDE } => return with(s, op),
            level => {
                if let Some(s) = level.as_avx2() {
                    return with(s, op);
                }
            }
        }
        at_baseline(op)
    }
}

impl Real for f64 {
    functions!(f64);
    type Four<S: Simd> = fearless_simd::f64x4<S>;
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    #[inline(always)]
    fn of(x: f64) -> Self {
        x
    }
    #[inline(always)]
    fn f64(self) -> f64 {
        self
    }
    #[inline(always)]
    fn cells<S: Simd>(_: S, x: V<S, Self>, out: &mut [u32]) {
        for (o, x) in out.iter_mut().zip(x.as_slice()) {
            *o = *x as u32;
        }
    }
    #[inline(always)]
    fn exp_lanes<S: Simd>(_: S, mut x: V<S, Self>) -> V<S, Self> {
        x.as_mut_slice().iter_mut().for_each(|v| *v = v.exp());
        x
    }
    #[inline(always)]
    fn exp2_lanes<S: Simd>(_: S, mut x: V<S, Self>) -> V<S, Self> {
        x.as_mut_slice().iter_mut().for_each(|v| *v = v.exp2());
        x
    }
    #[inline(always)]
    fn inverse_root_lanes<S: Simd>(s: S, x: V<S, Self>) -> V<S, Self> {
        S::f64s::splat(s, 1.0) / x.sqrt()
    }
    #[inline(always)]
    fn normal_lanes<S: Simd, const K: usize>(_: S, x: [V<S, Self>; K]) -> [[V<S, Self>; K]; 2] {
        let (mut cdf, mut pdf) = (x, x);
        for (c, p) in cdf.iter_mut().zip(&mut pdf) {
            for (c, p) in c.as_mut_slice().iter_mut().zip(p.as_mut_slice()) {
                let x = *c;
                *c = 0.5 * libm::erfc(-x * std::f64::consts::FRAC_1_SQRT_2);
                *p = (-0.5 * x * x).exp() * 0.398_942_280_401_432_7;
            }
        }
        [cdf, pdf]
    }
}

/// Every lane, an integer below 2³¹, as an integer. (Conversion to `u32` also looks for larger ones.)
#[inline(always)]
fn numbers<S: Simd>(x: S::f32s) -> S::u32s {
    let signed: S::i32s = x.to_int();
    signed.bitcast()
}

/// Whether a shuffle of registers is faster than reading memory lane by lane. The baseline of x86-64 has no such
/// shuffle.
#[inline(always)]
fn shuffles<S: Simd>(s: S) -> bool {
    #[cfg(target_arch = "x86_64")]
    {
        matches!(s.level(), Level::Avx2(_) | Level::Avx512(_))
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        let _ = s;
        true
    }
}

/// The element of `low` followed by `high` at the index in each lane of `number`.
#[inline(always)]
fn pick<S: Simd>(s: S, low: S::f32s, high: S::f32s, number: S::u32s) -> S::f32s {
    #[cfg(target_arch = "x86_64")]
    match s.level() {
        Level::Avx512(avx512) => return wide::pick16::<S>(s, avx512, low, high, number),
        Level::Avx2(avx2) => return wide::pick8::<S>(s, avx2, low, high, number),
        _ => (),
    }
    // The four bytes of every lane's index.
    low.concat_swizzle_dyn(high, (number * 0x0404_0404 + 0x0302_0100).to_bytes())
}

/// Single instructions of AVX2 and AVX-512 that take several otherwise.
#[cfg(target_arch = "x86_64")]
// The macro calls instructions that its token proves available.
#[allow(unsafe_code)]
mod wide {
    use super::{Simd, SimdBase};
    use fearless_simd::x86::{Avx2, Avx512};
    use fearless_simd::{SimdFrom, f32x8, f32x16, kernel, u32x8, u32x16};
    use std::arch::x86_64::*;

    kernel!(
        #[inline(always)]
        fn permute16(token: Avx512, low: __m512, number: __m512i, high: __m512) -> __m512 {
            let _ = token;
            _mm512_permutex2var_ps(low, number, high)
        }
    );

    kernel!(
        #[inline(always)]
        fn permute8(token: Avx2, low: __m256, number: __m256i, high: __m256) -> __m256 {
            let _ = token;
            // Each permutation reads the lowest three bits of a number; the fourth becomes a sign, which selects.
            let [a, b] = [low, high].map(|x| _mm256_permutevar8x32_ps(x, number));
            _mm256_blendv_ps(a, b, _mm256_castsi256_ps(_mm256_slli_epi32::<28>(number)))
        }
    );

    kernel!(
        #[inline(always)]
        fn rsqrt(token: Avx512, x: __m512) -> __m512 {
            let _ = token;
            _mm512_rsqrt14_ps(x)
        }
    );

    /// Reciprocal square root of every lane, with a relative error below 2^-14.
    #[inline(always)]
    pub(super) fn inverse_root<S: Simd>(s: S, avx512: Avx512, x: S::f32s) -> S::f32s {
        let x = f32x16::from_slice(avx512, x.as_slice()).into();
        S::f32s::from_slice(s, f32x16::simd_from(avx512, rsqrt(avx512, x)).as_slice())
    }

    /// [`pick`](super::pick) of 16 lanes.
    #[inline(always)]
    pub(super) fn pick16<S: Simd>(s: S, avx512: Avx512, low: S::f32s, high: S::f32s, number: S::u32s) -> S::f32s {
        let [low, high] = [low, high].map(|x| f32x16::from_slice(avx512, x.as_slice()).into());
        let number = u32x16::from_slice(avx512, number.as_slice()).into();
        S::f32s::from_slice(s, f32x16::simd_from(avx512, permute16(avx512, low, number, high)).as_slice())
    }

    /// [`pick`](super::pick) of 8 lanes.
    #[inline(always)]
    pub(super) fn pick8<S: Simd>(s: S, avx2: Avx2, low: S::f32s, high: S::f32s, number: S::u32s) -> S::f32s {
        let [low, high] = [low, high].map(|x| f32x8::from_slice(avx2, x.as_slice()).into());
        let number = u32x8::from_slice(avx2, number.as_slice()).into();
        S::f32s::from_slice(s, f32x8::simd_from(avx2, permute8(avx2, low, number, high)).as_slice())
    }
}

/// [`Real::neighbours`] by reading memory. Loops, because even a rare call makes the compiler keep all surrounding
/// vectors in memory.
#[inline(always)]
fn one_by_one<S: Simd, R: Real, const K: usize>(s: S, line: &[R], at: V<S, R>) -> [V<S, R>; K] {
    let mut all = [at; K];
    for (k, taken) in all.iter_mut().enumerate() {
        let mut numbers = [R::ZERO; WIDEST];
        for (number, at) in numbers.iter_mut().zip(at.as_slice()) {
            *number = line[at.count() as usize + k];
        }
        *taken = V::<S, R>::from_slice(s, &numbers[..V::<S, R>::LEN]);
    }
    all
}

/// `line[at]` and `line[at + 1]` of every lane, which must be in range. Reads both at once.
#[inline(always)]
pub fn pairs<S: Simd>(s: S, line: &[f32], at: &[usize; WIDEST]) -> [S::f32s; 2] {
    let mut read = [0.0; WIDEST];
    // A loop: a closure might not be inlined into the code for an instruction set.
    for (pair, &at) in read[..S::f32s::LEN].iter_mut().zip(at) {
        let [a, b] = [line[at], line[at + 1]].map(|x| u64::from(x.to_bits()));
        *pair = f64::from_bits(if cfg!(target_endian = "little") { a | b << 32 } else { b | a << 32 });
    }
    let [low, high] = [0, S::f64s::LEN].map(|from| S::f64s::from_slice(s, &read[from..from + S::f64s::LEN]));
    low.bitcast::<S::f32s>().deinterleave(high.bitcast::<S::f32s>()).into()
}

/// Work on numbers of one type, compiled for several instruction sets. `call` must be `#[inline(always)]`.
pub trait Op {
    /// The numbers worked on. `f32` has three sets of instructions: the baseline, AVX2 and AVX-512. `f64` checks the
    /// arithmetic and has the baseline only.
    type Number: Real;
    /// Result of the work.
    type Out;
    /// Whether vectors of 512 bits make it faster: otherwise it is not compiled for them.
    const WIDE: bool = true;
    /// Does the work with the instructions of `s`.
    fn call<S: Simd>(self, s: S) -> Self::Out;
}

/// Runs `op` with the best instructions that it has for this machine, or those named by `CONEFIELD_SIMD` (`avx512`,
/// `avx2`, `baseline`) if the machine has them.
#[inline]
pub fn run<O: Op>(op: O) -> O::Out {
    O::Number::dispatch(op)
}

#[inline(always)]
fn with<S: Simd, O: Op>(s: S, op: O) -> O::Out {
    s.vectorize(
        #[inline(always)]
        || op.call(s),
    )
}

#[inline(always)]
fn at_baseline<O: Op>(op: O) -> O::Out {
    #[cfg(target_arch = "x86_64")]
    match level().as_sse2() {
        Some(s) => with(s, op),
        None => unreachable!("every x86-64 processor has SSE2"),
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        fearless_simd::dispatch!(level(), s => op.call(s))
    }
}

/// The instruction set that [`run`] uses.
pub fn level() -> Level {
    static LEVEL: OnceLock<Level> = OnceLock::new();
    *LEVEL.get_or_init(|| {
        let best = Level::new();
        #[cfg(target_arch = "x86_64")]
        {
            let wanted = match std::env::var("CONEFIELD_SIMD").as_deref() {
                Ok("avx2") => best.as_avx2().map(Level::Avx2),
                Ok("baseline") => best.as_sse2().map(Level::Sse2),
                _ => None,
            };
            wanted.unwrap_or(best)
        }
        #[cfg(not(target_arch = "x86_64"))]
        best
    })
}

/// The content of `CONEFIELD_SIMD`, if it names other instructions than [`level`].
pub fn other_level() -> Option<String> {
    let wanted = std::env::var_os("CONEFIELD_SIMD")?.to_string_lossy().into_owned();
    (wanted != level_name()).then_some(wanted)
}

/// The name of [`level`], as in `CONEFIELD_SIMD`.
pub fn level_name() -> &'static str {
    match level() {
        #[cfg(target_arch = "x86_64")]
        Level::Avx512(_) => "avx512",
        #[cfg(target_arch = "x86_64")]
        Level::Avx2(_) => "avx2",
        _ => "baseline",
    }
}

/// Lanes of the widest supported vector.
pub const WIDEST: usize = 16;

/// Up to a vector's worth of `x` from `at`; lanes past the end are 0.
#[inline(always)]
pub fn load<S: Simd, R: Real>(s: S, x: &[R], at: usize) -> V<S, R> {
    let len = V::<S, R>::LEN;
    // Both branches end in one vector load: joined after it, they are merged lane by lane.
    let tail;
    let whole = if at + len <= x.len() {
        &x[at..at + len]
    } else {
        tail = padded(x, at);
        &tail[..len]
    };
    V::<S, R>::from_slice(s, whole)
}

/// The remaining elements of `x` from `at`, padded with zeros.
#[cold]
#[inline(never)]
fn padded<R: Real>(x: &[R], at: usize) -> [R; WIDEST] {
    let rest = x.get(at..).unwrap_or_default();
    let mut tail = [R::ZERO; WIDEST];
    tail[..rest.len()].copy_from_slice(rest);
    tail
}

/// Stores the lanes of `v` that fit into `y` from `at`.
#[inline(always)]
pub fn store<S: Simd, R: Real>(v: V<S, R>, y: &mut [R], at: usize) {
    let len = V::<S, R>::LEN;
    if at + len <= y.len() {
        v.store_slice(&mut y[at..at + len]);
    } else {
        let mut lanes = [R::ZERO; WIDEST];
        v.store_slice(&mut lanes[..len]);
        store_tail(&lanes, y, at);
    }
}

/// Copies as many of the first `lanes` as `y` has from `at`.
#[cold]
#[inline(never)]
fn store_tail<R: Real>(lanes: &[R; WIDEST], y: &mut [R], at: usize) {
    let n = y.len() - at;
    y[at..].copy_from_slice(&lanes[..n]);
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Normal<'a, R>(&'a [R]);
    impl<R: Real> Op for Normal<'_, R> {
        type Number = R;
        type Out = Vec<[f64; 5]>;
        #[inline(always)]
        fn call<S: Simd>(self, s: S) -> Self::Out {
            let mut out = vec![];
            for i in (0..self.0.len()).step_by(V::<S, R>::LEN) {
                let x = load(s, self.0, i);
                let [[c], [p]] = R::normal_lanes(s, [x]);
                let e = R::exp_lanes(s, x);
                let root = R::inverse_root_lanes(s, e);
                let power = R::exp2_lanes(s, x.min(V::<S, R>::splat(s, R::ZERO)));
                for k in 0..V::<S, R>::LEN.min(self.0.len() - i) {
                    out.push([c, p, e, root, power].map(|v| v.as_slice()[k].f64()));
                }
            }
            out
        }
    }

    #[test]
    fn f32_normal_and_exp_agree_with_f64() {
        let x: Vec<f64> = (-400..=400).map(|i| f64::from(i) * 0.025).collect();
        let x32: Vec<f32> = x.iter().map(|&v| v as f32).collect();
        let x64: Vec<f64> = x32.iter().map(|&v| f64::from(v)).collect();
        for (i, (a, b)) in run(Normal(&x32)).iter().zip(run(Normal(&x64))).enumerate() {
            assert!((a[0] - b[0]).abs() < 3e-7, "Φ({}) = {} not {}", x[i], a[0], b[0]);
            assert!((a[1] - b[1]).abs() < 2e-7, "φ({}) = {} not {}", x[i], a[1], b[1]);
            assert!((a[2] / b[2] - 1.0).abs() < 5e-7, "exp({}) = {} not {}", x[i], a[2], b[2]);
            assert!((a[3] * a[2].sqrt() - 1.0).abs() < 3e-7, "1/sqrt({}) = {}", a[2], a[3]);
            assert!((a[4] / b[4] - 1.0).abs() < 2e-7, "2^{} = {} not {}", x[i].min(0.0), a[4], b[4]);
        }
        let ends = run(Normal(&[-125.75f32, -126.0, -1e30]));
        assert!((ends[0][4] / (-125.75f64).exp2() - 1.0).abs() < 2e-7);
        assert!(ends[1][4] >= (-126f64).exp2() * (1.0 - 2e-7) && ends[2][4] == ends[1][4]);
    }

    /// Products of several of them must not end among the denormals, which halved the speed of training.
    #[test]
    fn tails_of_the_normal_are_zero_or_far_from_denormals() {
        let x: Vec<f32> = (-1000..=0).map(|i| i as f32 * 0.025).collect();
        for (&x, [cdf, pdf, ..]) in x.iter().zip(run(Normal(&x))) {
            for tail in [cdf, pdf] {
                assert!(if x < -7.44 { tail == 0.0 } else { tail > 1e-14 }, "{tail:e} at {x}");
            }
        }
    }

    struct Neighbours<'a, R>(&'a [R], f64);
    impl<R: Real> Op for Neighbours<'_, R> {
        type Number = R;
        type Out = Vec<[f64; 3]>;
        #[inline(always)]
        fn call<S: Simd>(self, s: S) -> Self::Out {
            let at = V::<S, R>::from_fn(s, |i| R::of((3.0 + self.1 * i as f64).floor()));
            let found = R::neighbours::<S, 3>(s, self.0, at);
            let lane = |i: usize| std::array::from_fn(|k| found[k].as_slice()[i].f64());
            (0..V::<S, R>::LEN).map(lane).collect()
        }
    }

    #[test]
    fn neighbours_are_found_near_and_far_apart() {
        let line: Vec<f32> = (0..200).map(|i| (i * i) as f32).collect();
        let wide: Vec<f64> = line.iter().map(|&x| x.into()).collect();
        for step in [0.0, 0.3, 1.0, 1.7, 2.6, 3.4, 5.0] {
            for found in [run(Neighbours(&line, step)), run(Neighbours(&wide, step))] {
                for (i, three) in found.into_iter().enumerate() {
                    let first = (3.0 + step * i as f64).floor();
                    assert_eq!(three, [0.0, 1.0, 2.0].map(|k| (first + k) * (first + k)), "step {step} lane {i}");
                }
            }
        }
    }
}
