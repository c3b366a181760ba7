//! The contract between conefield and a plugin, in C. `include/conefield_plugin.h` is generated from this file and
//! `tables.rs`.
//!
//! A plugin is a shared library that exports [`conefield_plugin`](ConefieldEntry), which returns a table of its
//! contents. Rules beyond the types:
//!
//! - **Versions.** `abi_major` must equal the host's. Within a major version tables only grow at their end. Each table
//!   states its own `size`: a table shorter than in the first minor version is refused, later functions that a table
//!   does not reach count as NULL, and anything beyond the host's table is not read. Everything else here keeps its
//!   layout.
//! - **Memory.** Ownership never changes: the host frees what it allocated, the plugin frees what it allocated
//!   (`destroy`). Data that a plugin's tables point to lives as long as the library, which is never unloaded; data that
//!   a stage points to lives as long as the stage.
//! - **Tiles** are channel-major: channel `c` of row `i` is `data[c * stride + i]`. A pointer may be NULL if there is
//!   no data (no channels, no parameters). Floats are aligned to their own size only.
//! - **Threads.** A stage is called from many threads at once; every function that takes it as `const` must allow that.
//!   Only `create`, `destroy`, `reduce`, `fitted`, `weights`, `with_weights`, `check`, `volume`, `on`, `of`, `prox`,
//!   `adapt` and `state` of a stage never run at the same time as another call of that stage, but may run on any
//!   thread.
//! - **Unwinding** must not leave the library: catch panics and exceptions, return [`CONEFIELD_PANICKED`].
//! - **Determinism.** Results must not depend on threads, on time, or on how rows are divided into tiles.

use std::ffi::c_void;
use std::mem;

