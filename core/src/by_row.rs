//! Stages written for one row at a time: the simple way to an encoder, normalizer or field, and a fast one.
//!
//! A [`RowMap`] defines the channels of one row and their gradients. [`ByRow`] makes a complete [`Stage`] of it, with
//! tiles, vectors of rows, double-precision checks and masked channels. A stage that works on more than a row, or keeps
//! numbers from forward to backward, implements [`Stage`] and [`Kernel`] directly.

use crate::error::{Error, Result, ensure};
use crate::lanes::{Lanes, Vectors};
use crate::simd::{Op, Real, Simd, run};
use crate::stage::{
    Backward, Encoder, Field, GradKind, Grads, Info, Kernel, Normalizer, Parameter, Reduced, Scope, Stage, Tile,
    TileMut,
};
use crate::wgsl::Fragment;
use std::ops::Range;
use std::sync::Arc;

/// Up to this many parameters, each worker sums gradients in its own copy. Above it, one worker sums all.
const FEW: usize = 1 << 20;

/// Vectors of rows at once. The last rows of a tile are computed one vector at a time.
const AT_ONCE: usize = 4;

/// A map of the channels of one row. A number is an `N: Lanes`, one of each of several rows, so that one source serves
/// single and double precision and the vectors of every processor. `forward` and `backward` should be
/// `#[inline(always)]`, and so should the functions that they call with `N`.
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

    /// Writes all output channels `y`, from the input channels `x`.
    fn forward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, y: &mut ChannelsMut<N>);

    /// Given `dy = ∂L/∂y`, adds `∂L/∂params` and `∂L/∂x` to `grads`.
    fn backward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, dy: Channels<N>, grads: &mut Gradients<N>);

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

    /// The map of the channels `keep` alone, outputs of an encoder or inputs of a normalizer or field, and the parameters
    /// that it keeps. Without it, an encoder computes all outputs and drops some, a field gets 0 for a missing input, and
    /// a normalizer refuses. See [`Encoder::keep_outputs`], [`Normalizer::keep_inputs`] and [`Field::keep_inputs`].
    fn keep(&self, keep: &[usize]) -> Option<(Self, Vec<Range<usize>>)>
    where
        Self: Sized,
    {
        let _ = keep;
        None
    }
}

/// Channels of some rows, to read.
#[derive(Clone, Copy)]
pub struct Channels<'a, N: Lanes> {
    tile: Tile<'a, N::Real>,
    /// The channel of the tile for each of the map.
    places: &'a [Option<usize>],
    /// The first row.
    row: usize,
    zero: N,
}

impl<N: Lanes> Channels<'_, N> {
    /// Channel `c`; 0 if it is masked.
    #[inline(always)]
    pub fn at(&self, c: usize) -> N {
        match self.places[c] {
            Some(place) => self.zero.load(self.tile.channel(place), self.row),
            None => self.zero,
        }
    }

    /// The number `value` in every row.
    #[inline(always)]
    pub fn same(&self, value: f64) -> N {
        self.zero.same(value)
    }
}

/// Channels of some rows, to write.
pub struct ChannelsMut<'a, N: Lanes> {
    tile: TileMut<'a, N::Real>,
    /// The channel of the tile for each of the map; what has none is not needed.
    places: &'a [Option<usize>],
    /// The first row.
    row: usize,
    zero: N,
}

impl<N: Lanes> ChannelsMut<'_, N> {
    /// Writes channel `c`.
    #[inline(always)]
    pub fn set(&mut self, c: usize, value: N) {
        if let Some(place) = self.places[c] {
            value.store(self.tile.channel(place), self.row);
        }
    }
}

/// Gradients of parameters and inputs, to add to.
pub struct Gradients<'a, N: Lanes> {
    params: Grads<'a, N::Real>,
    /// Rows of the present numbers.
    rows: usize,
    inputs: ChannelsMut<'a, N>,
}

impl<N: Lanes> Gradients<'_, N> {
    /// Adds to the gradient of parameter `index`.
    #[inline(always)]
    pub fn param(&mut self, index: usize, value: N) {
        // Another worker sums the others.
        if self.params.range.contains(&index) {
            self.params.values[index - self.params.range.start] += value.sum(self.rows);
        }
    }

    /// Adds to the gradient of input channel `c`.
    #[inline(always)]
    pub fn input(&mut self, c: usize, value: N) {
        let ChannelsMut { tile, places, row, zero } = &mut self.inputs;
        if let Some(place) = places[c] {
            let channel = tile.channel(place);
            (zero.load(channel, *row) + value).store(channel, *row);
        }
    }
}

/// The stage of a [`RowMap`].
pub struct ByRow<T> {
    map: Arc<T>,
    /// The channel of the stage for each input of the map; a masked one has none.
    inputs: Vec<Option<usize>>,
    /// The same for its outputs.
    outputs: Vec<Option<usize>>,
}

impl<T: RowMap> ByRow<T> {
    /// The stage of `map`.
    pub fn new(map: T) -> Self {
        let [inputs, outputs] = map.widths().map(|n| (0..n).map(Some).collect());
        Self { map: Arc::new(map), inputs, outputs }
    }

    /// All parameters: a reduced stage keeps them.
    fn params(&self) -> Vec<Range<usize>> {
        let all = 0..self.info().params;
        if all.is_empty() { vec![] } else { vec![all] }
    }

    /// Whether it has all channels of the map.
    fn whole(&self) -> bool {
        self.inputs.iter().chain(&self.outputs).all(Option::is_some)
    }

