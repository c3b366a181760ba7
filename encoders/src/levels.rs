//! Common code of encoders with several levels of features: initialization, the level of each channel, the parameters
//! of a level and the requested part of their gradients, and WGSL: calls of `stage_level_forward` and
//! `stage_level_backward`, level by level, with the levels' settings as constants.

use conefield_core::random::{mix, unit};
use conefield_core::simd::{Real, Simd, SimdBase, SimdFloat, V, load, store};
use conefield_core::stage::{Grads, Parameter, Tile, TileMut};
use conefield_core::wgsl;
use std::fmt::Write;
use std::ops::Range;

/// Features are initialized uniformly in ± this (Müller et al. 2022, section 4).
const START: f32 = 1e-4;

/// Rows processed together: their entries and weights stay in the L1 cache.
pub const BLOCK: usize = conefield_core::trilinear::BLOCK;

/// Initializes features.
pub fn start(seed: u64, params: &mut [f32]) {
    for (i, p) in params.iter_mut().enumerate() {
        *p = (2.0 * unit(mix(seed, i as u64)) - 1.0) * START;
    }
}

/// Runs `features` of an operation with the stage's number of features as a constant.
macro_rules! by_features {
    ($op:ident) => {
        impl<R: Real> Op for $op<'_, R> {
            type Number = R;
            type Out = ();
            #[inline(always)]
            fn call<S: Simd>(self, s: S) {
                match self.stage.features {
                    1 => self.features::<S, 1>(s),
                    2 => self.features::<S, 2>(s),
                    4 => self.features::<S, 4>(s),
                    _ => self.features::<S, 8>(s),
                }
            }
        }
    };
}
pub(crate) use by_features;

/// The kernel of a stage with `levels`: its `Forward` over a range of levels, one pass each, and its `Backward`.
macro_rules! kernel_of_levels {
    ($stage:ident) => {
        impl<R: Real> Kernel<R> for $stage {
            fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
                run(Forward { stage: self, levels: 0..self.levels.len(), params, x, y });
            }

            fn passes(&self) -> usize {
                self.levels.len()
            }

            fn forward_pass(&self, pass: usize, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
                run(Forward { stage: self, levels: pass..pass + 1, params, x, y });
            }

            fn backward(
                &self,
                params: &[R],
                x: Tile<'_, R>,
                _: TileMut<'_, R>,
                dy: Tile<'_, R>,
                grads: Grads<'_, R>,
                dx: Option<TileMut<'_, R>>,
            ) {
                run(Backward { stage: self, params, x, dy, grads, dx });
            }
        }
    };
}
pub(crate) use kernel_of_levels;

/// Cells of a block's rows along each axis of the cube, which is divided into equal cells.
pub struct Cells<R> {
    /// The cell.
    pub cell: [[u32; BLOCK]; 3],
    /// Fraction within the cell, 0 to 1.
    pub fraction: [[R; BLOCK]; 3],
}

impl<R: Real> Cells<R> {
    /// A buffer for a block.
    pub fn new() -> Self {
        Self { cell: [[0; BLOCK]; 3], fraction: [[R::ZERO; BLOCK]; 3] }
    }

    /// Locates rows `at..at + n` of `x` among `cells` cells. Points outside the cube are clamped to its rim, a NaN
    /// coordinate to 0.
    #[inline(always)]
    pub fn locate<S: Simd>(&mut self, s: S, cells: u32, x: Tile<'_, R>, at: usize, n: usize) {
        let number = |v: f64| V::<S, R>::splat(s, R::of(v));
        let (zero, scale, last) = (number(0.0), number(f64::from(cells)), number(f64::from(cells - 1)));
        for d in 0..3 {
            let x = &x.channel(d)[at..at + n];
            let mut i = 0;
            while i < n {
                // The precise maximum returns the number if the other operand is NaN.
                let p = (load(s, x, i) * scale).max_precise(zero).min(scale);
                let c = p.floor().min(last);
                store::<S, R>(p - c, &mut self.fraction[d], i);
                R::cells(s, c, &mut self.cell[d][i..]);
                i += V::<S, R>::LEN;
            }
        }
    }
}

/// Derivative of a position among `cells` with respect to a coordinate. Beyond the rim the position is clamped.
#[inline(always)]
pub fn stretch<R: Real>(x: R, cells: u32) -> R {
    if x >= R::ZERO && x <= R::ONE { R::of(f64::from(cells)) } else { R::ZERO }
}