/// Defines tables of functions, each a pointer that is NULL if the function is absent. A plugin without one that is
/// `required` is refused. `since` gives the minor version that brought a function, where it is not the first.
macro_rules! tables {
    ($(
        $(#[$about:meta])*
        $table:ident {
            $($(#[$doc:meta])* $need:ident $name:ident($($argument:ident: $type:ty),*) $(-> $result:ty)?
                $(, since $minor:literal)?;)*
        }
    )*) => {$(
        $(#[$about])*
        #[repr(C)]
        #[derive(Debug, Clone, Copy)]
        pub struct $table {
            /// Bytes of this table.
            pub size: usize,
            $($(#[$doc])* pub $name: Option<unsafe extern "C" fn($($argument: $type),*) $(-> $result)?>,)*
        }

        const _: () = assert!(mem::offset_of!($table, size) == 0 && $table::FIRST_SIZE <= size_of::<$table>());

        impl $table {
            /// Bytes of this table in the first minor version.
            pub const FIRST_SIZE: usize = first_size(&[$(stringify!($($minor)?)),*]);

            /// The first required function that is absent.
            pub fn missing(&self) -> Option<&'static str> {
                let all = [$((stringify!($name), stringify!($need), self.$name.is_some())),*];
                all.into_iter().find(|(_, need, there)| *need == "required" && !there).map(|(name, ..)| name)
            }
        }
    )*};
}

/// Bytes of a table whose functions came with these minor versions; "" is the first.
const fn first_size(minors: &[&str]) -> usize {
    let mut pointers = 1;
    while pointers <= minors.len() && minors[pointers - 1].is_empty() {
        pointers += 1;
    }
    pointers * size_of::<usize>()
}

include!("tables.rs");

/// Major version of this contract. Plugins with another one are refused.
pub const CONEFIELD_ABI_MAJOR: u32 = 4;
/// Minor version: increases whenever tables grow.
pub const CONEFIELD_ABI_MINOR: u32 = 0;

/// Return value of a function.
pub type ConefieldStatus = i32;
/// Success.
pub const CONEFIELD_OK: ConefieldStatus = 0;
/// The input, such as settings, is invalid; the error text gives the reason.
pub const CONEFIELD_INVALID: ConefieldStatus = 1;
/// The request is valid, but this stage does not support it.
pub const CONEFIELD_UNSUPPORTED: ConefieldStatus = 2;
/// The call failed.
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
/// Initializes weights.
pub const CONEFIELD_INITIALIZER: u32 = 4;
/// Compares predicted with measured values.
pub const CONEFIELD_LOSS: u32 = 5;
/// Penalizes the values of a field on small blocks of neighbouring points.
pub const CONEFIELD_PRIOR: u32 = 6;
/// Penalty of coefficients with its proximal map, for iterative methods.
pub const CONEFIELD_REGULARIZER: u32 = 7;
/// Distance between computed and measured line integrals, for iterative methods.
pub const CONEFIELD_DATA_TERM: u32 = 8;
/// Coefficients to voxels, for iterative methods.
pub const CONEFIELD_BASIS: u32 = 9;

/// Hands the macro `$then` every kind: for each table of functions its type, its field in [`ConefieldStage`], and the
/// kinds that use it, each with conefield's name, the name of its files, its code, and a small spec with the place that
/// such a stage has there. The host's dispatch, the exports of Rust plugins, and new plugins with their tests are made
/// from this list.
#[macro_export]
macro_rules! kinds {
    ($then:ident) => {
        $then! {
            ConefieldMap map:
                Encoder encoder CONEFIELD_ENCODER fast "[encoder]",
                Normalizer normalizer CONEFIELD_NORMALIZER fast "[[normalizers]]",
                Field field CONEFIELD_FIELD fast "[field]";
            ConefieldProjector projector: Projector projector CONEFIELD_PROJECTOR fast "[projector]";
            ConefieldInitializer initializer: Initializer initializer CONEFIELD_INITIALIZER fast "[initializer]";
            ConefieldLoss loss: Loss loss CONEFIELD_LOSS fast "[loss]";
            ConefieldPrior prior: Prior prior CONEFIELD_PRIOR fast "[[priors]]";
            ConefieldRegularizer regularizer: Regularizer regularizer CONEFIELD_REGULARIZER fista "[prior]";
            ConefieldDataTerm data_term: DataTerm data_term CONEFIELD_DATA_TERM fista "[data]";
            ConefieldBasis basis: Basis basis CONEFIELD_BASIS fista "[basis]";
        }
    };
}

/// A row depends on itself only.
pub const CONEFIELD_SCOPE_ROW: u32 = 0;
/// A row depends on the rows of its ray: tiles hold one whole ray, or a single row off any ray.
pub const CONEFIELD_SCOPE_RAY: u32 = 1;

/// No parameters.
pub const CONEFIELD_GRADS_NONE: u32 = 0;
/// Few parameters, each affected by every row: each worker sums its own copy.
pub const CONEFIELD_GRADS_DENSE: u32 = 1;
/// Many parameters, few affected by a row: workers own the ranges of `partition`. Such a stage keeps no tape.
pub const CONEFIELD_GRADS_SCATTER: u32 = 2;

/// `reduce` removes output channels.
pub const CONEFIELD_OUTPUTS: u32 = 0;
/// `reduce` removes input channels.
pub const CONEFIELD_INPUTS: u32 = 1;

/// UTF-8 text, not zero-terminated.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldStr {
    /// First byte; may be NULL if `length` is 0.
    pub data: *const u8,
    /// Length in bytes.
    pub length: usize,
}

/// Buffer for text that a plugin writes, as UTF-8.
#[repr(C)]
#[derive(Debug)]
pub struct ConefieldText {
    /// The buffer.
    pub data: *mut u8,
    /// Size of the buffer in bytes.
    pub capacity: usize,
    /// Bytes of the whole text, set by the plugin. The part beyond `capacity` is not written; the host may call again.
    pub length: usize,
}

/// Channels of rows, read-only.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldTile {
    /// Row 0 of channel 0.
    pub data: *const f32,
    /// Channels.
    pub channels: usize,
    /// Rows, at least 1.
    pub rows: usize,
    /// Floats between the starts of two channels, at least `rows`.
    pub stride: usize,
}

/// Channels of rows, writable.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldTileMut {
    /// Row 0 of channel 0; NULL if the host does not need it.
    pub data: *mut f32,
    /// Channels.
    pub channels: usize,
    /// Rows, at least 1.
    pub rows: usize,
    /// Floats between the starts of two channels, at least `rows`.
    pub stride: usize,
}

/// Gradients of the parameters `start..start + length` of a stage. Calls add to them.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldGrads {
    /// Gradient of parameter `start`.
    pub data: *mut f32,
    /// The first parameter.
    pub start: usize,
    /// Number of parameters; the stage ignores all others.
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
    /// Doubles between the starts of two channels, at least `rows`.
    pub stride: usize,
}

