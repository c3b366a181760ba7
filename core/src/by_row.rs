//! Stages written for one row at a time: the simple way to an encoder, normalizer or field.
//!
//! A [`RowMap`] defines the channels of one row and their gradients. [`ByRow`] makes a complete [`Stage`] of it, with
//! tiles, double-precision checks and masked channels. Stages that need maximum speed implement [`Stage`] and
//! [`Kernel`] directly.

use crate::error::{Error, Result};
use crate::simd::Real;
use crate::stage::{
    Encoder, Field, GradKind, Grads, Info, Kernel, Normalizer, Parameter, Reduced, Scope, Stage, Tile, TileMut,
};
use crate::wgsl::Fragment;
use std::ops::Range;
use std::sync::Arc;

/// Up to this many parameters, each worker sums gradients in its own copy. Above it, one worker sums all.
const FEW: usize = 1 << 20;

/// Rows whose outputs are written together. Those of one row are all in different cache lines, and with many rows these
/// displace each other before the next row is written.
const BLOCK: usize = 16;

/// A map of the channels of one row. One source serves `f32` and `f64`.
pub trait RowMap: Send + Sync + 'static {
    /// Input and output channels. An encoder has 3 inputs, a field 1 output.
    fn widths(&self) -> [usize; 2];

    /// Name and shape of each block of parameters, in order.
    fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        vec![]
    }

    /// Fills `params` with initial values, reproducible by `seed`.
    fn init(&self, seed: u64, params: &mut [f32]) {
        let _ = (seed, params);
    }

    /// Computes the output channels `y` from the input channels `x`. `y` is 0 on entry.
    fn forward<R: Real>(&self, params: &[R], x: &[R], y: &mut [R]);

    /// Given `dy = ∂L/∂y`, adds `∂L/∂params` to `grads` and `∂L/∂x` to `dx`, which is 0 on entry.
    fn backward<R: Real>(&self, params: &[R], x: &[R], dy: &[R], grads: &mut Sums<'_, R>, dx: &mut [R]);

    /// A line for `explain` that begins with the type name.
    fn describe(&self) -> String;

    /// Multiply-adds of a forward pass, for `explain`.
    fn macs(&self) -> usize {
        let [input, output] = self.widths();
        input * output
    }

    /// See [`Encoder::coarse_to_fine`].
    fn coarse_to_fine(&self) -> bool {
        false
    }

    /// See [`Encoder::resolutions`].
    fn resolutions(&self) -> Option<Vec<f64>> {
        None
    }

    /// See [`Stage::wgsl`].
    fn wgsl(&self) -> Option<Fragment> {
        None
    }

    /// For a normalizer of independent channels: the map of the channels `keep` alone, and the parameters that it
    /// keeps. See [`Normalizer::keep_inputs`].
    fn keep(&self, keep: &[usize]) -> Option<(Self, Vec<Range<usize>>)>
    where
        Self: Sized,
    {
        let _ = keep;
        None
    }
}

/// Accumulator of parameter gradients.
pub struct Sums<'a, R>(Grads<'a, R>);

impl<R: Real> Sums<'_, R> {
    /// Adds `value` to the gradient of parameter `index`.
    #[inline(always)]
    pub fn add(&mut self, index: usize, value: R) {
        // Another worker sums the others.
        if self.0.range.contains(&index) {
            self.0.values[index - self.0.range.start] += value;
        }
    }
}

/// The stage of a [`RowMap`].
pub struct ByRow<T> {
    map: Arc<T>,
    /// Input channels of the map that are used; the others are 0.
    inputs: Vec<usize>,
    /// Output channels of the map that are used.
    outputs: Vec<usize>,
}

impl<T: RowMap> ByRow<T> {
    /// The stage of `map`.
    pub fn new(map: T) -> Self {
        let [input, output] = map.widths();
        Self { map: Arc::new(map), inputs: (0..input).collect(), outputs: (0..output).collect() }
    }

    /// All parameters: a reduced stage keeps them.
    fn params(&self) -> Vec<Range<usize>> {
        let all = 0..self.info().params;
        if all.is_empty() { vec![] } else { vec![all] }
    }

    /// The stage that computes only the outputs `keep`.
    fn without_outputs(&self, keep: &[usize]) -> (Self, Vec<Range<usize>>, Vec<usize>) {
        let outputs = keep.iter().map(|&c| self.outputs[c]).collect();
        let stage = Self { map: self.map.clone(), inputs: self.inputs.clone(), outputs };
        (stage, self.params(), (0..self.inputs.len()).collect())
    }

