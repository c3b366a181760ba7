//! The contract between conefield and a plugin, as C sees it. `include/conefield_plugin.h` is made from this file.
//!
//! A plugin is a shared library that exports [`conefield_plugin`](ConefieldEntry) and returns a table of what it
//! brings. Rules that types cannot say:
//!
//! - **Versions.** `abi_major` must be the host's. Within a major version tables only grow at their end. Each
//!   table says its own `size`: a table shorter than that of the first minor version is refused, a later function that a
//!   table does not reach counts as NULL, and what a table has beyond is not read. Everything else here keeps its layout.
//! - **Memory.** Nothing is handed over: the host frees what it made, the plugin frees what it made (`destroy`). What a
//!   plugin points to in its tables lives as long as the library, which is never unloaded; what a stage points to lives
//!   as long as the stage.
//! - **Tiles** are channel-major: channel `c` of row `i` is `data[c * stride + i]`. A pointer may be NULL where there is
//!   nothing (no channels, no parameters). Floats are aligned to their own size and no more.
//! - **Threads.** A stage is called from many threads at once, and every function that takes it as `const` must allow that.
//!   Only `create`, `destroy`, `reduce`, `fitted`, `weights`, `with_weights`, `check`, `volume`, `on`, `of`, `prox`, `adapt` and `state`
//!   of one stage are not called at the same time as anything else of that stage, though from any thread.
//! - **Unwinding** must not leave the library: catch panics and exceptions, return [`CONEFIELD_PANICKED`].
//! - **Same bits.** The result must not depend on threads, on time, or on how rows are dealt to tiles.

use std::ffi::c_void;

/// Major version of this contract. A plugin of another one is refused.
pub const CONEFIELD_ABI_MAJOR: u32 = 2;
/// Minor version: the number of times that tables have grown.
pub const CONEFIELD_ABI_MINOR: u32 = 2;

/// What a function returns.
pub type ConefieldStatus = i32;
/// All is well.
pub const CONEFIELD_OK: ConefieldStatus = 0;
/// What was handed over, such as settings, cannot be used; the error text says why.
pub const CONEFIELD_INVALID: ConefieldStatus = 1;
/// It could be asked for, but this stage cannot do it.
pub const CONEFIELD_UNSUPPORTED: ConefieldStatus = 2;
/// It went wrong.
pub const CONEFIELD_FAILED: ConefieldStatus = 3;
/// A panic or an exception was caught.
pub const CONEFIELD_PANICKED: ConefieldStatus = 4;

/// Points to features.
pub const CONEFIELD_ENCODER: u32 = 0;
/// Features to features.
pub const CONEFIELD_NORMALIZER: u32 = 1;
/// Features to attenuation.
pub const CONEFIELD_FIELD: u32 = 2;
/// Rays to samples.
pub const CONEFIELD_PROJECTOR: u32 = 3;
/// Fills weights.
pub const CONEFIELD_INITIALIZER: u32 = 4;
/// Compares predicted with measured values.
pub const CONEFIELD_LOSS: u32 = 5;
/// Judges a field by small blocks of neighbouring points.
pub const CONEFIELD_PRIOR: u32 = 6;
/// Penalty of coefficients with its proximal map, for iterative methods. Since 2.2.
pub const CONEFIELD_REGULARIZER: u32 = 7;
/// How far line integrals are from the measured ones, for iterative methods. Since 2.2.
pub const CONEFIELD_DATA_TERM: u32 = 8;
/// Coefficients to voxels, for iterative methods. Since 2.2.
pub const CONEFIELD_BASIS: u32 = 9;
/// A field that brings line integrals of its own. Since 2.2.
pub const CONEFIELD_LINE_FIELD: u32 = 10;

/// A row looks at itself alone.
pub const CONEFIELD_SCOPE_ROW: u32 = 0;
/// A row looks at the rows of its ray: tiles hold one whole ray, or a single row off any ray.
pub const CONEFIELD_SCOPE_RAY: u32 = 1;

/// No parameters.
pub const CONEFIELD_GRADS_NONE: u32 = 0;
/// Few parameters, all touched by every row: each worker sums a copy.
pub const CONEFIELD_GRADS_DENSE: u32 = 1;
/// Many parameters, few touched by a row: workers own the ranges of `partition`. Such a stage keeps no tape.
pub const CONEFIELD_GRADS_SCATTER: u32 = 2;