/// [`ConefieldTileMut`] in double precision.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldTileMut64 {
    /// Row 0 of channel 0; NULL if the host does not need it.
    pub data: *mut f64,
    /// Channels.
    pub channels: usize,
    /// Rows, at least 1.
    pub rows: usize,
    /// Doubles between the starts of two channels, at least `rows`.
    pub stride: usize,
}

/// [`ConefieldGrads`] in double precision.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldGrads64 {
    /// Gradient of parameter `start`.
    pub data: *mut f64,
    /// The first parameter.
    pub start: usize,
    /// Number of parameters; the stage ignores all others.
    pub length: usize,
}

/// Widths, counts and cost of an encoder, normalizer or field.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct ConefieldInfo {
    /// Input channels.
    pub input: usize,
    /// Output channels.
    pub output: usize,
    /// Parameters.
    pub params: usize,
    /// Number of named blocks of parameters.
    pub blocks: usize,
    /// Number of ranges of `partition`; 0 or 1 without it.
    pub partitions: usize,
    /// Numbers per row that forward stores for backward.
    pub tape: usize,
    /// Multiply-adds of forward per row.
    pub macs: usize,
    /// `CONEFIELD_SCOPE_…`
    pub scope: u32,
    /// `CONEFIELD_GRADS_…`
    pub grads: u32,
    /// 1 if output equals input: hosts skip the stage.
    pub identity: u32,
    /// 1 if an encoder's channels are ordered from coarse to fine.
    pub coarse_to_fine: u32,
    /// 1 if it has double-precision kernels; 0 leaves `forward_f64` and `backward_f64` unused. Without them gradients are
    /// checked in single precision, which is coarse near kinks and at high frequencies.
    pub double_precision: u32,
}

/// One named block of parameters. Blocks are consecutive and cover all parameters.
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

/// A range `start..end` of parameters or channels.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
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
    /// The smaller stage, newly created.
    pub stage: *mut c_void,
    /// The original parameters that it keeps, in its order; valid as long as it lives.
    pub params: *const ConefieldRange,
    /// Ranges in `params`.
    pub params_count: usize,
    /// The channels that remain on the other side of the stage; valid as long as it lives.
    pub channels: *const usize,
    /// Channels in `channels`.
    pub channels_count: usize,
}

/// A ray in the unit cube: `origin + t * direction`, where `t` counts cube sides.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldRay {
    /// Start.
    pub origin: [f32; 3],
    /// Unit vector.
    pub direction: [f32; 3],
    /// Entry into and exit from the reconstruction box; equal if the ray misses it.
    pub inside: [f32; 2],
    /// Beginning and end of the published sampling range (near, far).
    pub published: [f32; 2],
    /// Cube sides per millimetre.
    pub per_mm: f32,
}

/// Lengths of a scene that projector settings may be relative to.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldLengths {
    /// The shortest side of a voxel, mm.
    pub voxel_mm: f64,
    /// The side of the encoder's finest cell, mm; 0 if the encoder does not report its resolution.
    pub cell_mm: f64,
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
    /// Number of values.
    pub length: usize,
}

/// The noise of a scan, in the scale of the stages: a line integral `p` has the variance `sigma² · exp(growth · p)`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldNoise {
    /// Standard deviation for an unattenuated ray.
    pub sigma: f64,
    /// Growth of the variance with the line integral, 0 or more.
    pub growth: f64,
    /// Measured line integrals, sampled as in training.
    pub measured: *const f64,
    /// Number of line integrals.
    pub count: usize,
}

/// Blocks and weight of a prior.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct ConefieldBlocks {
    /// Points along a block's edge, 2 to 32.
    pub edge: usize,
    /// Blocks per step.
    pub count: usize,
    /// Distance between neighbouring points in voxels.
    pub spacing: f64,
    /// Weight of the mean over all points relative to the mean loss of a ray.
    pub weight: f64,
}

/// A grid of voxels or of coefficients. Arrays on it are row-major, z fastest.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct ConefieldGrid {
    /// Number of points along x, y and z.
    pub shape: [usize; 3],
    /// Distance between neighbours, mm.
    pub spacing: [f64; 3],
    /// Centre of the grid, mm.
    pub center: [f64; 3],
}

/// Named state of a penalty, kept between calls.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldState {
    /// Their name, such as `dual`; valid as long as the penalty lives.
    pub name: ConefieldStr,
    /// The first number.
    pub data: *mut f32,
    /// Count of numbers.
    pub length: usize,
}

