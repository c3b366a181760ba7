/* The contract between conefield and its plugins, version 4.0. Made from plugins/abi/src/lib.rs. */

#ifndef CONEFIELD_PLUGIN_H
#define CONEFIELD_PLUGIN_H

#include <stddef.h>
#include <stdint.h>

/*
 Major version of this contract. Plugins with another one are refused.
 */
#define CONEFIELD_ABI_MAJOR 4

/*
 Minor version: increases whenever tables grow.
 */
#define CONEFIELD_ABI_MINOR 0

/*
 Points to features.
 */
#define CONEFIELD_ENCODER 0

/*
 Features to features.
 */
#define CONEFIELD_NORMALIZER 1

/*
 Features to attenuation.
 */
#define CONEFIELD_FIELD 2

/*
 Rays to samples.
 */
#define CONEFIELD_PROJECTOR 3

/*
 Initializes weights.
 */
#define CONEFIELD_INITIALIZER 4

/*
 Compares predicted with measured values.
 */
#define CONEFIELD_LOSS 5

/*
 Penalizes the values of a field on small blocks of neighbouring points.
 */
#define CONEFIELD_PRIOR 6

/*
 Penalty of coefficients with its proximal map, for iterative methods.
 */
#define CONEFIELD_REGULARIZER 7

/*
 Distance between computed and measured line integrals, for iterative methods.
 */
#define CONEFIELD_DATA_TERM 8

/*
 Coefficients to voxels, for iterative methods.
 */
#define CONEFIELD_BASIS 9

/*
 A row depends on itself only.
 */
#define CONEFIELD_SCOPE_ROW 0

/*
 A row depends on the rows of its ray: tiles hold one whole ray, or a single row off any ray.
 */
#define CONEFIELD_SCOPE_RAY 1

/*
 No parameters.
 */
#define CONEFIELD_GRADS_NONE 0

/*
 Few parameters, each affected by every row: each worker sums its own copy.
 */
#define CONEFIELD_GRADS_DENSE 1

/*
 Many parameters, few affected by a row: workers own the ranges of `partition`. Such a stage keeps no tape.
 */
#define CONEFIELD_GRADS_SCATTER 2

/*
 `reduce` removes output channels.
 */
#define CONEFIELD_OUTPUTS 0

/*
 `reduce` removes input channels.
 */
#define CONEFIELD_INPUTS 1

/*
 Return value of a function.
 */
typedef int32_t ConefieldStatus;

/*
 UTF-8 text, not zero-terminated.
 */
typedef struct ConefieldStr {
  /*
   First byte; may be NULL if `length` is 0.
   */
  const uint8_t *data;
  /*
   Length in bytes.
   */
  size_t length;
} ConefieldStr;

/*
 Buffer for text that a plugin writes, as UTF-8.
 */
typedef struct ConefieldText {
  /*
   The buffer.
   */
  uint8_t *data;
  /*
   Size of the buffer in bytes.
   */
  size_t capacity;
  /*
   Bytes of the whole text, set by the plugin. The part beyond `capacity` is not written; the host may call again.
   */
  size_t length;
} ConefieldText;

/*
 Widths, counts and cost of an encoder, normalizer or field.
 */
typedef struct ConefieldInfo {
  /*
   Input channels.
   */
  size_t input;
  /*
   Output channels.
   */
  size_t output;
  /*
   Parameters.
   */
  size_t params;
  /*
   Number of named blocks of parameters.
   */
  size_t blocks;
  /*
   Number of ranges of `partition`; 0 or 1 without it.
   */
  size_t partitions;
  /*
   Numbers per row that forward stores for backward.
   */
  size_t tape;
  /*
   Multiply-adds of forward per row.
   */
  size_t macs;
  /*
   `CONEFIELD_SCOPE_…`
   */
  uint32_t scope;
  /*
   `CONEFIELD_GRADS_…`
   */
  uint32_t grads;
  /*
   1 if output equals input: hosts skip the stage.
   */
  uint32_t identity;
  /*
   1 if an encoder's channels are ordered from coarse to fine.
   */
  uint32_t coarse_to_fine;
  /*
   1 if it has double-precision kernels; 0 leaves `forward_f64` and `backward_f64` unused. Without them gradients are
   checked in single precision, which is coarse near kinks and at high frequencies.
   */
  uint32_t double_precision;
} ConefieldInfo;