/// Parameters are IEEE 754 `binary16`.
pub const CONEFIELD_F16: u32 = 0;
/// Parameters are `bfloat16`: the upper halves of floats.
pub const CONEFIELD_BF16: u32 = 1;

/// `reduce` leaves out channels that come out.
pub const CONEFIELD_OUTPUTS: u32 = 0;
/// `reduce` leaves out channels that go in.
pub const CONEFIELD_INPUTS: u32 = 1;

/// UTF-8 text, not ended by a zero.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldStr {
    /// First byte; may be NULL if `length` is 0.
    pub data: *const u8,
    /// Bytes.
    pub length: usize,
}

/// Room for text that a plugin writes, as UTF-8.
#[repr(C)]
#[derive(Debug)]
pub struct ConefieldText {
    /// Where to.
    pub data: *mut u8,
    /// Bytes that fit.
    pub capacity: usize,
    /// Bytes of the whole text, set by the plugin; what is beyond `capacity` is not written, and the host may ask again.
    pub length: usize,
}

/// Channels of rows, to be read.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldTile {
    /// Row 0 of channel 0.
    pub data: *const f32,
    /// Channels.
    pub channels: usize,
    /// Rows, at least 1.
    pub rows: usize,
    /// Floats from a channel to the next, at least `rows`.
    pub stride: usize,
}

/// Channels of rows, to be written.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldTileMut {
    /// Row 0 of channel 0; NULL where the host does not want it.
    pub data: *mut f32,
    /// Channels.
    pub channels: usize,
    /// Rows, at least 1.
    pub rows: usize,
    /// Floats from a channel to the next, at least `rows`.
    pub stride: usize,
}

/// Gradients of the parameters `start..start + length` of a stage, to be added to.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldGrads {
    /// That of parameter `start`.
    pub data: *mut f32,
    /// The first parameter.
    pub start: usize,
    /// Parameters; the stage leaves all others alone.
    pub length: usize,
}

/// [`ConefieldTile`] in double precision.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldTile64 {
    /// Row 0 of channel 0.
    pub data: *const f64,
    /// Channels.
    pub channels: usize,
    /// Rows, at least 1.
    pub rows: usize,
    /// Doubles from a channel to the next, at least `rows`.
    pub stride: usize,
}

/// [`ConefieldTileMut`] in double precision.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldTileMut64 {
    /// Row 0 of channel 0; NULL where the host does not want it.
    pub data: *mut f64,
    /// Channels.
    pub channels: usize,
    /// Rows, at least 1.
    pub rows: usize,
    /// Doubles from a channel to the next, at least `rows`.
    pub stride: usize,
}

/// [`ConefieldGrads`] in double precision.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldGrads64 {
    /// That of parameter `start`.
    pub data: *mut f64,
    /// The first parameter.
    pub start: usize,
    /// Parameters; the stage leaves all others alone.
    pub length: usize,
}

/// Widths, counts and cost of an encoder, a normalizer or a field.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldInfo {
    /// Channels in.
    pub input: usize,
    /// Channels out.
    pub output: usize,
    /// Parameters.
    pub params: usize,
    /// Blocks of parameters, each with a name.
    pub blocks: usize,
    /// Ranges that `partition` gives; 0 or 1 without it.
    pub partitions: usize,
    /// Numbers a row that forward leaves for backward.
    pub tape: usize,
    /// Multiply-adds a row, forward.
    pub macs: usize,
    /// `CONEFIELD_SCOPE_…`
    pub scope: u32,
    /// `CONEFIELD_GRADS_…`
    pub grads: u32,
    /// 1 if output equals input: hosts leave the stage out.
    pub identity: u32,
    /// 1 if an encoder's channels stand in order from coarse to fine.
    pub coarse_to_fine: u32,
    /// 1 if it has kernels in double precision.
    pub double_precision: u32,
    /// 1 if it has kernels that read parameters in halves.
    pub halves: u32,
}