/// A basis on one grid of voxels.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct ConefieldExpansion {
    /// Positions of the coefficients.
    pub coefficients: ConefieldGrid,
    /// Working memory of either direction, in bytes.
    pub scratch: u64,
    /// 1 if coefficients are samples of the volume, on a grid that fills the same box.
    pub samples: u32,
    /// 1 if it also works in double precision.
    pub double_precision: u32,
}

/// A stage type of a plugin.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldStage {
    /// `CONEFIELD_ENCODER`, …
    pub kind: u32,
    /// The value of `type` in a spec: lower-case letters, digits and hyphens.
    pub name: ConefieldStr,
    /// A one-line description.
    pub doc: ConefieldStr,
    /// JSON Schema of its settings: an object whose `properties` each have a `default` or are `required`. Its
    /// `examples`, if any, are settings that `conefield plugins check` tries.
    pub schema: ConefieldStr,
    /// Argument of `create`.
    pub context: *const c_void,
    /// Creates a stage from `settings`: one JSON object that fits the schema, with all defaults written out. `width` is
    /// the number of input channels; 3 for an encoder, 0 if there are none. Returns [`CONEFIELD_INVALID`] and a text
    /// such as `bands: found 0, expected at least 1` for invalid settings.
    pub create: Option<
        unsafe extern "C" fn(
            context: *const c_void,
            settings: ConefieldStr,
            width: usize,
            stage: *mut *mut c_void,
            error: *mut ConefieldText,
        ) -> ConefieldStatus,
    >,
    /// Frees the result of `create` or of another function of the stage. Called once for every stage passed to the
    /// host.
    pub destroy: Option<unsafe extern "C" fn(stage: *mut c_void)>,
    /// A one-line description of a stage, such as `10 levels x 2`.
    pub describe: Option<unsafe extern "C" fn(stage: *const c_void, text: *mut ConefieldText) -> ConefieldStatus>,
    /// Functions of an encoder, normalizer or field; otherwise NULL.
    pub map: *const ConefieldMap,
    /// Functions of a projector; otherwise NULL.
    pub projector: *const ConefieldProjector,
    /// Functions of an initializer; otherwise NULL.
    pub initializer: *const ConefieldInitializer,
    /// Functions of a loss; otherwise NULL.
    pub loss: *const ConefieldLoss,
    /// Functions of a prior; otherwise NULL.
    pub prior: *const ConefieldPrior,
    /// Functions of a regularizer; otherwise NULL.
    pub regularizer: *const ConefieldRegularizer,
    /// Functions of a data term; otherwise NULL.
    pub data_term: *const ConefieldDataTerm,
    /// Functions of a basis; otherwise NULL.
    pub basis: *const ConefieldBasis,
}

/// Description and contents of a plugin.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ConefieldPlugin {
    /// Bytes of this table.
    pub size: usize,
    /// [`CONEFIELD_ABI_MAJOR`] of the build.
    pub abi_major: u32,
    /// [`CONEFIELD_ABI_MINOR`] of the build.
    pub abi_minor: u32,
    /// The plugin's name.
    pub name: ConefieldStr,
    /// Its own version.
    pub version: ConefieldStr,
    /// Its licence, an SPDX expression.
    pub licence: ConefieldStr,
    /// Its stage types, consecutive.
    pub stages: *const ConefieldStage,
    /// Number of stage types.
    pub stage_count: usize,
    /// Bytes between the starts of two entries.
    pub stage_size: usize,
}

/// The only function that a plugin exports, under the name [`ENTRY`]. Its result lives as long as the library; NULL if
/// there is nothing to offer.
pub type ConefieldEntry = unsafe extern "C" fn() -> *const ConefieldPlugin;

/// The name of the function that a plugin exports.
pub const ENTRY: &str = "conefield_plugin";

/// The contract for C: the text of `conefield_plugin.h`.
pub const HEADER: &str = include_str!("../include/conefield_plugin.h");

/// What many stages in C need besides the contract: the text of `conefield_helpers.h`.
pub const HELPERS: &str = include_str!("../include/conefield_helpers.h");

impl ConefieldStr {
    /// `text`, which must outlive every use of this.
    pub const fn of(text: &str) -> Self {
        Self { data: text.as_ptr(), length: text.len() }
    }
}