/*
 One named block of parameters. Blocks are consecutive and cover all parameters.
 */
typedef struct ConefieldParameter {
  /*
   Its name within the stage, such as `table`.
   */
  struct ConefieldStr name;
  /*
   Its shape, row-major.
   */
  const size_t *shape;
  /*
   Numbers in `shape`.
   */
  size_t dimensions;
} ConefieldParameter;

/*
 Channels of rows, read-only.
 */
typedef struct ConefieldTile {
  /*
   Row 0 of channel 0.
   */
  const float *data;
  /*
   Channels.
   */
  size_t channels;
  /*
   Rows, at least 1.
   */
  size_t rows;
  /*
   Floats between the starts of two channels, at least `rows`.
   */
  size_t stride;
} ConefieldTile;

/*
 Channels of rows, writable.
 */
typedef struct ConefieldTileMut {
  /*
   Row 0 of channel 0; NULL if the host does not need it.
   */
  float *data;
  /*
   Channels.
   */
  size_t channels;
  /*
   Rows, at least 1.
   */
  size_t rows;
  /*
   Floats between the starts of two channels, at least `rows`.
   */
  size_t stride;
} ConefieldTileMut;

/*
 Gradients of the parameters `start..start + length` of a stage. Calls add to them.
 */
typedef struct ConefieldGrads {
  /*
   Gradient of parameter `start`.
   */
  float *data;
  /*
   The first parameter.
   */
  size_t start;
  /*
   Number of parameters; the stage ignores all others.
   */
  size_t length;
} ConefieldGrads;

/*
 [`ConefieldTile`] in double precision.
 */
typedef struct ConefieldTile64 {
  /*
   Row 0 of channel 0.
   */
  const double *data;
  /*
   Channels.
   */
  size_t channels;
  /*
   Rows, at least 1.
   */
  size_t rows;
  /*
   Doubles between the starts of two channels, at least `rows`.
   */
  size_t stride;
} ConefieldTile64;

/*
 [`ConefieldTileMut`] in double precision.
 */
typedef struct ConefieldTileMut64 {
  /*
   Row 0 of channel 0; NULL if the host does not need it.
   */
  double *data;
  /*
   Channels.
   */
  size_t channels;
  /*
   Rows, at least 1.
   */
  size_t rows;
  /*
   Doubles between the starts of two channels, at least `rows`.
   */
  size_t stride;
} ConefieldTileMut64;

/*
 [`ConefieldGrads`] in double precision.
 */
typedef struct ConefieldGrads64 {
  /*
   Gradient of parameter `start`.
   */
  double *data;
  /*
   The first parameter.
   */
  size_t start;
  /*
   Number of parameters; the stage ignores all others.
   */
  size_t length;
} ConefieldGrads64;

/*
 A range `start..end` of parameters or channels.
 */
typedef struct ConefieldRange {
  /*
   The first.
   */
  size_t start;
  /*
   One past the last.
   */
  size_t end;
} ConefieldRange;

/*
 A stage without some of its channels.
 */
typedef struct ConefieldReduced {
  /*
   The smaller stage, newly created.
   */
  void *stage;
  /*
   The original parameters that it keeps, in its order; valid as long as it lives.
   */
  const struct ConefieldRange *params;
  /*
   Ranges in `params`.
   */
  size_t params_count;
  /*
   The channels that remain on the other side of the stage; valid as long as it lives.
   */
  const size_t *channels;
  /*
   Channels in `channels`.
   */
  size_t channels_count;
} ConefieldReduced;