    /// The stage without some channels, and the parameters that it keeps: of the map that its author wrote for that, or
    /// of the same map with these channels.
    fn kept(
        &self,
        keep: &[usize],
        inputs: Vec<Option<usize>>,
        outputs: Vec<Option<usize>>,
    ) -> (Self, Vec<Range<usize>>) {
        match self.map.keep(keep).filter(|_| self.whole()) {
            Some((map, params)) => (Self::new(map), params),
            None => (Self { map: self.map.clone(), inputs, outputs }, self.params()),
        }
    }
}

/// These channels without all but `keep`.
fn only(channels: &[Option<usize>], keep: &[usize]) -> Vec<Option<usize>> {
    channels.iter().map(|c| keep.iter().position(|k| Some(*k) == *c)).collect()
}

/// The number of channels that are used.
fn used(channels: &[Option<usize>]) -> usize {
    channels.iter().flatten().count()
}

struct Forward<'a, T, R> {
    stage: &'a ByRow<T>,
    params: &'a [R],
    x: Tile<'a, R>,
    y: TileMut<'a, R>,
}

impl<T: RowMap, R: Real> Forward<'_, T, R> {
    /// Rows `from` to `to`, so many at once that the last may be past the end.
    #[inline(always)]
    fn rows<S: Simd, const K: usize>(&mut self, s: S, from: usize, to: usize) {
        let (zero, ByRow { map, inputs, outputs }) = (Vectors::<S, R, K>::splat(s, R::ZERO), self.stage);
        for row in (from..to).step_by(Vectors::<S, R, K>::ROWS) {
            let x = Channels { tile: self.x, places: inputs, row, zero };
            let tile = TileMut::new(self.y.data, self.y.rows);
            map.forward(self.params, x, &mut ChannelsMut { tile, places: outputs, row, zero });
        }
    }
}

impl<T: RowMap, R: Real> Op for Forward<'_, T, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(mut self, s: S) {
        let (rows, most) = (self.x.rows, Vectors::<S, R, AT_ONCE>::ROWS);
        let whole = rows - rows % most;
        self.rows::<S, AT_ONCE>(s, 0, whole);
        self.rows::<S, 1>(s, whole, rows);
    }
}

struct Back<'a, T, R> {
    stage: &'a ByRow<T>,
    pass: Backward<'a, R>,
}

impl<T: RowMap, R: Real> Back<'_, T, R> {
    /// As [`Forward::rows`]; `nowhere` is for the gradients of inputs that nobody asks for.
    #[inline(always)]
    fn rows<S: Simd, const K: usize>(&mut self, s: S, from: usize, to: usize, nowhere: &[Option<usize>]) {
        let (zero, ByRow { map, inputs, outputs }) = (Vectors::<S, R, K>::splat(s, R::ZERO), self.stage);
        for row in (from..to).step_by(Vectors::<S, R, K>::ROWS) {
            let x = Channels { tile: self.pass.x, places: inputs, row, zero };
            let dy = Channels { tile: self.pass.dy, places: outputs, row, zero };
            let (tile, places) = match &mut self.pass.dx {
                Some(dx) => (TileMut::new(dx.data, dx.rows), &inputs[..]),
                None => (TileMut::new(&mut [], 1), nowhere),
            };
            let params = Grads { values: self.pass.grads.values, range: self.pass.grads.range.clone() };
            let inputs = ChannelsMut { tile, places, row, zero };
            let rows = Vectors::<S, R, K>::ROWS.min(to - row);
            map.backward(self.pass.params, x, dy, &mut Gradients { params, rows, inputs });
        }
    }
}

impl<T: RowMap, R: Real> Op for Back<'_, T, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(mut self, s: S) {
        let nowhere = vec![None; self.stage.inputs.len()];
        if let Some(dx) = &mut self.pass.dx {
            dx.data.fill(R::ZERO);
        }
        let (rows, most) = (self.pass.x.rows, Vectors::<S, R, AT_ONCE>::ROWS);
        let whole = rows - rows % most;
        self.rows::<S, AT_ONCE>(s, 0, whole, &nowhere);
        self.rows::<S, 1>(s, whole, rows, &nowhere);
    }
}

impl<T: RowMap, R: Real> Kernel<R> for ByRow<T> {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
        run(Forward { stage: self, params, x, y });
    }

    fn backward(&self, pass: Backward<'_, R>) {
        run(Back { stage: self, pass });
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
        let (input, output, macs) = (used(&self.inputs), used(&self.outputs), self.map.macs());
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

    /// Only for a whole map: with masked channels the stage runs on the CPU.
    fn wgsl(&self) -> Option<Fragment> {
        self.map.wgsl().filter(|_| self.whole())
    }

    fn describe(&self) -> String {
        let [_, all] = self.map.widths();
        let (what, kept) = (self.map.describe(), used(&self.outputs));
        if kept == all { what } else { format!("{what}, {kept} of {all} channels") }
    }
}

impl<T: RowMap> Encoder for ByRow<T> {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        ensure(!keep.is_empty(), &self.describe(), "channels", "none kept", "at least one")?;
        let (stage, params) = self.kept(keep, self.inputs.clone(), only(&self.outputs, keep));
        Ok(Reduced { stage: Box::new(stage), params, channels: (0..self.inputs.len()).collect() })
    }

    fn coarse_to_fine(&self) -> bool {
        self.map.coarse_to_fine()
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        let all = self.map.resolutions()?;
        Some(self.outputs.iter().zip(all).filter(|(c, _)| c.is_some()).map(|(_, cells)| cells).collect())
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
        let (stage, params) = self.kept(keep, only(&self.inputs, keep), self.outputs.clone());
        Ok(Reduced { stage: Box::new(stage), params, channels: (0..self.outputs.len()).collect() })
    }
}