/// One named block of parameters. Blocks stand one after the other and cover all parameters.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldParameter {
    /// Its name within the stage, such as `table`.
    pub name: ConefieldStr,
    /// Its shape, row-major.
    pub shape: *const usize,
    /// Numbers in `shape`.
    pub dimensions: usize,
}

/// Parameters or channels `start..end`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldRange {
    /// The first.
    pub start: usize,
    /// One past the last.
    pub end: usize,
}

/// A stage without some of its channels.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldReduced {
    /// The smaller stage, a new one.
    pub stage: *mut c_void,
    /// Which of the old parameters it keeps, in its order; valid as long as it lives.
    pub params: *const ConefieldRange,
    /// Ranges in `params`.
    pub params_count: usize,
    /// Which channels remain on the other side of the stage; valid as long as it lives.
    pub channels: *const usize,
    /// Channels in `channels`.
    pub channels_count: usize,
}

/// Functions of an encoder, a normalizer, a field or a line field. `stage` is what `create` made.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldMap {
    /// Bytes of this table.
    pub size: usize,
    /// Widths and counts; always the same for one stage.
    pub info: Option<unsafe extern "C" fn(stage: *const c_void, info: *mut ConefieldInfo) -> ConefieldStatus>,
    /// Block `index` of the parameters. NULL if there are none.
    pub parameter: Option<
        unsafe extern "C" fn(stage: *const c_void, index: usize, parameter: *mut ConefieldParameter) -> ConefieldStatus,
    >,
    /// Fills all parameters, repeatable by `seed`. NULL if there are none.
    pub init: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            seed: u64,
            params: *mut f32,
            length: usize,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Overwrites `y` with f(x; params), and `tape` with what backward needs.
    pub forward: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            params: *const f32,
            x: ConefieldTile,
            y: ConefieldTileMut,
            tape: ConefieldTileMut,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Given `dy` = ∂L/∂y, adds ∂L/∂params to `grads` and, unless its data is NULL, overwrites `dx` with ∂L/∂x. `tape` is
    /// as forward left it and may be used as scratch; of a stage with scattered gradients it has no channels. The order
    /// in which one parameter's gradient is summed must not depend on the range in `grads`.
    pub backward: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            params: *const f32,
            x: ConefieldTile,
            tape: ConefieldTileMut,
            dy: ConefieldTile,
            grads: ConefieldGrads,
            dx: ConefieldTileMut,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// `forward` in double precision, by which gradients are checked; NULL if there is none.
    pub forward_f64: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            params: *const f64,
            x: ConefieldTile64,
            y: ConefieldTileMut64,
            tape: ConefieldTileMut64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// `backward` in double precision; NULL if there is none.
    pub backward_f64: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            params: *const f64,
            x: ConefieldTile64,
            tape: ConefieldTileMut64,
            dy: ConefieldTile64,
            grads: ConefieldGrads64,
            dx: ConefieldTileMut64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Range `index` of the parameters that a worker may own; ranges are disjoint, ascending and cover all. NULL: one range.
    pub partition:
        Option<unsafe extern "C" fn(stage: *const c_void, index: usize, range: *mut ConefieldRange) -> ConefieldStatus>,
    /// Makes of an encoder the one that computes only the outputs `keep` (`side` is [`CONEFIELD_OUTPUTS`]), of a normalizer or
    /// a field the one without the inputs that are not in `keep` ([`CONEFIELD_INPUTS`]); `keep` ascends. NULL: it cannot, and masks that need it are refused.
    pub reduce: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            side: u32,
            keep: *const usize,
            keep_count: usize,
            reduced: *mut ConefieldReduced,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// WGSL of the same formula: functions `stage_forward` and `stage_backward` of a row, as docs/guide/writing-stages.md says. NULL:
    /// it runs on the CPU alone.
    pub wgsl: Option<unsafe extern "C" fn(stage: *const c_void, source: *mut ConefieldText) -> ConefieldStatus>,
    /// How many passes `forward` goes in, each over a table of its own; always the same for one stage. A host with many
    /// tiles sends all of them through one pass before the next, while its table is in the cache. NULL: one.
    pub passes: Option<unsafe extern "C" fn(stage: *const c_void) -> usize>,
    /// Pass `pass` of `forward`, counted from 0; all in order leave the same bits as `forward`. What other passes write
    /// stays. NULL where `passes` is.
    pub forward_pass: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            pass: usize,
            params: *const f32,
            x: ConefieldTile,
            y: ConefieldTileMut,
            tape: ConefieldTileMut,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// `forward` on parameters of 16 bits in `format`, one of [`CONEFIELD_F16`] and [`CONEFIELD_BF16`]: what `forward` makes
    /// of the same values. A host asks for it where a spec has tables in halves. NULL if there is none.
    pub forward_halves: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            format: u32,
            params: *const u16,
            x: ConefieldTile,
            y: ConefieldTileMut,
            tape: ConefieldTileMut,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// `forward_pass` on parameters of 16 bits, as `forward_halves`. NULL where `forward_pass` or `forward_halves` is.
    pub forward_pass_halves: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            format: u32,
            pass: usize,
            params: *const u16,
            x: ConefieldTile,
            y: ConefieldTileMut,
            tape: ConefieldTileMut,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// `backward` on parameters of 16 bits, as `forward_halves`. Gradients are floats. NULL where `forward_halves` is.
    pub backward_halves: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            format: u32,
            params: *const u16,
            x: ConefieldTile,
            tape: ConefieldTileMut,
            dy: ConefieldTile,
            grads: ConefieldGrads,
            dx: ConefieldTileMut,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Of an encoder: writes for each of its `count` channels how many cells along the unit cube's side the channel
    /// resolves, a finite number above 0. Projectors count in the finest cell, and channels finer than the data can be left
    /// out. Returns [`CONEFIELD_UNSUPPORTED`] where that is not known. NULL: it is not known.
    pub resolutions: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            cells: *mut f64,
            count: usize,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Of a line field, since 2.2: overwrites `out` with the line integrals of `count` rays, in cube sides. A ray that is not
    /// inside has 0. NULL elsewhere.
    pub project: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            params: *const f32,
            rays: *const ConefieldRay,
            count: usize,
            out: *mut f32,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// The adjoint of `project`: given `dlines` = ∂L/∂out, adds ∂L/∂params to `grads`. The order in which one parameter's
    /// gradient is summed must not depend on the range in `grads`. NULL where `project` is.
    pub backproject: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            params: *const f32,
            rays: *const ConefieldRay,
            count: usize,
            dlines: *const f32,
            grads: ConefieldGrads,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// `project` in double precision, by which gradients are checked. Needed of a line field.
    pub project_f64: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            params: *const f64,
            rays: *const ConefieldRay,
            count: usize,
            out: *mut f64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// `backproject` in double precision. Needed of a line field.
    pub backproject_f64: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            params: *const f64,
            rays: *const ConefieldRay,
            count: usize,
            dlines: *const f64,
            grads: ConefieldGrads64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
}

