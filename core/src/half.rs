//! 16-bit numbers for tables: half the memory, fewer digits.
//!
//! Conversions are branch-free integer arithmetic, so that a plain loop over them vectorizes on every instruction set.
//! They round to nearest, ties to even. Finite numbers stay finite: they saturate at the largest number of the format.

use crate::simd::Real;
use bytemuck::{Pod, Zeroable};

/// A storage format of numbers that are computed with as `R`.
pub trait Stored<R>: Copy + Default + Send + Sync + 'static {
    /// Its value, exactly.
    fn value(self) -> R;
}

impl<R: Real> Stored<R> for R {
    #[inline(always)]
    fn value(self) -> R {
        self
    }
}

/// A 16-bit format of `f32` values.
pub trait Half: Stored<f32> + Pod {
    /// The nearest number to `x`.
    fn nearest(x: f32) -> Self;
}

/// IEEE 754 `binary16`: 11 bits, steps of 2⁻²⁴ below 2⁻¹⁴, at most 65504.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(transparent)]
pub struct F16(pub u16);

/// The upper half of an `f32`: 8 bits, same range.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(transparent)]
pub struct Bf16(pub u16);

const INFINITE: u32 = 0x7f80_0000;

impl Stored<f32> for F16 {
    #[inline(always)]
    fn value(self) -> f32 {
        let bits = u32::from(self.0);
        let magnitude = bits & 0x7fff;
        // Exponents have bias 15 here and 127 there; the largest one means infinite or NaN in both.
        let normal = (magnitude << 13) + (112 << 23);
        let normal = if magnitude < 0x7c00 { normal } else { normal + (112 << 23) };
        let denormal = (magnitude as i32 as f32 * (1.0 / 16_777_216.0)).to_bits();
        f32::from_bits((bits & 0x8000) << 16 | if magnitude < 0x400 { denormal } else { normal })
    }
}

impl Half for F16 {
    #[inline(always)]
    fn nearest(x: f32) -> Self {
        let bits = x.to_bits();
        let magnitude = bits & 0x7fff_ffff;
        let finite = magnitude.min(65_504f32.to_bits());
        let normal = ((finite + 0xfff + (finite >> 13 & 1)) >> 13).wrapping_sub(112 << 10);
        // The last bit of a number from ½ to 1 is 2⁻²⁴, as for a denormal half: the sum rounds.
        let denormal = (f32::from_bits(finite) + 0.5).to_bits().wrapping_sub(0.5f32.to_bits());
        let rounded = if finite < 0x3880_0000 { denormal } else { normal };
        let special = if magnitude > INFINITE { 0x7e00 } else { 0x7c00 };
        Self(((bits >> 16 & 0x8000) | if magnitude < INFINITE { rounded } else { special }) as u16)
    }
}

impl Stored<f32> for Bf16 {
    #[inline(always)]
    fn value(self) -> f32 {
        f32::from_bits(u32::from(self.0) << 16)
    }
}

impl Half for Bf16 {
    #[inline(always)]
    fn nearest(x: f32) -> Self {
        let bits = x.to_bits();
        let magnitude = bits & 0x7fff_ffff;
        let finite = magnitude.min(0x7f7f_0000);
        let rounded = (finite + 0x7fff + (finite >> 16 & 1)) >> 16;
        let special = if magnitude > INFINITE { 0x7fc0 } else { 0x7f80 };
        Self(((bits >> 16 & 0x8000) | if magnitude < INFINITE { rounded } else { special }) as u16)
    }
}

/// Applies `to` to `from`, element by element, up to the shorter length.
#[inline(always)]
pub fn round<H: Half>(from: &[f32], to: &mut [H]) {
    for (to, &from) in to.iter_mut().zip(from) {
        *to = H::nearest(from);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers of every exponent, and the ties and their neighbours between `values`.
    fn numbers(values: impl Iterator<Item = f32>) -> Vec<f32> {
        let mut all: Vec<f32> = (0..1 << 16).map(|i| f32::from_bits(i * 65_537)).collect();
        let mut last = 0.0f32;
        for value in values.filter(|v| v.is_finite() && *v > 0.0) {
            let tie = last + 0.5 * (value - last);
            all.extend([value, tie, tie.next_up(), tie.next_down(), -tie, -tie.next_up()]);
            last = value;
        }
        all
    }

    #[test]
    fn f16_is_that_of_another_library() {
        for i in 0..=u16::MAX {
            let (a, b) = (F16(i).value(), half::f16::from_bits(i).to_f32());
            assert!(a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan(), "{i:#x}: {a:e} {b:e}");
        }
        for x in numbers((0..=u16::MAX).map(|i| F16(i).value())) {
            let (found, want) = (F16::nearest(x), half::f16::from_f32(x));
            match x.is_finite() && !want.is_finite() {
                true => assert_eq!(found.value(), 65_504f32.copysign(x), "{x:e}"),
                false if x.is_nan() => assert!(found.value().is_nan()),
                false => assert_eq!(found.0, want.to_bits(), "{x:e}"),
            }
        }
    }

    #[test]
    fn bf16_is_that_of_another_library() {
        for x in numbers((0..=u16::MAX).map(|i| Bf16(i).value())) {
            let (found, want) = (Bf16::nearest(x), half::bf16::from_f32(x));
            match x.is_finite() && !want.is_finite() {
                true => assert_eq!(found.value(), f32::from_bits(0x7f7f_0000).copysign(x), "{x:e}"),
                false if x.is_nan() => assert!(found.value().is_nan()),
                false => assert_eq!(found.0, want.to_bits(), "{x:e}"),
            }
        }
    }

    #[test]
    fn what_is_finite_stays_finite_and_what_is_not_stays_so() {
        for x in [65_520.0, 1e5, 1e30, f32::MAX] {
            assert_eq!([F16::nearest(x).value(), F16::nearest(-x).value()], [65_504.0, -65_504.0]);
            assert!(Bf16::nearest(x).value().is_finite());
        }
        assert_eq!(F16::nearest(1e-8).value(), 0.0);
        assert_eq!(F16::nearest(f32::INFINITY).value(), f32::INFINITY);
        assert_eq!(Bf16::nearest(f32::NEG_INFINITY).value(), f32::NEG_INFINITY);
        // All bits of a NaN: rounding them up would give 0.
        let nan = f32::from_bits(0x7fff_ffff);
        assert!(F16::nearest(nan).value().is_nan() && Bf16::nearest(nan).value().is_nan());
    }
}
