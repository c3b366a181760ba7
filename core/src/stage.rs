//! Stages: validated, immutable settings with a forward and a hand-written backward pass over tiles of rows.
//!
//! A tile is channel-major: channel `c` of row `i` is at index `c·rows + i`. Rows are samples, in ray-major order.

use crate::device::Device;
use crate::error::{Error, Result};
use crate::simd::Real;
use crate::wgsl::Fragment;
use std::ops::Range;

/// Maximum rows per tile from the host; the encoder gets thousands at once. A stage must accept any number from 1 up.
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

    /// Some consecutive channels.
    #[inline(always)]
    pub fn channels(&self, c: Range<usize>) -> &'a [R] {
        &self.data[c.start * self.rows..c.end * self.rows]
    }
}

/// Mutable channels of some rows.
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

/// The part of a stage's gradient that one call of [`Kernel::backward`] accumulates.
#[derive(Debug)]
pub struct Grads<'a, R> {
    /// Gradients of the parameters `range`, which starts at parameter `range.start` of the stage.
    pub values: &'a mut [R],
    /// The range of the stage's parameters. A kernel ignores the others.
    pub range: Range<usize>,
}

impl<'a, R> Grads<'a, R> {
    /// Gradients of all parameters of a stage.
    pub fn all(values: &'a mut [R]) -> Self {
        let range = 0..values.len();
        Self { values, range }
    }
}

/// What [`Kernel::backward`] gets.
#[derive(Debug)]
pub struct Backward<'a, R> {
    /// The stage's parameters.
    pub params: &'a [R],
    /// Its input.
    pub x: Tile<'a, R>,
    /// What the forward pass kept. It may be used as scratch.
    pub tape: TileMut<'a, R>,
    /// `∂L/∂y`.
    pub dy: Tile<'a, R>,
    /// `∂L/∂params`, to which the pass adds.
    pub grads: Grads<'a, R>,
    /// `∂L/∂x`, which the pass overwrites, if it is wanted.
    pub dx: Option<TileMut<'a, R>>,
}

/// The rows on which the result of a row may depend.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Scope {
    /// Its own row only.
    #[default]
    Row,
    /// The rows of its ray: the host passes tiles of one whole ray, and of a single row for points off any ray.
    Ray,
}

/// How a stage accumulates parameter gradients.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum GradKind {
    /// It has no parameters.
    #[default]
    None,
    /// Few parameters, each affected by every row: each worker sums its own copy, and copies are merged in order.
    Dense,
    /// Many parameters, few affected by a row: workers own disjoint ranges ([`Stage::partition`]) and process the rows
    /// in order, so that neither copies nor atomics are needed and sums have one order. Such a stage keeps no tape.
    Scatter,
}

/// A stage's name with the type that its description begins with, for messages.
pub fn titled(name: &str, what: &str) -> String {
    format!("{name} ({})", what.split(':').next().unwrap_or(what))
}

/// Widths, counts and costs of a stage, for planning. By default it has none: a map of single rows without parameters.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize)]
pub struct Info {
    /// Channels in.
    pub input: usize,
    /// Channels out.
    pub output: usize,
    /// Parameters.
    pub params: usize,
    /// Numbers per row kept from forward to backward.
    pub tape: usize,
    /// Rows that a row depends on.
    pub scope: Scope,
    /// How gradients are accumulated.
    pub grads: GradKind,
    /// Multiply-adds of the forward pass, per row.
    pub macs: usize,
    /// Output equals input: hosts skip the stage.
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
    /// Its range within the stage's parameters.
    pub fn range(&self) -> Range<usize> {
        self.start..self.start + self.shape.iter().product::<usize>()
    }
}

/// The arithmetic of a stage in one precision.
pub trait Kernel<R: Real>: Send + Sync {
    /// Computes `y = f(x; params)`. Fills `tape` (`[info.tape][rows]`) for [`Kernel::backward`].
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>);

    /// Given `∂L/∂y`, *adds* `∂L/∂params` to the gradients and, if wanted, overwrites `∂L/∂x`. The summation order of a
    /// parameter's gradient must not depend on the range of the gradients.
    fn backward(&self, pass: Backward<'_, R>);

    /// Number of passes of [`Kernel::forward`], each over a table of its own: a host with many tiles runs one pass for
    /// all of them before the next, while its table is in the cache.
    fn passes(&self) -> usize {
        1
    }

    /// Pass `pass` of [`Kernel::forward`]; all [`Kernel::passes`] in order give the whole.
    fn forward_pass(&self, pass: usize, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        debug_assert_eq!(pass, 0);
        self.forward(params, x, y, tape);
    }

    /// For a stage that looks along rays ([`Scope::Ray`]): the same function of points off any ray, each row a ray of
    /// one sample. Without it, a host passes such rows one at a time, which is slow.
    fn points(&self) -> Option<&(dyn Kernel<R> + '_)> {
        None
    }
}