/// A ray in the unit cube: `origin + t * direction`, where `t` counts cube sides.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldRay {
    /// Start.
    pub origin: [f32; 3],
    /// Unit vector.
    pub direction: [f32; 3],
    /// Entry into and exit from the reconstruction box; equal where the ray misses it.
    pub inside: [f32; 2],
    /// Beginning and end of the published sampling range (near, far).
    pub published: [f32; 2],
    /// Cube sides a millimetre.
    pub per_mm: f32,
}

/// Lengths of a scene that a projector's settings may count in.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldLengths {
    /// The shortest side of a voxel, mm.
    pub voxel_mm: f64,
    /// The side of the encoder's finest cell, mm; 0 where the encoder does not say how fine it is.
    pub cell_mm: f64,
}

/// Functions of a projector.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldProjector {
    /// Bytes of this table.
    pub size: usize,
    /// Samples that `sample` writes at most for `ray`; 0 where it sees nothing of the scene.
    pub max_samples: Option<unsafe extern "C" fn(stage: *const c_void, ray: *const ConefieldRay) -> usize>,
    /// Writes the samples of `ray`: `x, y, z` in the unit cube to `points`, the length that each stands for, in cube sides,
    /// to `weights`, and how many they are (at most `capacity`) to `count`. `seed` decides random positions; NULL
    /// (rendering) means that none are random.
    pub sample: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            ray: *const ConefieldRay,
            seed: *const u64,
            points: *mut f32,
            weights: *mut f32,
            capacity: usize,
            count: *mut usize,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// The line integral of `count` attenuations. NULL: their sum, each times its weight.
    pub integrate:
        Option<unsafe extern "C" fn(stage: *const c_void, weights: *const f32, mu: *const f64, count: usize) -> f64>,
    /// The exact adjoint of `integrate`: overwrites `dmu` with its derivatives times `dline`. NULL as `integrate`.
    pub adjoint: Option<
        unsafe extern "C" fn(stage: *const c_void, weights: *const f32, dline: f64, dmu: *mut f64, count: usize),
    >,
    /// Makes the projector for a scene with these lengths, a new one, and sets `fitted` to it. A projector whose settings do
    /// not count in them leaves `fitted` as it is. NULL: its settings do not.
    pub fitted: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            lengths: *const ConefieldLengths,
            fitted: *mut *mut c_void,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// WGSL of `sample`, of a projector that integrates as one without `integrate` does: a function `stage_sample`, as
    /// docs/guide/writing-stages.md says. NULL: it runs on the CPU alone.
    pub wgsl: Option<unsafe extern "C" fn(stage: *const c_void, source: *mut ConefieldText) -> ConefieldStatus>,
}