/*
 Functions of an encoder, normalizer or field. `stage` is the result of `create`.
 */
typedef struct ConefieldMap {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Widths and counts; constant for a stage.
   */
  ConefieldStatus (*info)(const void *stage, struct ConefieldInfo *info);
  /*
   Block `index` of the parameters. NULL if there are none.
   */
  ConefieldStatus (*parameter)(const void *stage, size_t index, struct ConefieldParameter *parameter);
  /*
   Initializes all parameters, reproducible by `seed`. NULL if there are none.
   */
  ConefieldStatus (*init)(const void *stage,
                          uint64_t seed,
                          float *params,
                          size_t length,
                          struct ConefieldText *error);
  /*
   Overwrites `y` with f(x; params), and `tape` with the data for backward.
   */
  ConefieldStatus (*forward)(const void *stage,
                             const float *params,
                             struct ConefieldTile x,
                             struct ConefieldTileMut y,
                             struct ConefieldTileMut tape,
                             struct ConefieldText *error);
  /*
   Given `dy` = ∂L/∂y, adds ∂L/∂params to `grads` and, unless its data is NULL, overwrites `dx` with ∂L/∂x. `tape`
   holds the values of forward and may be used as scratch; it has no channels for a stage with scattered gradients.
   The summation order of a parameter's gradient must not depend on the range in `grads`.
   */
  ConefieldStatus (*backward)(const void *stage,
                              const float *params,
                              struct ConefieldTile x,
                              struct ConefieldTileMut tape,
                              struct ConefieldTile dy,
                              struct ConefieldGrads grads,
                              struct ConefieldTileMut dx,
                              struct ConefieldText *error);
  /*
   `forward` in double precision, for checking gradients; NULL if there is none.
   */
  ConefieldStatus (*forward_f64)(const void *stage,
                                 const double *params,
                                 struct ConefieldTile64 x,
                                 struct ConefieldTileMut64 y,
                                 struct ConefieldTileMut64 tape,
                                 struct ConefieldText *error);
  /*
   `backward` in double precision; NULL if there is none.
   */
  ConefieldStatus (*backward_f64)(const void *stage,
                                  const double *params,
                                  struct ConefieldTile64 x,
                                  struct ConefieldTileMut64 tape,
                                  struct ConefieldTile64 dy,
                                  struct ConefieldGrads64 grads,
                                  struct ConefieldTileMut64 dx,
                                  struct ConefieldText *error);
  /*
   Range `index` of the parameters that a worker may own; ranges are disjoint, ascending and cover all parameters.
   NULL: one range.
   */
  ConefieldStatus (*partition)(const void *stage, size_t index, struct ConefieldRange *range);
  /*
   Creates a smaller stage. With `side` [`CONEFIELD_OUTPUTS`], an encoder that computes only the outputs `keep`;
   with [`CONEFIELD_INPUTS`], a normalizer or field with only the inputs `keep`. `keep` is ascending. NULL: not
   supported; masks that need it are refused.
   */
  ConefieldStatus (*reduce)(const void *stage,
                            uint32_t side,
                            const size_t *keep,
                            size_t keep_count,
                            struct ConefieldReduced *reduced,
                            struct ConefieldText *error);
  /*
   WGSL of the same formula: functions `stage_forward` and `stage_backward` of a row; see
   docs/guide/writing-stages.md. NULL: CPU only.
   */
  ConefieldStatus (*wgsl)(const void *stage, struct ConefieldText *source);
  /*
   Number of passes of `forward`, each over a table of its own; constant for a stage. A host with many tiles runs
   one pass for all of them before the next, while its table is in the cache. NULL: one pass.
   */
  size_t (*passes)(const void *stage);
  /*
   Pass `pass` of `forward`, from 0; all passes in order give the same bits as `forward`. A pass keeps the output
   of the other passes. NULL if `passes` is NULL.
   */
  ConefieldStatus (*forward_pass)(const void *stage,
                                  size_t pass,
                                  const float *params,
                                  struct ConefieldTile x,
                                  struct ConefieldTileMut y,
                                  struct ConefieldTileMut tape,
                                  struct ConefieldText *error);
  /*
   For an encoder: writes the resolution of each of its `count` channels in cells along the unit cube's side,
   finite numbers above 0. Projectors may count in the finest cell, and channels finer than the data can be left
   out. Returns [`CONEFIELD_UNSUPPORTED`] if unknown. NULL: unknown.
   */
  ConefieldStatus (*resolutions)(const void *stage,
                                 double *cells,
                                 size_t count,
                                 struct ConefieldText *error);
} ConefieldMap;