/// A map from rows of `info.input` channels to rows of `info.output` channels.
pub trait Stage: Send + Sync {
    /// Widths, counts and cost.
    fn info(&self) -> Info;

    /// Names and shapes of the parameters, in order, without gaps.
    fn parameters(&self) -> Vec<Parameter>;

    /// Initializes `params` by the stage's own scheme, reproducible by `seed`.
    fn init(&self, seed: u64, params: &mut [f32]);

    /// The arithmetic for training.
    fn kernel(&self) -> &dyn Kernel<f32>;

    /// The same formula in double precision, for checking gradients.
    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        None
    }

    /// Disjoint ranges that cover the parameters of a [`GradKind::Scatter`] stage; different workers may sum them.
    fn partition(&self) -> Vec<Range<usize>> {
        vec![0..self.info().params]
    }

    /// Returns and clears the first error of the kernels since the last call. Kernels return no result, as they run on
    /// tiles from many threads. A kernel that can fail, such as one of a loaded library, leaves meaningless numbers and
    /// reports the error here. Backends check after every call.
    fn fault(&self) -> Result<()> {
        Ok(())
    }

    /// The same formula for a GPU, or `None` for CPU-only stages; see [`crate::wgsl`].
    fn wgsl(&self) -> Option<Fragment> {
        None
    }

    /// A line for `explain`, e.g. `10 levels x 2, 16 to 8192, tables of 2^19`.
    fn describe(&self) -> String;
}

/// Numbers that stages compute with.
pub trait Precision: Real {
    /// The kernel of a stage for them, if it has one.
    fn kernel(stage: &dyn Stage) -> Option<&dyn Kernel<Self>>;
}

impl Precision for f32 {
    fn kernel(stage: &dyn Stage) -> Option<&dyn Kernel<Self>> {
        Some(stage.kernel())
    }
}

impl Precision for f64 {
    fn kernel(stage: &dyn Stage) -> Option<&dyn Kernel<Self>> {
        stage.reference()
    }
}

/// A stage without some of its channels, with the remaining parameters and channels.
pub struct Reduced<S: ?Sized> {
    /// The smaller stage.
    pub stage: Box<S>,
    /// Ranges of the original parameters that it keeps, in its order.
    pub params: Vec<Range<usize>>,
    /// Channels that remain on the other side of the stage.
    pub channels: Vec<usize>,
}

/// Points `[n, 3]` in the unit cube to features `[n, F]`.
pub trait Encoder: Stage {
    /// The encoder that computes only the outputs `keep` (ascending).
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        let _ = keep;
        Err(Error::unsupported(self.describe(), "this encoder does not support removing channels"))
    }

    /// Whether channels are ordered from coarse to fine, as required by masks that drop "all finer" channels.
    fn coarse_to_fine(&self) -> bool {
        false
    }

    /// Resolution of each channel in cells along the unit cube's side, if known: channels finer than the data can be
    /// left out.
    fn resolutions(&self) -> Option<Vec<f64>> {
        None
    }
}

/// Lengths of a scene that projector settings may be relative to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lengths {
    /// The shortest side of a voxel, mm.
    pub voxel_mm: f64,
    /// The side of the encoder's finest cell, mm, if the encoder reports its resolution.
    pub cell_mm: Option<f64>,
}

/// Features `[n, F]` to features `[n, F]`.
pub trait Normalizer: Stage {
    /// The normalizer without the inputs outside `keep`, which also leave its sums.
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>>;
}

/// Features `[n, F]` to attenuation `[n, 1]`.
pub trait Field: Stage {
    /// The field without the inputs outside `keep`.
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        let _ = keep;
        Err(Error::unsupported(self.describe(), "this field does not support removing inputs"))
    }

    /// Its own line integrals, if it has any.
    fn lines(&self) -> Option<&dyn Lines> {
        None
    }

    /// Its values on whole grids, if these are faster than point by point.
    fn on_grid(&self) -> Option<&dyn OnGrid> {
        None
    }
}