    /// Copies row `i` of `from` to channels `places` of `to`.
    #[inline(always)]
    fn take<R: Real>(from: Tile<'_, R>, i: usize, places: &[usize], to: &mut [R]) {
        for (c, &place) in places.iter().enumerate() {
            to[place] = from.data[c * from.rows + i];
        }
    }
}

impl<T: RowMap, R: Real> Kernel<R> for ByRow<T> {
    fn forward(&self, params: &[R], x: Tile<'_, R>, mut y: TileMut<'_, R>, _: TileMut<'_, R>) {
        let [input, output] = self.map.widths();
        let (mut row, mut out) = (vec![R::ZERO; input], vec![R::ZERO; output * BLOCK.min(x.rows)]);
        for at in (0..x.rows).step_by(BLOCK) {
            let rows = at..x.rows.min(at + BLOCK);
            out.fill(R::ZERO);
            for i in rows.clone() {
                Self::take(x, i, &self.inputs, &mut row);
                self.map.forward(params, &row, &mut out[(i - at) * output..][..output]);
            }
            for (c, &place) in self.outputs.iter().enumerate() {
                let from = out.iter().skip(place).step_by(output);
                y.channel(c)[rows.clone()].iter_mut().zip(from).for_each(|(to, from)| *to = *from);
            }
        }
    }

    fn backward(
        &self,
        params: &[R],
        x: Tile<'_, R>,
        _: TileMut<'_, R>,
        dy: Tile<'_, R>,
        grads: Grads<'_, R>,
        mut dx: Option<TileMut<'_, R>>,
    ) {
        let [mut row, mut d] = self.map.widths().map(|n| vec![R::ZERO; n]);
        let (mut slope, mut grads) = (row.clone(), Sums(grads));
        for i in 0..x.rows {
            Self::take(x, i, &self.inputs, &mut row);
            Self::take(dy, i, &self.outputs, &mut d);
            slope.fill(R::ZERO);
            self.map.backward(params, &row, &d, &mut grads, &mut slope);
            if let Some(dx) = &mut dx {
                for (c, &place) in self.inputs.iter().enumerate() {
                    dx.data[c * dx.rows + i] = slope[place];
                }
            }
        }
    }
}

impl<T: RowMap> Stage for ByRow<T> {
    fn info(&self) -> Info {
        let params = self.parameters().last().map_or(0, |p| p.range().end);
        let grads = match params {
            0 => GradKind::None,
            1..=FEW => GradKind::Dense,
            _ => GradKind::Scatter,
        };
        let (input, output, macs) = (self.inputs.len(), self.outputs.len(), self.map.macs());
        Info { input, output, params, tape: 0, scope: Scope::Row, grads, macs, identity: false }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let blocks = self.map.parameters().into_iter();
        let place = |start: &mut usize, (name, shape): (String, Vec<usize>)| {
            let parameter = Parameter { name, shape, start: *start };
            *start = parameter.range().end;
            Some(parameter)
        };
        blocks.scan(0, place).collect()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        self.map.init(seed, params);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    /// Only for the whole map: a reduced stage runs on the CPU.
    fn wgsl(&self) -> Option<Fragment> {
        let [input, output] = self.map.widths();
        let whole = [self.inputs.len(), self.outputs.len()] == [input, output];
        self.map.wgsl().filter(|_| whole)
    }

    fn describe(&self) -> String {
        let [_, all] = self.map.widths();
        let (what, kept) = (self.map.describe(), self.outputs.len());
        if kept == all { what } else { format!("{what}, {kept} of {all} channels") }
    }
}

impl<T: RowMap> Encoder for ByRow<T> {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        let (stage, params, channels) = self.without_outputs(keep);
        Ok(Reduced { stage: Box::new(stage), params, channels })
    }

    fn coarse_to_fine(&self) -> bool {
        self.map.coarse_to_fine()
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        let all = self.map.resolutions()?;
        Some(self.outputs.iter().map(|&c| all[c]).collect())
    }
}

impl<T: RowMap> Normalizer for ByRow<T> {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        let cannot = || Error::unsupported(self.describe(), "this normalizer does not support removing inputs");
        let (map, params) = self.map.keep(keep).ok_or_else(cannot)?;
        Ok(Reduced { stage: Box::new(Self::new(map)), params, channels: keep.to_vec() })
    }
}

impl<T: RowMap> Field for ByRow<T> {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        let inputs = keep.iter().map(|&c| self.inputs[c]).collect();
        let stage = Self { map: self.map.clone(), inputs, outputs: self.outputs.clone() };
        Ok(Reduced { stage: Box::new(stage), params: self.params(), channels: (0..self.outputs.len()).collect() })
    }
}