/// A named block of all parameters of a pipeline.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldBlock {
    /// Its full name, such as `field.0.weight`.
    pub name: ConefieldStr,
    /// Its shape, row-major.
    pub shape: *const usize,
    /// Numbers in `shape`.
    pub dimensions: usize,
    /// Its first parameter.
    pub start: usize,
    /// Its parameters.
    pub length: usize,
}

/// A tensor of a weights file.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldTensor {
    /// Its name.
    pub name: ConefieldStr,
    /// Its shape, row-major.
    pub shape: *const usize,
    /// Numbers in `shape`.
    pub dimensions: usize,
    /// Its numbers.
    pub values: *const f32,
    /// How many these are.
    pub length: usize,
}

/// Functions of an initializer. What is optional may be NULL.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldInitializer {
    /// Bytes of this table.
    pub size: usize,
    /// Fills what it fills of `params`, which every stage's own scheme has filled before, and sets the entry of `filled` to
    /// 1 for every block that it filled.
    pub apply: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            blocks: *const ConefieldBlock,
            block_count: usize,
            params: *mut f32,
            length: usize,
            filled: *mut u8,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Optional, since 2.1. Refuses parameters that it does not fit, before a run begins.
    pub check: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            blocks: *const ConefieldBlock,
            block_count: usize,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Optional, since 2.1. The weights file that the settings name; [`CONEFIELD_UNSUPPORTED`] where they name none. The host
    /// reads it and goes on with the stage that `with_weights` makes of it.
    pub weights: Option<unsafe extern "C" fn(stage: *const c_void, path: *mut ConefieldStr) -> ConefieldStatus>,
    /// Since 2.1, needed beside `weights`. Makes a stage that has these weights. They live for the time of the call.
    pub with_weights: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            tensors: *const ConefieldTensor,
            count: usize,
            out: *mut *mut c_void,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Optional, since 2.1. The file of a known volume that the field learns in `steps` steps once weights are filled;
    /// [`CONEFIELD_UNSUPPORTED`] where there is none.
    pub volume:
        Option<unsafe extern "C" fn(stage: *const c_void, path: *mut ConefieldStr, steps: *mut u64) -> ConefieldStatus>,
}

/// The noise of a scan, in the scale that stages see: a line integral `p` has the variance `sigma² · exp(growth · p)`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldNoise {
    /// Standard deviation where nothing is in the way.
    pub sigma: f64,
    /// How the variance grows with the line integral, 0 or more.
    pub growth: f64,
    /// Measured line integrals, drawn as training draws them.
    pub measured: *const f64,
    /// How many.
    pub count: usize,
}