/// The parameters of a level, and the channels of its features.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// Index of the first parameter.
    pub start: usize,
    /// Number of parameters.
    pub len: usize,
    /// Index of the level in the settings, which names its parameters.
    pub number: usize,
    /// Output channel of each feature; `None` if unused.
    pub outputs: Vec<Option<usize>>,
}

impl Table {
    /// The range of its parameters.
    pub fn range(&self) -> Range<usize> {
        self.start..self.start + self.len
    }

    /// The block of its parameters, with this shape.
    pub fn parameter(&self, shape: Vec<usize>) -> Parameter {
        Parameter { name: format!("{}.table", self.number), shape, start: self.start }
    }

    /// The same level with only the channels `keep` in use and its parameters at `start`; `None` if no channel is in
    /// use.
    pub fn kept(&self, keep: &[usize], start: usize) -> Option<Self> {
        let place = |c: &Option<usize>| c.and_then(|c| keep.iter().position(|&k| k == c));
        let outputs: Vec<_> = self.outputs.iter().map(place).collect();
        outputs.iter().any(Option::is_some).then(|| Self { start, outputs, ..self.clone() })
    }

    /// Writes the features of rows `at..at + n` to their channels.
    #[inline(always)]
    pub fn put<R: Real, const F: usize>(&self, out: &[[R; F]; BLOCK], y: &mut TileMut<'_, R>, at: usize, n: usize) {
        for (f, channel) in self.outputs.iter().enumerate() {
            if let Some(c) = *channel {
                for (y, out) in y.channel(c)[at..at + n].iter_mut().zip(out) {
                    *y = out[f];
                }
            }
        }
    }

    /// Reads the gradients of the features of rows `at..at + n`.
    #[inline(always)]
    pub fn take<R: Real, const F: usize>(&self, dy: Tile<'_, R>, into: &mut [[R; F]; BLOCK], at: usize, n: usize) {
        for (f, channel) in self.outputs.iter().enumerate() {
            match *channel {
                Some(c) => into.iter_mut().zip(&dy.channel(c)[at..at + n]).for_each(|(to, &v)| to[f] = v),
                None => into[..n].iter_mut().for_each(|to| to[f] = R::ZERO),
            }
        }
    }
}

/// The requested part of a level's gradients in a call of `backward`: all, none, or a part. If only part of a level is
/// requested, the rest is summed too, into a separate buffer: the order of summation stays the same.
pub struct Asked<R> {
    /// The requested range among the values of the call.
    own: Range<usize>,
    /// The same range among those of the level.
    place: Range<usize>,
    beside: Vec<R>,
}

impl<R: Real> Asked<R> {
    /// The part of `level` that `grads` requests.
    pub fn of(grads: &Grads<'_, R>, level: &Range<usize>) -> Self {
        let range = &grads.range;
        let (from, to) = (level.start.max(range.start), level.end.min(range.end));
        if from >= to {
            return Self { own: 0..0, place: 0..0, beside: vec![] };
        }
        let own = from - range.start..to - range.start;
        let place = from - level.start..to - level.start;
        let part = if to - from < level.len() { level.len() } else { 0 };
        let mut beside = vec![R::ZERO; part];
        if part > 0 {
            beside[place.clone()].copy_from_slice(&grads.values[own.clone()]);
        }
        Self { own, place, beside }
    }

    /// Whether nothing is requested.
    pub fn is_empty(&self) -> bool {
        self.own.is_empty()
    }

    /// Where to add the level's gradients: all of them, or none.
    pub fn values<'a>(&'a mut self, grads: &'a mut Grads<'_, R>) -> &'a mut [R] {
        if self.beside.is_empty() { &mut grads.values[self.own.clone()] } else { &mut self.beside }
    }

    /// Copies the requested part to its place.
    pub fn finish(self, grads: &mut Grads<'_, R>) {
        if !self.beside.is_empty() {
            grads.values[self.own].copy_from_slice(&self.beside[self.place]);
        }
    }
}