/*
 A ray in the unit cube: `origin + t * direction`, where `t` counts cube sides.
 */
typedef struct ConefieldRay {
  /*
   Start.
   */
  float origin[3];
  /*
   Unit vector.
   */
  float direction[3];
  /*
   Entry into and exit from the reconstruction box; equal if the ray misses it.
   */
  float inside[2];
  /*
   Beginning and end of the published sampling range (near, far).
   */
  float published[2];
  /*
   Cube sides per millimetre.
   */
  float per_mm;
} ConefieldRay;

/*
 Lengths of a scene that projector settings may be relative to.
 */
typedef struct ConefieldLengths {
  /*
   The shortest side of a voxel, mm.
   */
  double voxel_mm;
  /*
   The side of the encoder's finest cell, mm; 0 if the encoder does not report its resolution.
   */
  double cell_mm;
} ConefieldLengths;

/*
 Functions of a projector.
 */
typedef struct ConefieldProjector {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Maximum number of samples that `sample` writes for `ray`; 0 if it misses the scene.
   */
  size_t (*max_samples)(const void *stage, const struct ConefieldRay *ray);
  /*
   Writes the samples of `ray`: positions `x, y, z` in the unit cube to `points`, the length of each in cube sides
   to `weights`, and their number (at most `capacity`) to `count`. `seed` determines random positions; with NULL
   (rendering) none are random.
   */
  ConefieldStatus (*sample)(const void *stage,
                            const struct ConefieldRay *ray,
                            const uint64_t *seed,
                            float *points,
                            float *weights,
                            size_t capacity,
                            size_t *count,
                            struct ConefieldText *error);
  /*
   The line integral of `count` attenuations. NULL: their sum, weighted by the lengths.
   */
  double (*integrate)(const void *stage, const float *weights, const double *mu, size_t count);
  /*
   The exact adjoint of `integrate`: overwrites `dmu` with its derivatives times `dline`. NULL if `integrate` is
   NULL.
   */
  void (*adjoint)(const void *stage, const float *weights, double dline, double *dmu, size_t count);
  /*
   Creates the projector for a scene with these lengths and sets `fitted` to it. A projector whose settings do not
   depend on them leaves `fitted` unchanged. NULL: the settings never depend on them.
   */
  ConefieldStatus (*fitted)(const void *stage,
                            const struct ConefieldLengths *lengths,
                            void **fitted,
                            struct ConefieldText *error);
  /*
   WGSL of `sample`, for a projector that integrates like one without `integrate`: a function `stage_sample`; see
   docs/guide/writing-stages.md. NULL: CPU only.
   */
  ConefieldStatus (*wgsl)(const void *stage, struct ConefieldText *source);
} ConefieldProjector;

/*
 A named block of all parameters of a pipeline.
 */
typedef struct ConefieldBlock {
  /*
   Its full name, such as `field.0.weight`.
   */
  struct ConefieldStr name;
  /*
   Its shape, row-major.
   */
  const size_t *shape;
  /*
   Numbers in `shape`.
   */
  size_t dimensions;
  /*
   Its first parameter.
   */
  size_t start;
  /*
   Its parameters.
   */
  size_t length;
} ConefieldBlock;

/*
 A tensor of a weights file.
 */
