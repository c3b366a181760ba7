//! What a stage is: a validated, immutable set of settings with a forward and a hand-written backward pass over
//! tiles of rows.
//!
//! A tile is channel-major: channel `c` of row `i` stands at `c·rows + i`. Rows are samples, in ray-major order.

use crate::error::{Error, Result};
use crate::half::{Bf16, F16, Half};
use crate::simd::Real;
use crate::wgsl::Fragment;
use std::ops::Range;

/// Rows that the host puts into a tile at most; the encoder gets thousands at once. A stage must accept any number
/// from 1 up.
pub const TILE_ROWS: usize = 256;

/// Channels of some rows, read-only.
#[derive(Debug, Clone, Copy)]
pub struct Tile<'a, R> {
    /// `[width][rows]`.
    pub data: &'a [R],
    /// Rows, at least 1.
    pub rows: usize,
}

impl<'a, R> Tile<'a, R> {
    /// A tile over `data`, whose length is a multiple of `rows`.
    pub fn new(data: &'a [R], rows: usize) -> Self {
        debug_assert!(rows > 0 && data.len().is_multiple_of(rows));
        Self { data, rows }
    }

    /// Channels.
    pub fn width(&self) -> usize {
        self.data.len() / self.rows
    }

    /// One channel.
    #[inline(always)]
    pub fn channel(&self, c: usize) -> &'a [R] {
        &self.data[c * self.rows..(c + 1) * self.rows]
    }

    /// Some neighbouring channels.
    #[inline(always)]
    pub fn channels(&self, c: Range<usize>) -> &'a [R] {
        &self.data[c.start * self.rows..c.end * self.rows]
    }
}

/// Channels of some rows, to be written.
#[derive(Debug)]
pub struct TileMut<'a, R> {
    /// `[width][rows]`.
    pub data: &'a mut [R],
    /// Rows, at least 1.
    pub rows: usize,
}

impl<'a, R> TileMut<'a, R> {
    /// A tile over `data`, whose length is a multiple of `rows`.
    pub fn new(data: &'a mut [R], rows: usize) -> Self {
        debug_assert!(rows > 0 && data.len().is_multiple_of(rows));
        Self { data, rows }
    }

    /// Channels.
    pub fn width(&self) -> usize {
        self.data.len() / self.rows
    }

    /// One channel.
    #[inline(always)]
    pub fn channel(&mut self, c: usize) -> &mut [R] {
        &mut self.data[c * self.rows..(c + 1) * self.rows]
    }

    /// Splits off the first `channels`; the tile keeps the others.
    pub fn take(&mut self, channels: usize) -> &'a mut [R] {
        let (first, others) = std::mem::take(&mut self.data).split_at_mut(channels * self.rows);
        self.data = others;
        first
    }
}

/// The part of a stage's gradient that a call of [`Kernel::backward`] adds to.
#[derive(Debug)]
pub struct Grads<'a, R> {
    /// Gradients of the parameters `range`, which starts at parameter `range.start` of the stage.
    pub values: &'a mut [R],
    /// Which parameters of the stage these are. A kernel leaves the others alone.
    pub range: Range<usize>,
}

impl<'a, R> Grads<'a, R> {
    /// Gradients of every parameter of a stage.
    pub fn all(values: &'a mut [R]) -> Self {
        let range = 0..values.len();
        Self { values, range }
    }
}

/// How far the result of a row may look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Scope {
    /// Its own row only.
    Row,
    /// The rows of its ray: the host hands it tiles of one whole ray, and of a single row for points off any ray.
    Ray,
}

/// How a stage's parameters receive gradients.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum GradKind {
    /// It has no parameters.
    None,
    /// Few parameters, every one touched by every row: each worker sums its own copy, copies are merged in order.
    Dense,
    /// Many parameters, few touched by a row: workers own disjoint ranges ([`Stage::partition`]) and go through
    /// the rows in order, so that no copy and no atomic is needed and sums have one order. Such a stage keeps no
    /// tape.
    Scatter,
}

/// A stage's name with the type that its description begins with, for messages.
pub fn titled(name: &str, what: &str) -> String {
    format!("{name} ({})", what.split(':').next().unwrap_or(what))
}