/// Functions of a loss.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldLoss {
    /// Bytes of this table.
    pub size: usize,
    /// Compares `count` predicted values with the measured ones: the loss of each pair to `loss`, its derivative by the
    /// predicted value to `slope`. A loss is 0 where both agree, never negative, and NaN where a value is NaN.
    pub at: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            predicted: *const f64,
            measured: *const f64,
            count: usize,
            loss: *mut f64,
            slope: *mut f64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// 1 if it learns from the scan: training then uses what `fitted` makes. NULL: it does not.
    pub needs_scan: Option<unsafe extern "C" fn(stage: *const c_void) -> u32>,
    /// Makes the loss for a scan with this noise, a new one, and sets `fitted` to it; one that learns nothing leaves `fitted`
    /// as it is. NULL where `needs_scan` is.
    pub fitted: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            noise: *const ConefieldNoise,
            fitted: *mut *mut c_void,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// WGSL of `at`: a function `stage_at`, as docs/guide/writing-stages.md says. NULL: it runs on the CPU alone.
    pub wgsl: Option<unsafe extern "C" fn(stage: *const c_void, source: *mut ConefieldText) -> ConefieldStatus>,
}

/// Where a prior looks, and how much it counts.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldBlocks {
    /// Points along a block's edge, 2 to 32.
    pub edge: usize,
    /// Blocks a step.
    pub count: usize,
    /// Distance of neighbouring points in voxels.
    pub spacing: f64,
    /// Weight of the mean over all points against the mean loss of a ray.
    pub weight: f64,
}

/// Functions of a prior.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldPrior {
    /// Bytes of this table.
    pub size: usize,
    /// Its blocks; always the same for one stage.
    pub blocks: Option<unsafe extern "C" fn(stage: *const c_void, blocks: *mut ConefieldBlocks) -> ConefieldStatus>,
    /// The penalty of one block, not negative, to `penalty`. `values` are those of its `count = edge³` points, z fastest.
    /// Adds `scale` times the derivative by each of them to `gradient`. A penalty is NaN where a value is NaN.
    pub block: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            values: *const f64,
            count: usize,
            scale: f64,
            gradient: *mut f64,
            penalty: *mut f64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// WGSL of `block`: a function `stage_at`, as docs/guide/writing-stages.md says. NULL: it runs on the CPU alone.
    pub wgsl: Option<unsafe extern "C" fn(stage: *const c_void, source: *mut ConefieldText) -> ConefieldStatus>,
}

/// A grid of voxels or of coefficients. Numbers on it stand x by x, then y by y, z fastest.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldGrid {
    /// How many along x, y and z.
    pub shape: [usize; 3],
    /// Distances of neighbours, mm.
    pub spacing: [f64; 3],
    /// The middle of the grid, mm.
    pub center: [f64; 3],
}

/// Named numbers that a penalty keeps from call to call.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldState {
    /// Their name, such as `dual`; valid as long as the penalty lives.
    pub name: ConefieldStr,
    /// The first of them.
    pub data: *mut f32,
    /// How many.
    pub length: usize,
}