typedef struct ConefieldTensor {
  /*
   Its name.
   */
  struct ConefieldStr name;
  /*
   Its shape, row-major.
   */
  const size_t *shape;
  /*
   Numbers in `shape`.
   */
  size_t dimensions;
  /*
   Its numbers.
   */
  const float *values;
  /*
   Number of values.
   */
  size_t length;
} ConefieldTensor;

/*
 Functions of an initializer. Optional functions may be NULL.
 */
typedef struct ConefieldInitializer {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Initializes some of `params`, after every stage's own initialization, and sets the entry of each initialized
   block in `filled` to 1.
   */
  ConefieldStatus (*apply)(const void *stage,
                           const struct ConefieldBlock *blocks,
                           size_t block_count,
                           float *params,
                           size_t length,
                           uint8_t *filled,
                           struct ConefieldText *error);
  /*
   Optional. Refuses parameters that do not fit, before a run begins.
   */
  ConefieldStatus (*check)(const void *stage,
                           const struct ConefieldBlock *blocks,
                           size_t block_count,
                           struct ConefieldText *error);
  /*
   Optional. The weights file named by the settings; [`CONEFIELD_UNSUPPORTED`] if there is none. The
   host reads the file and continues with the stage that `with_weights` creates.
   */
  ConefieldStatus (*weights)(const void *stage, struct ConefieldStr *path);
  /*
   Required together with `weights`. Creates a stage with these weights, which are valid during the
   call.
   */
  ConefieldStatus (*with_weights)(const void *stage,
                                  const struct ConefieldTensor *tensors,
                                  size_t count,
                                  void **out,
                                  struct ConefieldText *error);
  /*
   Optional. The file of a known volume that the field learns in `steps` steps after weights are
   initialized; [`CONEFIELD_UNSUPPORTED`] if there is none.
   */
  ConefieldStatus (*volume)(const void *stage, struct ConefieldStr *path, uint64_t *steps);
} ConefieldInitializer;

/*
 The noise of a scan, in the scale of the stages: a line integral `p` has the variance `sigma² · exp(growth · p)`.
 */
typedef struct ConefieldNoise {
  /*
   Standard deviation for an unattenuated ray.
   */
  double sigma;
  /*
   Growth of the variance with the line integral, 0 or more.
   */
  double growth;
  /*
   Measured line integrals, sampled as in training.
   */
  const double *measured;
  /*
   Number of line integrals.
   */
  size_t count;
} ConefieldNoise;

/*
 Functions of a loss.
 */
typedef struct ConefieldLoss {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Compares `count` predicted values with measured ones: writes the loss of each pair to `loss`, and its derivative
   with respect to the predicted value to `slope`. A loss is 0 if both values agree, never negative, and NaN if a
   value is NaN.
   */
  ConefieldStatus (*at)(const void *stage,
                        const double *predicted,
                        const double *measured,
                        size_t count,
                        double *loss,
                        double *slope,
                        struct ConefieldText *error);
  /*
   1 if the loss is fitted to the scan: training then uses the result of `fitted`. NULL: it is not.
   */
  uint32_t (*needs_scan)(const void *stage);
  /*
   Creates the loss for a scan with this noise and sets `fitted` to it; a loss that does not depend on the noise
   leaves `fitted` unchanged. NULL if `needs_scan` is NULL.
   */
  ConefieldStatus (*fitted)(const void *stage,
                            const struct ConefieldNoise *noise,
                            void **fitted,
                            struct ConefieldText *error);
  /*
   WGSL of `at`: a function `stage_at`; see docs/guide/writing-stages.md. NULL: CPU only.
   */
  ConefieldStatus (*wgsl)(const void *stage, struct ConefieldText *source);
} ConefieldLoss;

/*
 Blocks and weight of a prior.
 */
typedef struct ConefieldBlocks {
  /*
   Points along a block's edge, 2 to 32.
   */
  size_t edge;
  /*
   Blocks per step.
   */
  size_t count;
  /*
   Distance between neighbouring points in voxels.
   */
  double spacing;
  /*
   Weight of the mean over all points relative to the mean loss of a ray.
   */
  double weight;
} ConefieldBlocks;