/// All that a planner needs to know of a stage.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Info {
    /// Channels in.
    pub input: usize,
    /// Channels out.
    pub output: usize,
    /// Parameters.
    pub params: usize,
    /// Numbers a row that forward leaves for backward.
    pub tape: usize,
    /// How far a row looks.
    pub scope: Scope,
    /// How gradients arrive.
    pub grads: GradKind,
    /// Multiply-adds a row, forward.
    pub macs: usize,
    /// Output equals input: hosts leave the stage out.
    pub identity: bool,
}

/// One named block of a stage's parameters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Parameter {
    /// Name within the stage, e.g. `0.weight`.
    pub name: String,
    /// Shape, row-major.
    pub shape: Vec<usize>,
    /// First parameter of the block within the stage.
    pub start: usize,
}

impl Parameter {
    /// Its place within the stage's parameters.
    pub fn range(&self) -> Range<usize> {
        self.start..self.start + self.shape.iter().product::<usize>()
    }
}

/// The arithmetic of a stage in one precision, of parameters that stand in memory as `P`.
pub trait Kernel<R: Real, P = R>: Send + Sync {
    /// `y = f(x; params)`. Fills `tape` (`[info.tape][rows]`) with what [`Kernel::backward`] needs.
    fn forward(&self, params: &[P], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>);

    /// `tape` holds what forward left and may be used as scratch. Given `dy = ∂L/∂y`: *adds* `∂L/∂params` to `grads` and, where `dx` is given, overwrites it with `∂L/∂x`.
    /// The order in which a parameter's gradient is summed must not depend on `grads.range`.
    fn backward(
        &self,
        params: &[P],
        x: Tile<'_, R>,
        tape: TileMut<'_, R>,
        dy: Tile<'_, R>,
        grads: Grads<'_, R>,
        dx: Option<TileMut<'_, R>>,
    );

    /// How many passes [`Kernel::forward`] goes in, each over a table of its own: a host with many tiles sends all of
    /// them through one before the next, while its table is in the cache.
    fn passes(&self) -> usize {
        1
    }

    /// One pass of [`Kernel::forward`], `pass` of [`Kernel::passes`]; all of them in order are the whole.
    fn forward_pass(&self, pass: usize, params: &[P], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        debug_assert_eq!(pass, 0);
        self.forward(params, x, y, tape);
    }
}

impl<R: Real, P, K: Kernel<R, P> + ?Sized> Kernel<R, P> for &K {
    fn forward(&self, params: &[P], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        (**self).forward(params, x, y, tape);
    }

    fn passes(&self) -> usize {
        (**self).passes()
    }

    fn forward_pass(&self, pass: usize, params: &[P], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        (**self).forward_pass(pass, params, x, y, tape);
    }

    fn backward(
        &self,
        params: &[P],
        x: Tile<'_, R>,
        tape: TileMut<'_, R>,
        dy: Tile<'_, R>,
        grads: Grads<'_, R>,
        dx: Option<TileMut<'_, R>>,
    ) {
        (**self).backward(params, x, tape, dy, grads, dx);
    }
}

/// A stage's arithmetic on parameters that are read in halves: what [`Stage::kernel`] makes of the same values.
/// Gradients are `f32`.
#[derive(Clone, Copy)]
pub struct Halves<'a> {
    /// Of `binary16`.
    pub f16: &'a dyn Kernel<f32, F16>,
    /// Of `bfloat16`.
    pub bf16: &'a dyn Kernel<f32, Bf16>,
}

impl<'a> Halves<'a> {
    /// Of a stage that has one source for both.
    pub fn of<K: Kernel<f32, F16> + Kernel<f32, Bf16>>(kernel: &'a K) -> Self {
        Self { f16: kernel, bf16: kernel }
    }
}

/// A kernel with parameters in halves, which it reads instead of those that it is handed.
pub struct Reader<'a, H> {
    /// The arithmetic.
    pub kernel: &'a dyn Kernel<f32, H>,
    /// What it reads.
    pub params: &'a [H],
}