/// Entry `i` of a level's table. A bounds check per entry doubles the time of the backward pass.
///
/// # Safety
/// `i` is below the length of `table`.
#[inline(always)]
#[allow(unsafe_code)]
pub unsafe fn entry<T>(table: &[T], i: u32) -> &T {
    debug_assert!((i as usize) < table.len());
    // SAFETY: the caller's promise.
    unsafe { table.get_unchecked(i as usize) }
}

/// Mutable version of [`entry`].
///
/// # Safety
/// `i` is below the length of `table`.
#[inline(always)]
#[allow(unsafe_code)]
pub unsafe fn entry_mut<T>(table: &mut [T], i: u32) -> &mut T {
    debug_assert!((i as usize) < table.len());
    // SAFETY: the caller's promise.
    unsafe { table.get_unchecked_mut(i as usize) }
}

/// A table of at least this many bytes does not stay in the L2 cache.
const LARGE: usize = 1 << 20;

/// Prefetches the cache lines of the first `n` entries of each of `indices`, so that misses overlap instead of stalling
/// one row after another. They go to the L2 cache: L1 has no room for them besides the block's other data.
#[inline(always)]
#[allow(unsafe_code)]
pub fn prefetch<'a, T>(table: &[T], indices: impl Iterator<Item = &'a [u32; BLOCK]>, n: usize) {
    #[cfg(target_arch = "x86_64")]
    if size_of_val(table) >= LARGE {
        for index in indices {
            for &i in &index[..n] {
                // SAFETY: a prefetch reads nothing and faults on no address.
                unsafe {
                    use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
                    _mm_prefetch::<_MM_HINT_T1>(table.as_ptr().wrapping_add(i as usize).cast());
                }
            }
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (table, indices, n);
}

/// For each of `width` channels, the cells per side of its level; levels are given with their output channels.
pub fn by_channel<'a>(levels: impl Iterator<Item = (f64, &'a [Option<usize>])>, width: usize) -> Vec<f64> {
    let mut cells = vec![0.0; width];
    for (resolution, outputs) in levels {
        outputs.iter().flatten().for_each(|&c| cells[c] = resolution);
    }
    cells
}

/// A level in WGSL.
pub struct LevelCode {
    /// A value of type `stage_Level`.
    pub value: String,
    /// Output channel of each feature; `None` if unused.
    pub outputs: Vec<Option<usize>>,
}

/// `stage_forward` and `stage_backward` of an encoder with `width` output channels, and `stage_features_grad` for its
/// levels, which adds `w` times `dy` to the gradients of the entry that begins at parameter `entry`.
pub fn functions(levels: &[LevelCode], width: usize) -> String {
    let mut grad =
        String::from("fn stage_features_grad(entry: u32, w: f32, dy: ptr<function, array<f32, stage_FEATURES>>) {\n");
    let features = levels.first().map_or(0, |l| l.outputs.len());
    if features.is_multiple_of(2) {
        for f in (0..features).step_by(2) {
            let _ = writeln!(grad, "    stage_grad_pair(entry + {f}u, w * vec2<f32>((*dy)[{f}], (*dy)[{}]));", f + 1);
        }
    } else {
        for f in 0..features {
            let _ = writeln!(grad, "    stage_grad(entry + {f}u, w * (*dy)[{f}]);");
        }
    }
    grad += "}\n";
    let (mut forward, mut backward) = (String::new(), String::new());
    for (l, LevelCode { value, outputs }) in levels.iter().enumerate() {
        let _ = writeln!(forward, "    let v{l} = stage_level_forward(p, {value});");
        let _ = writeln!(backward, "    var d{l}: array<f32, stage_FEATURES>;");
        for (f, c) in outputs.iter().enumerate().filter_map(|(f, c)| Some((f, (*c)?))) {
            let _ = writeln!(forward, "    (*y)[{c}] = v{l}[{f}];");
            let _ = writeln!(backward, "    d{l}[{f}] = (*dy)[{c}];");
        }
        let _ = writeln!(backward, "    slope += stage_level_backward(p, {value}, &d{l});");
    }
    let p = "    let p = vec3<f32>((*x)[0], (*x)[1], (*x)[2]);\n";
    let slope = "    (*dx)[0] = slope.x;\n    (*dx)[1] = slope.y;\n    (*dx)[2] = slope.z;\n";
    let backward = format!("{p}    var slope = vec3<f32>(0.0);\n{backward}{slope}");
    grad + &wgsl::functions(3, width, &format!("{p}{forward}"), &backward)
}