/*
 Functions of a prior.
 */
typedef struct ConefieldPrior {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Its blocks; constant for a stage.
   */
  ConefieldStatus (*blocks)(const void *stage, struct ConefieldBlocks *blocks);
  /*
   Writes the non-negative penalty of one block to `penalty`. `values` are those of its `count = edge³` points, z
   fastest. Adds `scale` times the derivative with respect to each of them to `gradient`. The penalty is NaN if a
   value is NaN.
   */
  ConefieldStatus (*block)(const void *stage,
                           const double *values,
                           size_t count,
                           double scale,
                           double *gradient,
                           double *penalty,
                           struct ConefieldText *error);
  /*
   WGSL of `block`: a function `stage_at`; see docs/guide/writing-stages.md. NULL: CPU only.
   */
  ConefieldStatus (*wgsl)(const void *stage, struct ConefieldText *source);
} ConefieldPrior;

/*
 A grid of voxels or of coefficients. Arrays on it are row-major, z fastest.
 */
typedef struct ConefieldGrid {
  /*
   Number of points along x, y and z.
   */
  size_t shape[3];
  /*
   Distance between neighbours, mm.
   */
  double spacing[3];
  /*
   Centre of the grid, mm.
   */
  double center[3];
} ConefieldGrid;

/*
 Named state of a penalty, kept between calls.
 */
typedef struct ConefieldState {
  /*
   Their name, such as `dual`; valid as long as the penalty lives.
   */
  struct ConefieldStr name;
  /*
   The first number.
   */
  float *data;
  /*
   Count of numbers.
   */
  size_t length;
} ConefieldState;

/*
 Functions of a regularizer: a convex penalty R of coefficients, for any grid. The result of `on` is a stage of its
 own, which `destroy` frees; it is the argument of `value`, `prox`, `adapt` and `state`.
 */
typedef struct ConefieldRegularizer {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Bytes held by the penalty on `grid`. NULL: negligible.
   */
  uint64_t (*bytes)(const void *stage, const struct ConefieldGrid *grid);
  /*
   Creates the penalty on `grid`.
   */
  ConefieldStatus (*on)(const void *stage,
                        const struct ConefieldGrid *grid,
                        void **penalty,
                        struct ConefieldText *error);
  /*
   The weight λ, 0 or more, for attenuation in 1/mm and lengths in mm. `noise(context, k)` returns k times the root
   mean square of the scan's noise in the gradient of the data term; it takes a back-projection.
   */
  ConefieldStatus (*weight)(const void *stage,
                            const struct ConefieldGrid *grid,
                            double (*noise)(void *context, double k),
                            void *context,
                            double *weight,
                            struct ConefieldText *error);
  /*
   R(x), 0 or more, of the `count` coefficients of the grid.
   */
  ConefieldStatus (*value)(const void *penalty,
                           const float *x,
                           size_t count,
                           double *value,
                           struct ConefieldText *error);
  /*
   Overwrites `u` with the coefficients ≥ 0 that minimize `½‖u − v‖² + tau·R(u)`, or approaches them with each call
   for the same `v`.
   */
  ConefieldStatus (*prox)(void *penalty,
                          const float *v,
                          size_t count,
                          float tau,
                          float *u,
                          struct ConefieldText *error);
  /*
   Entry `index` of the state from which the next `prox` starts, for checkpoints; [`CONEFIELD_UNSUPPORTED`] past
   the last. NULL: no state.
   */
  ConefieldStatus (*state)(void *penalty, size_t index, struct ConefieldState *state);
  /*
   Adapts the penalty to the coefficients `x`, before each pass over the scan. The result depends on `x` only and
   is not part of `state`. Writes the new R(x); returns [`CONEFIELD_UNSUPPORTED`] if the penalty does not change.
   NULL: it never changes.
   */
  ConefieldStatus (*adapt)(void *penalty,
                           const float *x,
                           size_t count,
                           double *value,
                           struct ConefieldText *error);
} ConefieldRegularizer;