impl<H: Half> Kernel<f32> for Reader<'_, H> {
    fn forward(&self, _: &[f32], x: Tile<'_, f32>, y: TileMut<'_, f32>, tape: TileMut<'_, f32>) {
        self.kernel.forward(self.params, x, y, tape);
    }

    fn passes(&self) -> usize {
        self.kernel.passes()
    }

    fn forward_pass(&self, pass: usize, _: &[f32], x: Tile<'_, f32>, y: TileMut<'_, f32>, tape: TileMut<'_, f32>) {
        self.kernel.forward_pass(pass, self.params, x, y, tape);
    }

    fn backward(
        &self,
        _: &[f32],
        x: Tile<'_, f32>,
        tape: TileMut<'_, f32>,
        dy: Tile<'_, f32>,
        grads: Grads<'_, f32>,
        dx: Option<TileMut<'_, f32>>,
    ) {
        self.kernel.backward(self.params, x, tape, dy, grads, dx);
    }
}

/// A map from rows of `info.input` channels to rows of `info.output` channels.
pub trait Stage: Send + Sync {
    /// Widths, counts and cost.
    fn info(&self) -> Info;

    /// Names and shapes of the parameters, in order, without gaps.
    fn parameters(&self) -> Vec<Parameter>;

    /// Fills `params` by the stage's own scheme, repeatable by `seed`.
    fn init(&self, seed: u64, params: &mut [f32]);

    /// The arithmetic that trains.
    fn kernel(&self) -> &dyn Kernel<f32>;

    /// The same formula in double precision, by which gradients are checked.
    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        None
    }

    /// The arithmetic that reads parameters in halves, or `None` where they are read as they are. Hosts want it of
    /// [`GradKind::Scatter`] stages where a spec asks for it ([`crate::precision::Precision`]).
    fn halves(&self) -> Option<Halves<'_>> {
        None
    }

    /// Disjoint ranges that cover the parameters of a [`GradKind::Scatter`] stage; each may be summed by a worker
    /// of its own.
    fn partition(&self) -> Vec<Range<usize>> {
        vec![0..self.info().params]
    }

    /// What its kernels could not do since this was last asked. A kernel has no result of its own, as it runs on tiles
    /// from many threads; one that may fail, as those of loaded libraries may, leaves numbers that mean nothing and says
    /// so here. Backends ask after every call.
    fn fault(&self) -> Result<()> {
        Ok(())
    }

    /// The same formula for a GPU, or `None` where there is only the CPU; see [`crate::wgsl`].
    fn wgsl(&self) -> Option<Fragment> {
        None
    }

    /// A line for `explain`, e.g. `10 levels x 2, 16 to 8192, tables of 2^19`.
    fn describe(&self) -> String;
}

/// A stage without some of its channels, and what became of the rest.
pub struct Reduced<S: ?Sized> {
    /// The smaller stage.
    pub stage: Box<S>,
    /// Which of the old parameters it keeps, in its order.
    pub params: Vec<Range<usize>>,
    /// Which channels remain on the other side of the stage.
    pub channels: Vec<usize>,
}

/// Points `[n, 3]` in the unit cube to features `[n, F]`.
pub trait Encoder: Stage {
    /// The encoder that computes only the outputs `keep` (ascending).
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        let _ = keep;
        Err(Error::unsupported(self.describe(), "this encoder cannot leave out channels"))
    }

    /// Channels ordered from coarse to fine, which masks that drop "all finer" channels rely on.
    fn coarse_to_fine(&self) -> bool {
        false
    }

    /// Of each channel, how many cells along the unit cube's side it tells apart, where that is known: what is finer than
    /// the data can be left out.
    fn resolutions(&self) -> Option<Vec<f64>> {
        None
    }
}

/// Lengths of a scene that a projector's settings may count in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lengths {
    /// The shortest side of a voxel, mm.
    pub voxel_mm: f64,
    /// The side of the encoder's finest cell, mm, where it says how fine it is.
    pub cell_mm: Option<f64>,
}

/// Features `[n, F]` to features `[n, F]`.
pub trait Normalizer: Stage {
    /// The normalizer without the inputs that are not in `keep`: they are gone from its sums too.
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>>;
}

/// Features `[n, F]` to attenuation `[n, 1]`.
pub trait Field: Stage {
    /// The field without the inputs that are not in `keep`.
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        let _ = keep;
        Err(Error::unsupported(self.describe(), "this field cannot do without some of its inputs"))
    }

    /// Its own line integrals, of a field that brings them ([`crate::settings::LineFieldSpec`]).
    fn lines(&self) -> Option<&dyn Lines<f32>> {
        None
    }

    /// The same formula in double precision, by which gradients are checked.
    fn lines_reference(&self) -> Option<&dyn Lines<f64>> {
        None
    }

    /// Its values on whole grids, of a field that has them faster than point by point.
    fn on_grid(&self) -> Option<&dyn OnGrid> {
        None
    }
}

