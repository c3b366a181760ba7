//! Element-wise activations with their derivatives.

use crate::simd::{Op, Real, Select, Simd, SimdBase, SimdFloat, V, load, run, store};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// WGSL source of every [`Activation`].
pub const WGSL: &str = include_str!("activation.wgsl");

/// SquarePlus's `b` in NI-NeRF.
pub const SQUAREPLUS_B: f64 = 1.523_821_03;

/// Element-wise function after a linear map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Activation {
    /// `x`
    None,
    /// `max(x, 0)`
    Relu,
    /// `x` above 0, `0.01·x` below
    LeakyRelu,
    /// `x·Φ(x)` (Hendrycks & Gimpel 2016), not its tanh approximation
    Gelu,
    /// `(x + √(x² + b))/2` with b = 1.52382103 (Barron 2021)
    Squareplus,
    /// `ln(1 + eˣ)`
    Softplus,
    /// `1/(1 + e⁻ˣ)`
    Sigmoid,
}

impl Activation {
    /// Name of its function in [`WGSL`].
    pub fn wgsl(self) -> &'static str {
        match self {
            Self::None => "stage_none",
            Self::Relu => "stage_relu",
            Self::LeakyRelu => "stage_leaky_relu",
            Self::Gelu => "stage_gelu",
            Self::Squareplus => "stage_squareplus",
            Self::Softplus => "stage_softplus",
            Self::Sigmoid => "stage_sigmoid",
        }
    }

    /// Values and derivatives.
    #[inline(always)]
    fn at<S: Simd, R: Real, const K: usize>(self, s: S, x: [V<S, R>; K]) -> [[V<S, R>; K]; 2] {
        if self == Self::Gelu {
            return gelu::<S, R, K>(s, x);
        }
        let (mut y, mut slope) = (x, x);
        for k in 0..K {
            (y[k], slope[k]) = self.of::<S, R>(s, x[k]);
        }
        [y, slope]
    }

    /// Value and derivative of one vector.
    #[inline(always)]
    fn of<S: Simd, R: Real>(self, s: S, x: V<S, R>) -> (V<S, R>, V<S, R>) {
        let number = |v: f64| V::<S, R>::splat(s, R::of(v));
        let (zero, one) = (number(0.0), number(1.0));
        match self {
            Self::None => (x, one),
            Self::Relu => {
                let on = x.simd_gt(zero);
                // In this order NaN stays NaN.
                (zero.max(x), on.select(one, zero))
            }
            Self::LeakyRelu => {
                let slope = x.simd_gt(zero).select(one, number(0.01));
                (x * slope, slope)
            }
            Self::Gelu => {
                let [[y], [slope]] = gelu::<S, R, 1>(s, [x]);
                (y, slope)
            }
            Self::Squareplus => {
                // Above 1e18 the square would overflow, and the root equals |x| to the last bit.
                let small = x.abs().min(number(1e18));
                let root = small.mul_add(small, number(SQUAREPLUS_B)).sqrt().max(x.abs());
                ((x + root) * number(0.5), (x / root + one) * number(0.5))
            }
            Self::Softplus => {
                let mut y = x;
                y.as_mut_slice().iter_mut().for_each(|v| *v = v.softplus());
                (y, sigmoid::<S, R>(s, x))
            }
            Self::Sigmoid => {
                let y = sigmoid::<S, R>(s, x);
                (y, y * (one - y))
            }
        }
    }
}

#[inline(always)]
fn gelu<S: Simd, R: Real, const K: usize>(s: S, x: [V<S, R>; K]) -> [[V<S, R>; K]; 2] {
    let [cdf, pdf] = R::normal_lanes(s, x);
    let (mut y, mut slope) = (x, x);
    for k in 0..K {
        y[k] = x[k] * cdf[k];
        slope[k] = x[k].mul_add(pdf[k], cdf[k]);
    }
    [y, slope]
}

#[inline(always)]
fn sigmoid<S: Simd, R: Real>(s: S, x: V<S, R>) -> V<S, R> {
    let one = V::<S, R>::splat(s, R::ONE);
    one / (one + R::exp_lanes(s, V::<S, R>::splat(s, R::ZERO) - x))
}

/// Vectors whose activations are computed side by side.
const AT_ONCE: usize = 4;

/// `h = f(z)`, `z = f'(z)`.
#[inline(never)]
pub fn activate<R: Real>(act: Activation, z: &mut [R], h: &mut [R]) {
    run(Activate { act, z, h });
}

struct Activate<'a, R> {
    act: Activation,
    z: &'a mut [R],
    h: &'a mut [R],
}

impl<R: Real> Op for Activate<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        activate_all(s, self.act, self.z, self.h);
    }
}

#[inline(always)]
fn activate_all<S: Simd, R: Real>(s: S, act: Activation, z: &mut [R], h: &mut [R]) {
    // One loop per activation, so that no loop branches inside.
    macro_rules! each {
        ($($a:ident),*) => {
            match act {
                $(Activation::$a => {
                    let len = V::<S, R>::LEN;
                    let mut i = 0;
                    while i + AT_ONCE * len <= z.len() {
                        // Whole vectors only: a branch for the tail would serialize them.
                        let (z, h) = (&mut z[i..i + AT_ONCE * len], &mut h[i..i + AT_ONCE * len]);
                        let x = std::array::from_fn(|k| V::<S, R>::from_slice(s, &z[k * len..(k + 1) * len]));
                        let [y, slope] = Activation::$a.at::<S, R, AT_ONCE>(s, x);
                        for k in 0..AT_ONCE {
                            y[k].store_slice(&mut h[k * len..(k + 1) * len]);
                            slope[k].store_slice(&mut z[k * len..(k + 1) * len]);
                        }
                        i += AT_ONCE * len;
                    }
                    while i < z.len() {
                        let [[y], [slope]] = Activation::$a.at::<S, R, 1>(s, [load(s, z, i)]);
                        store::<S, R>(y, h, i);
                        store::<S, R>(slope, z, i);
                        i += len;
                    }
                })*
            }
        };
    }
    each!(None, Relu, LeakyRelu, Gelu, Squareplus, Softplus, Sigmoid);
}