/*
 Functions of a data term `Σ φ(r)` of residuals `r = measured − predicted`. The result of `of` is a stage of its own,
 which `destroy` frees; it is the argument of all functions except `bytes` and `of`. Each call is for one image:
 `count` pixels of view `view`, with its line integrals `measured`, row by row.
 */
typedef struct ConefieldDataTerm {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Bytes held for a scan of `shape` (views, rows, columns), and temporary bytes of `of`. NULL: negligible.
   */
  void (*bytes)(const void *stage, const size_t *shape, uint64_t *held, uint64_t *brief);
  /*
   Creates the data term for the line integrals `measured`, which it does not keep.
   */
  ConefieldStatus (*of)(const void *stage,
                        const float *measured,
                        const size_t *shape,
                        void **misfit,
                        struct ConefieldText *error);
  /*
   Standard deviation of the noise of line integrals near 0.
   */
  double (*noise)(const void *misfit);
  /*
   Overwrites residuals with the derivatives φ'(r), and `sum` with the sum of all φ(r).
   */
  ConefieldStatus (*differentiate)(const void *misfit,
                                   size_t view,
                                   const float *measured,
                                   size_t count,
                                   float *residuals,
                                   double *sum,
                                   struct ConefieldText *error);
  /*
   Multiplies each value by an upper bound of φ''.
   */
  ConefieldStatus (*curve)(const void *misfit,
                           size_t view,
                           const float *measured,
                           size_t count,
                           float *values,
                           struct ConefieldText *error);
  /*
   Multiplies each value by the standard deviation of φ' under noise, in units of `noise`.
   */
  ConefieldStatus (*spread)(const void *misfit,
                            size_t view,
                            const float *measured,
                            size_t count,
                            float *values,
                            struct ConefieldText *error);
} ConefieldDataTerm;

/*
 A basis on one grid of voxels.
 */
typedef struct ConefieldExpansion {
  /*
   Positions of the coefficients.
   */
  struct ConefieldGrid coefficients;
  /*
   Working memory of either direction, in bytes.
   */
  uint64_t scratch;
  /*
   1 if coefficients are samples of the volume, on a grid that fills the same box.
   */
  uint32_t samples;
  /*
   1 if it also works in double precision.
   */
  uint32_t double_precision;
} ConefieldExpansion;

/*
 Functions of a basis: a matrix B from coefficients to voxels. Its entries are non-negative, unless coefficients are
 samples. The result of `on` is a stage of its own, which `destroy` frees; it is the argument of all other functions.
 */
typedef struct ConefieldBasis {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Creates the basis for the voxels of a grid. The number of coefficients depends on the grid's shape only.
   */
  ConefieldStatus (*on)(const void *stage,
                        const struct ConefieldGrid *voxels,
                        void **expansion,
                        struct ConefieldText *error);
  /*
   Its properties on this grid; constant.
   */
  ConefieldStatus (*info)(const void *expansion, struct ConefieldExpansion *info);
  /*
   Overwrites `voxels` with `B·coefficients`.
   */
  ConefieldStatus (*expand)(const void *expansion,
                            const float *coefficients,
                            float *voxels,
                            struct ConefieldText *error);
  /*
   Overwrites `coefficients` with `Bᵀ·voxels`, the exact adjoint.
   */
  ConefieldStatus (*adjoint)(const void *expansion,
                             const float *voxels,
                             float *coefficients,
                             struct ConefieldText *error);
  /*
   `expand` in double precision, for checks. NULL: there is none.
   */
  ConefieldStatus (*expand_f64)(const void *expansion,
                                const double *coefficients,
                                double *voxels,
                                struct ConefieldText *error);
  /*
   `adjoint` in double precision. NULL if `expand_f64` is NULL.
   */
  ConefieldStatus (*adjoint_f64)(const void *expansion,
                                 const double *voxels,
                                 double *coefficients,
                                 struct ConefieldText *error);
} ConefieldBasis;

