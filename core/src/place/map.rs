//! Elementwise maps and reductions: each with one text in Rust and one in WGSL.

use crate::parallel;
use ndarray::{Array3, CowArray, Ix3};

/// Numbers per task of a map: few enough for the first-level cache.
const PART: usize = 1 << 12;
/// Numbers per partial sum of a reduction.
const SUMMED: usize = 1 << 16;

/// A map of an element `o` and the same element of one or two other arrays, with two constants.
pub struct Map {
    /// Its name in messages.
    pub name: &'static str,
    /// Number of other arrays.
    pub inputs: usize,
    /// The new element in WGSL: an expression of `o`, `x`, `y`, `a` and `b`.
    pub wgsl: &'static str,
    /// The same in Rust for some neighbouring elements.
    host: fn([f64; 2], &mut [f32], [&[f32]; 2]),
}

/// `a·x + b·o`. With b = 0 a copy: `o` is not read.
pub const ADD: Map = Map {
    name: "sum",
    inputs: 1,
    wgsl: "select(a * x + b * o, a * x, b == 0.0)",
    host: |[a, b], out, [x, _]| {
        let [a, b] = [a as f32, b as f32];
        let all = out.iter_mut().zip(x);
        if b == 0.0 {
            all.for_each(|(o, x)| *o = a * x);
        } else {
            all.for_each(|(o, x)| *o = a * x + b * *o);
        }
    },
};

/// `x/a`.
pub const DIVIDE: Map = Map {
    name: "quotient",
    inputs: 1,
    wgsl: "x / a",
    host: |[a, _], out, [x, _]| out.iter_mut().zip(x).for_each(|(o, x)| *o = (f64::from(*x) / a) as f32),
};

/// `a·x·o`.
pub const MULTIPLY: Map = Map {
    name: "product",
    inputs: 1,
    wgsl: "o * (a * x)",
    host: |[a, _], out, [x, _]| {
        let a = a as f32;
        out.iter_mut().zip(x).for_each(|(o, x)| *o *= a * x);
    },
};

/// `x + a·(x − y)`.
pub const EXTRAPOLATE: Map = Map {
    name: "extrapolation",
    inputs: 2,
    wgsl: "x + a * (x - y)",
    host: |[a, _], out, [x, y]| {
        let a = a as f32;
        out.iter_mut().zip(x).zip(y).for_each(|((o, x), y)| *o = x + a * (x - y));
    },
};

/// `max(b, o + a·x·y)`.
pub const RELAX: Map = Map {
    name: "relaxed step",
    inputs: 2,
    wgsl: "max(b, o + a * x * y)",
    host: |[a, b], out, [x, y]| {
        let [a, b] = [a as f32, b as f32];
        out.iter_mut().zip(x).zip(y).for_each(|((o, x), y)| *o = (*o + a * x * y).max(b));
    },
};

/// `1/o` where `o > a`, else 0.
pub const INVERT: Map = Map {
    name: "inverse",
    inputs: 0,
    wgsl: "select(0.0, 1.0 / o, o > a)",
    host: |[a, _], out, _| {
        let a = a as f32;
        out.iter_mut().for_each(|o| *o = if *o > a { 1.0 / *o } else { 0.0 });
    },
};

/// `a` where `o < a`, `b` where `o > b`. A NaN stays.
pub const CLIP: Map = Map {
    name: "clip",
    inputs: 0,
    wgsl: "select(select(o, b, o > b), a, o < a)",
    host: |[a, b], out, _| {
        let [a, b] = [a as f32, b as f32];
        let clip = |o: f32| if o > b { b } else { o };
        out.iter_mut().for_each(|o| *o = if *o < a { a } else { clip(*o) });
    },
};

impl Map {
    /// All maps.
    pub const ALL: [&'static Map; 7] = [&ADD, &DIVIDE, &MULTIPLY, &RELAX, &EXTRAPOLATE, &INVERT, &CLIP];

    /// Overwrites `out` on the host; all arrays have the same shape and are in standard order.
    pub fn run(&self, factors: [f64; 2], out: &mut Array3<f32>, inputs: &[CowArray<'_, f32, Ix3>]) {
        let inputs: Vec<&[f32]> = inputs.iter().filter_map(|x| x.as_slice()).collect();
        let out = out.as_slice_mut().unwrap_or_default();
        parallel::over(out.chunks_mut(PART), |n, out| {
            let part = n * PART..n * PART + out.len();
            let input = |i: usize| inputs.get(i).map_or(&[][..], |x| &x[part.clone()]);
            (self.host)(factors, out, [input(0), input(1)]);
        });
    }
}

/// A number of an array, or of two, summed in a fixed order on the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reduction {
    /// `Σ x²`.
    Squares,
    /// `Σ (x − y)²`.
    Differences,
    /// The largest x, at least 0.
    Maximum,
    /// Number of elements other than 0.
    Nonzero,
}

impl Reduction {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Squares, Self::Differences, Self::Maximum, Self::Nonzero];

    /// An element's share in WGSL, an expression of `x` and `y`. Shares are added, or compared for the maximum.
    pub fn wgsl(self) -> &'static str {
        match self {
            Self::Squares => "x * x",
            Self::Differences => "(x - y) * (x - y)",
            Self::Maximum => "max(x, 0.0)",
            Self::Nonzero => "select(0.0, 1.0, x != 0.0)",
        }
    }

    /// The reduction of arrays on the host.
    pub fn of(self, x: &CowArray<'_, f32, Ix3>, y: &CowArray<'_, f32, Ix3>) -> f64 {
        let (x, y) = (x.as_slice().unwrap_or_default(), y.as_slice().unwrap_or_default());
        match self {
            Self::Squares => squares(x),
            Self::Differences => {
                let square = |(a, b): (&f32, &f32)| (f64::from(*a) - f64::from(*b)).powi(2);
                let part = |(x, y): (&[f32], &[f32])| x.iter().zip(y).map(square).sum::<f64>();
                ordered(x.chunks(SUMMED).zip(y.chunks(SUMMED)), part)
            }
            Self::Maximum => {
                let part = |part: &[f32]| part.iter().fold(0.0f32, |m, &v| m.max(v));
                let all = parallel::map(x.chunks(SUMMED), |_, x| part(x));
                f64::from(part(&all))
            }
            Self::Nonzero => ordered(x.chunks(SUMMED), |x| x.iter().filter(|x| **x != 0.0).count() as f64),
        }
    }
}

/// `Σ x²`, independent of the number of threads.
pub fn squares(x: &[f32]) -> f64 {
    let part = |part: &[f32]| part.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>();
    ordered(x.chunks(SUMMED), part)
}

fn ordered<T: Send>(parts: impl Iterator<Item = T>, sum: impl Fn(T) -> f64 + Sync) -> f64 {
    parallel::map(parts, |_, part| sum(part)).iter().sum()
}