/// Functions of a regularizer: a convex penalty R of coefficients, for any grid. What `on` makes is a stage of its own, which
/// `destroy` frees; `value`, `prox` and `state` get it.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldRegularizer {
    /// Bytes of this table.
    pub size: usize,
    /// Bytes that the penalty on `grid` holds. NULL: next to none.
    pub bytes: Option<unsafe extern "C" fn(stage: *const c_void, grid: *const ConefieldGrid) -> u64>,
    /// Makes the penalty on `grid`.
    pub on: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            grid: *const ConefieldGrid,
            penalty: *mut *mut c_void,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// The weight λ, 0 or more, for attenuation in 1/mm and lengths in mm. `noise(context, k)` measures k times what the scan's
    /// noise comes to in the gradient of the data term; it takes a back-projection.
    pub weight: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            grid: *const ConefieldGrid,
            noise: Option<unsafe extern "C" fn(context: *mut c_void, k: f64) -> f64>,
            context: *mut c_void,
            weight: *mut f64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// R(x), 0 or more, of the `count` coefficients of the grid.
    pub value: Option<
        unsafe extern "C" fn(
            penalty: *const c_void,
            x: *const f32,
            count: usize,
            value: *mut f64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Overwrites `u` with the coefficients ≥ 0 that have the least `½‖u − v‖² + tau·R(u)`, or comes nearer to them with each
    /// call for the same `v`.
    pub prox: Option<
        unsafe extern "C" fn(
            penalty: *mut c_void,
            v: *const f32,
            count: usize,
            tau: f32,
            u: *mut f32,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Entry `index` of what the next `prox` starts from, which goes into checkpoints; [`CONEFIELD_UNSUPPORTED`] past the last.
    /// NULL: every call starts afresh.
    pub state:
        Option<unsafe extern "C" fn(penalty: *mut c_void, index: usize, state: *mut ConefieldState) -> ConefieldStatus>,
    /// Fits the penalty to the coefficients `x`, before each pass over the scan. What it leaves follows from `x` alone, and is no
    /// part of `state`. Writes the new R(x); returns [`CONEFIELD_UNSUPPORTED`] where the penalty stays as it is. NULL: it always does.
    pub adapt: Option<
        unsafe extern "C" fn(
            penalty: *mut c_void,
            x: *const f32,
            count: usize,
            value: *mut f64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
}

/// Functions of a data term `Σ φ(r)` of residuals `r = measured − predicted`. What `of` makes of a scan is a stage of its own,
/// which `destroy` frees; all but `bytes` and `of` get it. They are asked for an image at a time: `count` pixels of the view
/// `view`, whose line integrals `measured` were found, row by row.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldDataTerm {
    /// Bytes of this table.
    pub size: usize,
    /// Bytes that it holds for a scan of `shape`: views, rows, columns; and those that `of` takes for a moment. NULL: next to
    /// none.
    pub bytes: Option<unsafe extern "C" fn(stage: *const c_void, shape: *const usize, held: *mut u64, brief: *mut u64)>,
    /// Makes the data term of the line integrals `measured`, which are only looked at.
    pub of: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            measured: *const f32,
            shape: *const usize,
            misfit: *mut *mut c_void,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Standard deviation of the noise of line integrals near 0.
    pub noise: Option<unsafe extern "C" fn(misfit: *const c_void) -> f64>,
    /// Overwrites residuals with the derivatives φ'(r), and `sum` with the sum of all φ(r).
    pub differentiate: Option<
        unsafe extern "C" fn(
            misfit: *const c_void,
            view: usize,
            measured: *const f32,
            count: usize,
            residuals: *mut f32,
            sum: *mut f64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Multiplies each value by an upper bound of φ''.
    pub curve: Option<
        unsafe extern "C" fn(
            misfit: *const c_void,
            view: usize,
            measured: *const f32,
            count: usize,
            values: *mut f32,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Multiplies each value by the standard deviation that noise gives φ', in units of `noise`.
    pub spread: Option<
        unsafe extern "C" fn(
            misfit: *const c_void,
            view: usize,
            measured: *const f32,
            count: usize,
            values: *mut f32,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
}

/// A basis on one grid of voxels.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldExpansion {
    /// Where the coefficients stand.
    pub coefficients: ConefieldGrid,
    /// Bytes that either direction takes while it works.
    pub scratch: u64,
    /// 1 if coefficients are the volume's values where they stand, on a grid that fills the same box.
    pub samples: u32,
    /// 1 if it works in double precision too.
    pub double_precision: u32,
}

/// Functions of a basis: a matrix B from coefficients to voxels. Its entries are not negative, unless coefficients are samples.
/// What `on` makes is a stage of its own, which `destroy` frees; all others get it.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldBasis {
    /// Bytes of this table.
    pub size: usize,
    /// Makes the basis for the voxels of a grid. The number of coefficients follows from the grid's shape alone.
    pub on: Option<
        unsafe extern "C" fn(
            stage: *const c_void,
            voxels: *const ConefieldGrid,
            expansion: *mut *mut c_void,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// What it is like there; always the same.
    pub info: Option<unsafe extern "C" fn(expansion: *const c_void, info: *mut ConefieldExpansion) -> ConefieldStatus>,
    /// Overwrites `voxels` with `B·coefficients`.
    pub expand: Option<
        unsafe extern "C" fn(
            expansion: *const c_void,
            coefficients: *const f32,
            voxels: *mut f32,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Overwrites `coefficients` with `Bᵀ·voxels`, the exact adjoint.
    pub adjoint: Option<
        unsafe extern "C" fn(
            expansion: *const c_void,
            voxels: *const f32,
            coefficients: *mut f32,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// `expand` in double precision, by which it is checked. NULL: there is none.
    pub expand_f64: Option<
        unsafe extern "C" fn(
            expansion: *const c_void,
            coefficients: *const f64,
            voxels: *mut f64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// `adjoint` in double precision. NULL where `expand_f64` is.
    pub adjoint_f64: Option<
        unsafe extern "C" fn(
            expansion: *const c_void,
            voxels: *const f64,
            coefficients: *mut f64,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
}

/// A stage type that a plugin brings.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldStage {
    /// `CONEFIELD_ENCODER`, …
    pub kind: u32,
    /// The value of `type` in a spec: lower-case letters, digits and hyphens.
    pub name: ConefieldStr,
    /// One line for people.
    pub doc: ConefieldStr,
    /// JSON Schema of its settings: an object whose `properties` have a `default` each, or are `required`. Its `examples`,
    /// if any, are settings that `conefield plugins check` tries.
    pub schema: ConefieldStr,
    /// Handed to `create`.
    pub context: *const c_void,
    /// Makes a stage from `settings`: one JSON object that fits the schema, with every default written. `width` is the
    /// number of channels that go in; 3 for an encoder, 0 where there are none. Returns [`CONEFIELD_INVALID`] and a text
    /// such as `bands: found 0, expected at least 1` for settings that make no stage.
    pub create: Option<
        unsafe extern "C" fn(
            context: *const c_void,
            settings: ConefieldStr,
            width: usize,
            stage: *mut *mut c_void,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Frees what `create` or another function of the stage made: every stage that was handed over, once.
    pub destroy: Option<unsafe extern "C" fn(stage: *mut c_void)>,
    /// One line on a stage, such as `10 levels x 2`.
    pub describe: Option<unsafe extern "C" fn(stage: *const c_void, text: *mut ConefieldText) -> ConefieldStatus>,
    /// Of an encoder, a normalizer, a field or a line field; otherwise NULL.
    pub map: *const ConefieldMap,
    /// Of a projector; otherwise NULL.
    pub projector: *const ConefieldProjector,
    /// Of an initializer; otherwise NULL.
    pub initializer: *const ConefieldInitializer,
    /// Of a loss; otherwise NULL.
    pub loss: *const ConefieldLoss,
    /// Of a prior; otherwise NULL.
    pub prior: *const ConefieldPrior,
    /// Of a regularizer; otherwise NULL. Since 2.2, as the rest.
    pub regularizer: *const ConefieldRegularizer,
    /// Of a data term; otherwise NULL.
    pub data_term: *const ConefieldDataTerm,
    /// Of a basis; otherwise NULL.
    pub basis: *const ConefieldBasis,
}

/// What a plugin is and brings.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldPlugin {
    /// Bytes of this table.
    pub size: usize,
    /// [`CONEFIELD_ABI_MAJOR`] as the plugin was built with.
    pub abi_major: u32,
    /// [`CONEFIELD_ABI_MINOR`] as the plugin was built with.
    pub abi_minor: u32,
    /// The plugin's name.
    pub name: ConefieldStr,
    /// Its own version.
    pub version: ConefieldStr,
    /// Its licence, an SPDX expression.
    pub licence: ConefieldStr,
    /// Its stage types, one after the other.
    pub stages: *const ConefieldStage,
    /// How many.
    pub stage_count: usize,
    /// Bytes from one to the next.
    pub stage_size: usize,
}

/// The one function that a plugin exports, under the name [`ENTRY`]. What it returns lives as long as the library; NULL
/// where there is nothing to offer.
pub type ConefieldEntry = unsafe extern "C" fn() -> *const ConefieldPlugin;

/// The name of the function that a plugin exports.
pub const ENTRY: &str = "conefield_plugin";

/// The contract as C reads it: the text of `conefield_plugin.h`.
pub const HEADER: &str = include_str!("../include/conefield_plugin.h");

impl ConefieldStr {
    /// `text`, which must outlive every use of this.
    pub const fn of(text: &str) -> Self {
        Self { data: text.as_ptr(), length: text.len() }
    }
}