/// Values of a field on whole grids: the same as of its [`Kernel`], but for rounding.
pub trait OnGrid: Send + Sync {
    /// Overwrites `out` (`[x, y, z]`, z fastest) with the values at the points of `grid`.
    fn values(&self, params: &[f32], grid: &UnitGrid, out: &mut [f32]);
}

/// A grid of points in the unit cube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UnitGrid {
    /// The first point.
    pub first: [f64; 3],
    /// Distance of neighbouring points, in cube sides.
    pub spacing: [f64; 3],
    /// Points along x, y, z.
    pub shape: [usize; 3],
}

/// Line integrals that a field brings itself: no projector takes samples of it. In a closed form, or by a walk through
/// voxels. The field reads positions; its [`Kernel`] gives its values at points, for priors and export.
pub trait Lines<R: Real>: Send + Sync {
    /// Overwrites `out` with the line integrals of `rays`, in cube sides. A ray that is not inside
    /// ([`UnitRay::inside`]) has 0.
    fn project(&self, params: &[R], rays: &[UnitRay], out: &mut [R]);

    /// Given `dlines = ∂L/∂out`: *adds* `∂L/∂params` to `grads`. The order in which a parameter's gradient is summed must
    /// not depend on `grads.range`: hosts hand each range of [`Stage::partition`] to a worker of its own.
    fn backproject(&self, params: &[R], rays: &[UnitRay], dlines: &[R], grads: Grads<'_, R>);
}

/// A ray in the unit cube: `origin + t·direction`, where `t` counts cube sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UnitRay {
    /// Start.
    pub origin: [f32; 3],
    /// Unit vector.
    pub direction: [f32; 3],
    /// Entry into and exit from the reconstruction box, in cube sides; equal where the ray misses it.
    pub inside: [f32; 2],
    /// Beginning and end of the published sampling range (`near`, `far`), in cube sides.
    pub published: [f32; 2],
    /// Cube sides a millimetre.
    pub per_mm: f32,
}

/// Samples of rays: positions and the lengths that they stand for.
#[derive(Debug, Default, Clone)]
pub struct Samples {
    /// Positions in the unit cube.
    pub points: Vec<[f32; 3]>,
    /// `δ` of each sample in cube sides.
    pub weights: Vec<f32>,
}

/// Rays to samples with weights.
pub trait Projector: Send + Sync {
    /// Samples that [`Projector::sample`] adds at most for `ray`; 0 where it sees nothing of the scene.
    fn max_samples(&self, ray: &UnitRay) -> usize;

    /// Appends the samples of `ray`. `seed` decides random positions; `None` (rendering) means none are random.
    fn sample(&self, ray: &UnitRay, seed: Option<u64>, out: &mut Samples);

    /// Beer-Lambert: the line integral `Σ μᵢ δᵢ` of one ray.
    fn integrate(&self, weights: &[f32], mu: &[f64]) -> f64 {
        weights.iter().zip(mu).map(|(&w, &m)| f64::from(w) * m).sum()
    }

    /// The exact adjoint of [`Projector::integrate`]: `∂L/∂μᵢ = δᵢ·∂L/∂A`.
    fn adjoint(&self, weights: &[f32], dline: f64, dmu: &mut [f64]) {
        for (d, &w) in dmu.iter_mut().zip(weights) {
            *d = f64::from(w) * dline;
        }
    }

    /// The projector for a scene with these lengths, where its settings count in them.
    fn fitted(&self, lengths: Lengths) -> Result<Option<Box<dyn Projector>>> {
        let _ = lengths;
        Ok(None)
    }

    /// What it could not do since this was last asked, as [`Stage::fault`].
    fn fault(&self) -> Result<()> {
        Ok(())
    }

    /// A line for `explain`.
    fn describe(&self) -> String;

    /// [`Projector::sample`] for a GPU, of a projector that integrates as [`Projector::integrate`] does by itself; see
    /// [`crate::wgsl`].
    fn wgsl(&self) -> Option<Fragment> {
        None
    }
}