/// Values of a field on whole grids: equal to those of its [`Kernel`] up to rounding.
pub trait OnGrid: Send + Sync {
    /// Overwrites `out` (`[x, y, z]`, z fastest) with the values at the points of `grid`.
    fn values(&self, params: &[f32], grid: &UnitGrid, out: &mut [f32]);
}

/// A grid of points in the unit cube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UnitGrid {
    /// The first point.
    pub first: [f64; 3],
    /// Distance between neighbouring points, in cube sides.
    pub spacing: [f64; 3],
    /// Points along x, y, z.
    pub shape: [usize; 3],
}

/// Line integrals computed by a field itself, without samples of a projector. The field reads positions; its [`Kernel`]
/// gives its values at points, for priors and export. The field's method trains it.
pub trait Lines: Send + Sync {
    /// Overwrites `out` with the line integrals of `rays`, in cube sides; 0 for a ray that misses the box
    /// ([`UnitRay::inside`]).
    fn project(&self, params: &[f32], rays: &[UnitRay], out: &mut [f32]);

    /// The field on a device: its values and line integrals. Refuses a device by default.
    fn on_device(&self, device: Box<dyn Device>) -> Result<Box<dyn OnDevice>> {
        let why = "the field has no kernels for a GPU; use --backend cpu";
        Err(Error::unsupported(format!("a field with its own line integrals on {}", device.name()), why))
    }
}

/// A field with its own line integrals on a device.
pub trait OnDevice: Send {
    /// Takes these parameters from now on.
    fn load(&mut self, params: &[f32]) -> Result<()>;
    /// Overwrites `out` with the values at `points` of the unit cube.
    fn evaluate(&mut self, points: &[[f32; 3]], out: &mut [f32]) -> Result<()>;
    /// Overwrites `out` with the values at the points of `grid`, as [`OnGrid::values`].
    fn values(&mut self, grid: &UnitGrid, out: &mut [f32]) -> Result<()>;
    /// Overwrites `out` with the line integrals of `rays`, as [`Lines::project`].
    fn project(&mut self, rays: &[UnitRay], out: &mut [f32]) -> Result<()>;
}

/// A ray in the unit cube: `origin + t·direction`, where `t` counts cube sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UnitRay {
    /// Start.
    pub origin: [f32; 3],
    /// Unit vector.
    pub direction: [f32; 3],
    /// Entry into and exit from the reconstruction box, in cube sides; equal if the ray misses it.
    pub inside: [f32; 2],
    /// Beginning and end of the published sampling range (`near`, `far`), in cube sides.
    pub published: [f32; 2],
    /// Cube sides per millimetre.
    pub per_mm: f32,
}

/// Samples of rays: positions and lengths.
#[derive(Debug, Default, Clone)]
pub struct Samples {
    /// Positions in the unit cube.
    pub points: Vec<[f32; 3]>,
    /// Length `δ` of each sample in cube sides.
    pub weights: Vec<f32>,
}

/// Rays to samples with weights.
pub trait Projector: Send + Sync {
    /// Maximum number of samples that [`Projector::sample`] adds for `ray`; 0 if it misses the scene.
    fn max_samples(&self, ray: &UnitRay) -> usize;

    /// Appends the samples of `ray`. `seed` determines random positions; with `None` (rendering) none are random.
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

    /// The projector for a scene with these lengths, if its settings depend on them.
    fn fitted(&self, lengths: Lengths) -> Result<Option<Box<dyn Projector>>> {
        let _ = lengths;
        Ok(None)
    }

    /// A warning, if `ray` gets fewer samples than the settings say.
    fn doubt(&self, ray: &UnitRay) -> Option<String> {
        let _ = ray;
        None
    }

    /// Returns and clears the first error since the last call; see [`Stage::fault`].
    fn fault(&self) -> Result<()> {
        Ok(())
    }

    /// A line for `explain`.
    fn describe(&self) -> String;

    /// [`Projector::sample`] for a GPU, for projectors that use the default [`Projector::integrate`]; see
    /// [`crate::wgsl`].
    fn wgsl(&self) -> Option<Fragment> {
        None
    }
}