/*
 A stage type of a plugin.
 */
typedef struct ConefieldStage {
  /*
   `CONEFIELD_ENCODER`, …
   */
  uint32_t kind;
  /*
   The value of `type` in a spec: lower-case letters, digits and hyphens.
   */
  struct ConefieldStr name;
  /*
   A one-line description.
   */
  struct ConefieldStr doc;
  /*
   JSON Schema of its settings: an object whose `properties` each have a `default` or are `required`. Its
   `examples`, if any, are settings that `conefield plugins check` tries.
   */
  struct ConefieldStr schema;
  /*
   Argument of `create`.
   */
  const void *context;
  /*
   Creates a stage from `settings`: one JSON object that fits the schema, with all defaults written out. `width` is
   the number of input channels; 3 for an encoder, 0 if there are none. Returns [`CONEFIELD_INVALID`] and a text
   such as `bands: found 0, expected at least 1` for invalid settings.
   */
  ConefieldStatus (*create)(const void *context,
                            struct ConefieldStr settings,
                            size_t width,
                            void **stage,
                            struct ConefieldText *error);
  /*
   Frees the result of `create` or of another function of the stage. Called once for every stage passed to the
   host.
   */
  void (*destroy)(void *stage);
  /*
   A one-line description of a stage, such as `10 levels x 2`.
   */
  ConefieldStatus (*describe)(const void *stage, struct ConefieldText *text);
  /*
   Functions of an encoder, normalizer or field; otherwise NULL.
   */
  const struct ConefieldMap *map;
  /*
   Functions of a projector; otherwise NULL.
   */
  const struct ConefieldProjector *projector;
  /*
   Functions of an initializer; otherwise NULL.
   */
  const struct ConefieldInitializer *initializer;
  /*
   Functions of a loss; otherwise NULL.
   */
  const struct ConefieldLoss *loss;
  /*
   Functions of a prior; otherwise NULL.
   */
  const struct ConefieldPrior *prior;
  /*
   Functions of a regularizer; otherwise NULL.
   */
  const struct ConefieldRegularizer *regularizer;
  /*
   Functions of a data term; otherwise NULL.
   */
  const struct ConefieldDataTerm *data_term;
  /*
   Functions of a basis; otherwise NULL.
   */
  const struct ConefieldBasis *basis;
} ConefieldStage;

/*
 Description and contents of a plugin.
 */
typedef struct ConefieldPlugin {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   [`CONEFIELD_ABI_MAJOR`] of the build.
   */
  uint32_t abi_major;
  /*
   [`CONEFIELD_ABI_MINOR`] of the build.
   */
  uint32_t abi_minor;
  /*
   The plugin's name.
   */
  struct ConefieldStr name;
  /*
   Its own version.
   */
  struct ConefieldStr version;
  /*
   Its licence, an SPDX expression.
   */
  struct ConefieldStr licence;
  /*
   Its stage types, consecutive.
   */
  const struct ConefieldStage *stages;
  /*
   Number of stage types.
   */
  size_t stage_count;
  /*
   Bytes between the starts of two entries.
   */
  size_t stage_size;
} ConefieldPlugin;

/*
 Success.
 */
#define CONEFIELD_OK 0

/*
 The input, such as settings, is invalid; the error text gives the reason.
 */
#define CONEFIELD_INVALID 1

/*
 The request is valid, but this stage does not support it.
 */
#define CONEFIELD_UNSUPPORTED 2

/*
 The call failed.
 */
#define CONEFIELD_FAILED 3

/*
 A panic or an exception was caught.
 */
#define CONEFIELD_PANICKED 4

#endif  /* CONEFIELD_PLUGIN_H */

/* The one function that a plugin exports. What it returns lives as long as the library. */
#ifdef __cplusplus
extern "C"
#endif
const struct ConefieldPlugin *conefield_plugin(void);
