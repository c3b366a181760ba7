/* The contract between conefield and its plugins, version 2.2. Made from plugins/abi/src/lib.rs. */

#ifndef CONEFIELD_PLUGIN_H
#define CONEFIELD_PLUGIN_H

#include <stddef.h>
#include <stdint.h>

/*
 Major version of this contract. A plugin of another one is refused.
 */
#define CONEFIELD_ABI_MAJOR 2

/*
 Minor version: the number of times that tables have grown.
 */
#define CONEFIELD_ABI_MINOR 2

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
 Fills weights.
 */
#define CONEFIELD_INITIALIZER 4

/*
 Compares predicted with measured values.
 */
#define CONEFIELD_LOSS 5

/*
 Judges a field by small blocks of neighbouring points.
 */
#define CONEFIELD_PRIOR 6

/*
 Penalty of coefficients with its proximal map, for iterative methods. Since 2.2.
 */
#define CONEFIELD_REGULARIZER 7

/*
 How far line integrals are from the measured ones, for iterative methods. Since 2.2.
 */
#define CONEFIELD_DATA_TERM 8

/*
 Coefficients to voxels, for iterative methods. Since 2.2.
 */
#define CONEFIELD_BASIS 9

/*
 A field that brings line integrals of its own. Since 2.2.
 */
#define CONEFIELD_LINE_FIELD 10

/*
 A row looks at itself alone.
 */
#define CONEFIELD_SCOPE_ROW 0

/*
 A row looks at the rows of its ray: tiles hold one whole ray, or a single row off any ray.
 */
#define CONEFIELD_SCOPE_RAY 1

/*
 No parameters.
 */
#define CONEFIELD_GRADS_NONE 0

/*
 Few parameters, all touched by every row: each worker sums a copy.
 */
#define CONEFIELD_GRADS_DENSE 1

/*
 Many parameters, few touched by a row: workers own the ranges of `partition`. Such a stage keeps no tape.
 */
#define CONEFIELD_GRADS_SCATTER 2

/*
 Parameters are IEEE 754 `binary16`.
 */
#define CONEFIELD_F16 0

/*
 Parameters are `bfloat16`: the upper halves of floats.
 */
#define CONEFIELD_BF16 1

/*
 `reduce` leaves out channels that come out.
 */
#define CONEFIELD_OUTPUTS 0

/*
 `reduce` leaves out channels that go in.
 */
#define CONEFIELD_INPUTS 1

/*
 What a function returns.
 */
typedef int32_t ConefieldStatus;

/*
 UTF-8 text, not ended by a zero.
 */
typedef struct ConefieldStr {
  /*
   First byte; may be NULL if `length` is 0.
   */
  const uint8_t *data;
  /*
   Bytes.
   */
  size_t length;
} ConefieldStr;

/*
 Room for text that a plugin writes, as UTF-8.
 */
typedef struct ConefieldText {
  /*
   Where to.
   */
  uint8_t *data;
  /*
   Bytes that fit.
   */
  size_t capacity;
  /*
   Bytes of the whole text, set by the plugin; what is beyond `capacity` is not written, and the host may ask again.
   */
  size_t length;
} ConefieldText;

/*
 Widths, counts and cost of an encoder, a normalizer or a field.
 */
typedef struct ConefieldInfo {
  /*
   Channels in.
   */
  size_t input;
  /*
   Channels out.
   */
  size_t output;
  /*
   Parameters.
   */
  size_t params;
  /*
   Blocks of parameters, each with a name.
   */
  size_t blocks;
  /*
   Ranges that `partition` gives; 0 or 1 without it.
   */
  size_t partitions;
  /*
   Numbers a row that forward leaves for backward.
   */
  size_t tape;
  /*
   Multiply-adds a row, forward.
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
   1 if output equals input: hosts leave the stage out.
   */
  uint32_t identity;
  /*
   1 if an encoder's channels stand in order from coarse to fine.
   */
  uint32_t coarse_to_fine;
  /*
   1 if it has kernels in double precision.
   */
  uint32_t double_precision;
  /*
   1 if it has kernels that read parameters in halves.
   */
  uint32_t halves;
} ConefieldInfo;

/*
 One named block of parameters. Blocks stand one after the other and cover all parameters.
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
 Channels of rows, to be read.
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
   Floats from a channel to the next, at least `rows`.
   */
  size_t stride;
} ConefieldTile;

/*
 Channels of rows, to be written.
 */
typedef struct ConefieldTileMut {
  /*
   Row 0 of channel 0; NULL where the host does not want it.
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
   Floats from a channel to the next, at least `rows`.
   */
  size_t stride;
} ConefieldTileMut;

/*
 Gradients of the parameters `start..start + length` of a stage, to be added to.
 */
typedef struct ConefieldGrads {
  /*
   That of parameter `start`.
   */
  float *data;
  /*
   The first parameter.
   */
  size_t start;
  /*
   Parameters; the stage leaves all others alone.
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
   Doubles from a channel to the next, at least `rows`.
   */
  size_t stride;
} ConefieldTile64;

/*
 [`ConefieldTileMut`] in double precision.
 */
typedef struct ConefieldTileMut64 {
  /*
   Row 0 of channel 0; NULL where the host does not want it.
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
   Doubles from a channel to the next, at least `rows`.
   */
  size_t stride;
} ConefieldTileMut64;

/*
 [`ConefieldGrads`] in double precision.
 */
typedef struct ConefieldGrads64 {
  /*
   That of parameter `start`.
   */
  double *data;
  /*
   The first parameter.
   */
  size_t start;
  /*
   Parameters; the stage leaves all others alone.
   */
  size_t length;
} ConefieldGrads64;

/*
 Parameters or channels `start..end`.
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
   The smaller stage, a new one.
   */
  void *stage;
  /*
   Which of the old parameters it keeps, in its order; valid as long as it lives.
   */
  const struct ConefieldRange *params;
  /*
   Ranges in `params`.
   */
  size_t params_count;
  /*
   Which channels remain on the other side of the stage; valid as long as it lives.
   */
  const size_t *channels;
  /*
   Channels in `channels`.
   */
  size_t channels_count;
} ConefieldReduced;

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
   Entry into and exit from the reconstruction box; equal where the ray misses it.
   */
  float inside[2];
  /*
   Beginning and end of the published sampling range (near, far).
   */
  float published[2];
  /*
   Cube sides a millimetre.
   */
  float per_mm;
} ConefieldRay;

/*
 Functions of an encoder, a normalizer, a field or a line field. `stage` is what `create` made.
 */
typedef struct ConefieldMap {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Widths and counts; always the same for one stage.
   */
  ConefieldStatus (*info)(const void *stage, struct ConefieldInfo *info);
  /*
   Block `index` of the parameters. NULL if there are none.
   */
  ConefieldStatus (*parameter)(const void *stage, size_t index, struct ConefieldParameter *parameter);
  /*
   Fills all parameters, repeatable by `seed`. NULL if there are none.
   */
  ConefieldStatus (*init)(const void *stage,
                          uint64_t seed,
                          float *params,
                          size_t length,
                          struct ConefieldText *error);
  /*
   Overwrites `y` with f(x; params), and `tape` with what backward needs.
   */
  ConefieldStatus (*forward)(const void *stage,
                             const float *params,
                             struct ConefieldTile x,
                             struct ConefieldTileMut y,
                             struct ConefieldTileMut tape,
                             struct ConefieldText *error);
  /*
   Given `dy` = ∂L/∂y, adds ∂L/∂params to `grads` and, unless its data is NULL, overwrites `dx` with ∂L/∂x. `tape` is
   as forward left it and may be used as scratch; of a stage with scattered gradients it has no channels. The order
   in which one parameter's gradient is summed must not depend on the range in `grads`.
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
   `forward` in double precision, by which gradients are checked; NULL if there is none.
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
   Range `index` of the parameters that a worker may own; ranges are disjoint, ascending and cover all. NULL: one range.
   */
  ConefieldStatus (*partition)(const void *stage, size_t index, struct ConefieldRange *range);
  /*
   Makes of an encoder the one that computes only the outputs `keep` (`side` is [`CONEFIELD_OUTPUTS`]), of a normalizer or
   a field the one without the inputs that are not in `keep` ([`CONEFIELD_INPUTS`]); `keep` ascends. NULL: it cannot, and masks that need it are refused.
   */
  ConefieldStatus (*reduce)(const void *stage,
                            uint32_t side,
                            const size_t *keep,
                            size_t keep_count,
                            struct ConefieldReduced *reduced,
                            struct ConefieldText *error);
  /*
   WGSL of the same formula: functions `stage_forward` and `stage_backward` of a row, as docs/guide/writing-stages.md says. NULL:
   it runs on the CPU alone.
   */
  ConefieldStatus (*wgsl)(const void *stage, struct ConefieldText *source);
  /*
   How many passes `forward` goes in, each over a table of its own; always the same for one stage. A host with many
   tiles sends all of them through one pass before the next, while its table is in the cache. NULL: one.
   */
  size_t (*passes)(const void *stage);
  /*
   Pass `pass` of `forward`, counted from 0; all in order leave the same bits as `forward`. What other passes write
   stays. NULL where `passes` is.
   */
  ConefieldStatus (*forward_pass)(const void *stage,
                                  size_t pass,
                                  const float *params,
                                  struct ConefieldTile x,
                                  struct ConefieldTileMut y,
                                  struct ConefieldTileMut tape,
                                  struct ConefieldText *error);
  /*
   `forward` on parameters of 16 bits in `format`, one of [`CONEFIELD_F16`] and [`CONEFIELD_BF16`]: what `forward` makes
   of the same values. A host asks for it where a spec has tables in halves. NULL if there is none.
   */
  ConefieldStatus (*forward_halves)(const void *stage,
                                    uint32_t format,
                                    const uint16_t *params,
                                    struct ConefieldTile x,
                                    struct ConefieldTileMut y,
                                    struct ConefieldTileMut tape,
                                    struct ConefieldText *error);
  /*
   `forward_pass` on parameters of 16 bits, as `forward_halves`. NULL where `forward_pass` or `forward_halves` is.
   */
  ConefieldStatus (*forward_pass_halves)(const void *stage,
                                         uint32_t format,
                                         size_t pass,
                                         const uint16_t *params,
                                         struct ConefieldTile x,
                                         struct ConefieldTileMut y,
                                         struct ConefieldTileMut tape,
                                         struct ConefieldText *error);
  /*
   `backward` on parameters of 16 bits, as `forward_halves`. Gradients are floats. NULL where `forward_halves` is.
   */
  ConefieldStatus (*backward_halves)(const void *stage,
                                     uint32_t format,
                                     const uint16_t *params,
                                     struct ConefieldTile x,
                                     struct ConefieldTileMut tape,
                                     struct ConefieldTile dy,
                                     struct ConefieldGrads grads,
                                     struct ConefieldTileMut dx,
                                     struct ConefieldText *error);
  /*
   Of an encoder: writes for each of its `count` channels how many cells along the unit cube's side the channel
   resolves, a finite number above 0. Projectors count in the finest cell, and channels finer than the data can be left
   out. Returns [`CONEFIELD_UNSUPPORTED`] where that is not known. NULL: it is not known.
   */
  ConefieldStatus (*resolutions)(const void *stage,
                                 double *cells,
                                 size_t count,
                                 struct ConefieldText *error);
  /*
   Of a line field, since 2.2: overwrites `out` with the line integrals of `count` rays, in cube sides. A ray that is not
   inside has 0. NULL elsewhere.
   */
  ConefieldStatus (*project)(const void *stage,
                             const float *params,
                             const struct ConefieldRay *rays,
                             size_t count,
                             float *out,
                             struct ConefieldText *error);
  /*
   The adjoint of `project`: given `dlines` = ∂L/∂out, adds ∂L/∂params to `grads`. The order in which one parameter's
   gradient is summed must not depend on the range in `grads`. NULL where `project` is.
   */
  ConefieldStatus (*backproject)(const void *stage,
                                 const float *params,
                                 const struct ConefieldRay *rays,
                                 size_t count,
                                 const float *dlines,
                                 struct ConefieldGrads grads,
                                 struct ConefieldText *error);
  /*
   `project` in double precision, by which gradients are checked. Needed of a line field.
   */
  ConefieldStatus (*project_f64)(const void *stage,
                                 const double *params,
                                 const struct ConefieldRay *rays,
                                 size_t count,
                                 double *out,
                                 struct ConefieldText *error);
  /*
   `backproject` in double precision. Needed of a line field.
   */
  ConefieldStatus (*backproject_f64)(const void *stage,
                                     const double *params,
                                     const struct ConefieldRay *rays,
                                     size_t count,
                                     const double *dlines,
                                     struct ConefieldGrads64 grads,
                                     struct ConefieldText *error);
} ConefieldMap;

/*
 Lengths of a scene that a projector's settings may count in.
 */
typedef struct ConefieldLengths {
  /*
   The shortest side of a voxel, mm.
   */
  double voxel_mm;
  /*
   The side of the encoder's finest cell, mm; 0 where the encoder does not say how fine it is.
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
   Samples that `sample` writes at most for `ray`; 0 where it sees nothing of the scene.
   */
  size_t (*max_samples)(const void *stage, const struct ConefieldRay *ray);
  /*
   Writes the samples of `ray`: `x, y, z` in the unit cube to `points`, the length that each stands for, in cube sides,
   to `weights`, and how many they are (at most `capacity`) to `count`. `seed` decides random positions; NULL
   (rendering) means that none are random.
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
   The line integral of `count` attenuations. NULL: their sum, each times its weight.
   */
  double (*integrate)(const void *stage, const float *weights, const double *mu, size_t count);
  /*
   The exact adjoint of `integrate`: overwrites `dmu` with its derivatives times `dline`. NULL as `integrate`.
   */
  void (*adjoint)(const void *stage, const float *weights, double dline, double *dmu, size_t count);
  /*
   Makes the projector for a scene with these lengths, a new one, and sets `fitted` to it. A projector whose settings do
   not count in them leaves `fitted` as it is. NULL: its settings do not.
   */
  ConefieldStatus (*fitted)(const void *stage,
                            const struct ConefieldLengths *lengths,
                            void **fitted,
                            struct ConefieldText *error);
  /*
   WGSL of `sample`, of a projector that integrates as one without `integrate` does: a function `stage_sample`, as
   docs/guide/writing-stages.md says. NULL: it runs on the CPU alone.
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
   How many these are.
   */
  size_t length;
} ConefieldTensor;

/*
 Functions of an initializer. What is optional may be NULL.
 */
typedef struct ConefieldInitializer {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Fills what it fills of `params`, which every stage's own scheme has filled before, and sets the entry of `filled` to
   1 for every block that it filled.
   */
  ConefieldStatus (*apply)(const void *stage,
                           const struct ConefieldBlock *blocks,
                           size_t block_count,
                           float *params,
                           size_t length,
                           uint8_t *filled,
                           struct ConefieldText *error);
  /*
   Optional, since 2.1. Refuses parameters that it does not fit, before a run begins.
   */
  ConefieldStatus (*check)(const void *stage,
                           const struct ConefieldBlock *blocks,
                           size_t block_count,
                           struct ConefieldText *error);
  /*
   Optional, since 2.1. The weights file that the settings name; [`CONEFIELD_UNSUPPORTED`] where they name none. The host
   reads it and goes on with the stage that `with_weights` makes of it.
   */
  ConefieldStatus (*weights)(const void *stage, struct ConefieldStr *path);
  /*
   Since 2.1, needed beside `weights`. Makes a stage that has these weights. They live for the time of the call.
   */
  ConefieldStatus (*with_weights)(const void *stage,
                                  const struct ConefieldTensor *tensors,
                                  size_t count,
                                  void **out,
                                  struct ConefieldText *error);
  /*
   Optional, since 2.1. The file of a known volume that the field learns in `steps` steps once weights are filled;
   [`CONEFIELD_UNSUPPORTED`] where there is none.
   */
  ConefieldStatus (*volume)(const void *stage, struct ConefieldStr *path, uint64_t *steps);
} ConefieldInitializer;

/*
 The noise of a scan, in the scale that stages see: a line integral `p` has the variance `sigma² · exp(growth · p)`.
 */
typedef struct ConefieldNoise {
  /*
   Standard deviation where nothing is in the way.
   */
  double sigma;
  /*
   How the variance grows with the line integral, 0 or more.
   */
  double growth;
  /*
   Measured line integrals, drawn as training draws them.
   */
  const double *measured;
  /*
   How many.
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
   Compares `count` predicted values with the measured ones: the loss of each pair to `loss`, its derivative by the
   predicted value to `slope`. A loss is 0 where both agree, never negative, and NaN where a value is NaN.
   */
  ConefieldStatus (*at)(const void *stage,
                        const double *predicted,
                        const double *measured,
                        size_t count,
                        double *loss,
                        double *slope,
                        struct ConefieldText *error);
  /*
   1 if it learns from the scan: training then uses what `fitted` makes. NULL: it does not.
   */
  uint32_t (*needs_scan)(const void *stage);
  /*
   Makes the loss for a scan with this noise, a new one, and sets `fitted` to it; one that learns nothing leaves `fitted`
   as it is. NULL where `needs_scan` is.
   */
  ConefieldStatus (*fitted)(const void *stage,
                            const struct ConefieldNoise *noise,
                            void **fitted,
                            struct ConefieldText *error);
  /*
   WGSL of `at`: a function `stage_at`, as docs/guide/writing-stages.md says. NULL: it runs on the CPU alone.
   */
  ConefieldStatus (*wgsl)(const void *stage, struct ConefieldText *source);
} ConefieldLoss;

/*
 Where a prior looks, and how much it counts.
 */
typedef struct ConefieldBlocks {
  /*
   Points along a block's edge, 2 to 32.
   */
  size_t edge;
  /*
   Blocks a step.
   */
  size_t count;
  /*
   Distance of neighbouring points in voxels.
   */
  double spacing;
  /*
   Weight of the mean over all points against the mean loss of a ray.
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
   Its blocks; always the same for one stage.
   */
  ConefieldStatus (*blocks)(const void *stage, struct ConefieldBlocks *blocks);
  /*
   The penalty of one block, not negative, to `penalty`. `values` are those of its `count = edge³` points, z fastest.
   Adds `scale` times the derivative by each of them to `gradient`. A penalty is NaN where a value is NaN.
   */
  ConefieldStatus (*block)(const void *stage,
                           const double *values,
                           size_t count,
                           double scale,
                           double *gradient,
                           double *penalty,
                           struct ConefieldText *error);
  /*
   WGSL of `block`: a function `stage_at`, as docs/guide/writing-stages.md says. NULL: it runs on the CPU alone.
   */
  ConefieldStatus (*wgsl)(const void *stage, struct ConefieldText *source);
} ConefieldPrior;

/*
 A grid of voxels or of coefficients. Numbers on it stand x by x, then y by y, z fastest.
 */
typedef struct ConefieldGrid {
  /*
   How many along x, y and z.
   */
  size_t shape[3];
  /*
   Distances of neighbours, mm.
   */
  double spacing[3];
  /*
   The middle of the grid, mm.
   */
  double center[3];
} ConefieldGrid;

/*
 Named numbers that a penalty keeps from call to call.
 */
typedef struct ConefieldState {
  /*
   Their name, such as `dual`; valid as long as the penalty lives.
   */
  struct ConefieldStr name;
  /*
   The first of them.
   */
  float *data;
  /*
   How many.
   */
  size_t length;
} ConefieldState;

/*
 Functions of a regularizer: a convex penalty R of coefficients, for any grid. What `on` makes is a stage of its own, which
 `destroy` frees; `value`, `prox` and `state` get it.
 */
typedef struct ConefieldRegularizer {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Bytes that the penalty on `grid` holds. NULL: next to none.
   */
  uint64_t (*bytes)(const void *stage, const struct ConefieldGrid *grid);
  /*
   Makes the penalty on `grid`.
   */
  ConefieldStatus (*on)(const void *stage,
                        const struct ConefieldGrid *grid,
                        void **penalty,
                        struct ConefieldText *error);
  /*
   The weight λ, 0 or more, for attenuation in 1/mm and lengths in mm. `noise(context, k)` measures k times what the scan's
   noise comes to in the gradient of the data term; it takes a back-projection.
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
   Overwrites `u` with the coefficients ≥ 0 that have the least `½‖u − v‖² + tau·R(u)`, or comes nearer to them with each
   call for the same `v`.
   */
  ConefieldStatus (*prox)(void *penalty,
                          const float *v,
                          size_t count,
                          float tau,
                          float *u,
                          struct ConefieldText *error);
  /*
   Entry `index` of what the next `prox` starts from, which goes into checkpoints; [`CONEFIELD_UNSUPPORTED`] past the last.
   NULL: every call starts afresh.
   */
  ConefieldStatus (*state)(void *penalty, size_t index, struct ConefieldState *state);
  /*
   Fits the penalty to the coefficients `x`, before each pass over the scan. What it leaves follows from `x` alone, and is no
   part of `state`. Writes the new R(x); returns [`CONEFIELD_UNSUPPORTED`] where the penalty stays as it is. NULL: it always does.
   */
  ConefieldStatus (*adapt)(void *penalty,
                           const float *x,
                           size_t count,
                           double *value,
                           struct ConefieldText *error);
} ConefieldRegularizer;

/*
 Functions of a data term `Σ φ(r)` of residuals `r = measured − predicted`. What `of` makes of a scan is a stage of its own,
 which `destroy` frees; all but `bytes` and `of` get it. They are asked for an image at a time: `count` pixels of the view
 `view`, whose line integrals `measured` were found, row by row.
 */
typedef struct ConefieldDataTerm {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Bytes that it holds for a scan of `shape`: views, rows, columns; and those that `of` takes for a moment. NULL: next to
   none.
   */
  void (*bytes)(const void *stage, const size_t *shape, uint64_t *held, uint64_t *brief);
  /*
   Makes the data term of the line integrals `measured`, which are only looked at.
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
   Multiplies each value by the standard deviation that noise gives φ', in units of `noise`.
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
   Where the coefficients stand.
   */
  struct ConefieldGrid coefficients;
  /*
   Bytes that either direction takes while it works.
   */
  uint64_t scratch;
  /*
   1 if coefficients are the volume's values where they stand, on a grid that fills the same box.
   */
  uint32_t samples;
  /*
   1 if it works in double precision too.
   */
  uint32_t double_precision;
} ConefieldExpansion;

/*
 Functions of a basis: a matrix B from coefficients to voxels. Its entries are not negative, unless coefficients are samples.
 What `on` makes is a stage of its own, which `destroy` frees; all others get it.
 */
typedef struct ConefieldBasis {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   Makes the basis for the voxels of a grid. The number of coefficients follows from the grid's shape alone.
   */
  ConefieldStatus (*on)(const void *stage,
                        const struct ConefieldGrid *voxels,
                        void **expansion,
                        struct ConefieldText *error);
  /*
   What it is like there; always the same.
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
   `expand` in double precision, by which it is checked. NULL: there is none.
   */
  ConefieldStatus (*expand_f64)(const void *expansion,
                                const double *coefficients,
                                double *voxels,
                                struct ConefieldText *error);
  /*
   `adjoint` in double precision. NULL where `expand_f64` is.
   */
  ConefieldStatus (*adjoint_f64)(const void *expansion,
                                 const double *voxels,
                                 double *coefficients,
                                 struct ConefieldText *error);
} ConefieldBasis;

/*
 A stage type that a plugin brings.
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
   One line for people.
   */
  struct ConefieldStr doc;
  /*
   JSON Schema of its settings: an object whose `properties` have a `default` each, or are `required`. Its `examples`,
   if any, are settings that `conefield plugins check` tries.
   */
  struct ConefieldStr schema;
  /*
   Handed to `create`.
   */
  const void *context;
  /*
   Makes a stage from `settings`: one JSON object that fits the schema, with every default written. `width` is the
   number of channels that go in; 3 for an encoder, 0 where there are none. Returns [`CONEFIELD_INVALID`] and a text
   such as `bands: found 0, expected at least 1` for settings that make no stage.
   */
  ConefieldStatus (*create)(const void *context,
                            struct ConefieldStr settings,
                            size_t width,
                            void **stage,
                            struct ConefieldText *error);
  /*
   Frees what `create` or another function of the stage made: every stage that was handed over, once.
   */
  void (*destroy)(void *stage);
  /*
   One line on a stage, such as `10 levels x 2`.
   */
  ConefieldStatus (*describe)(const void *stage, struct ConefieldText *text);
  /*
   Of an encoder, a normalizer, a field or a line field; otherwise NULL.
   */
  const struct ConefieldMap *map;
  /*
   Of a projector; otherwise NULL.
   */
  const struct ConefieldProjector *projector;
  /*
   Of an initializer; otherwise NULL.
   */
  const struct ConefieldInitializer *initializer;
  /*
   Of a loss; otherwise NULL.
   */
  const struct ConefieldLoss *loss;
  /*
   Of a prior; otherwise NULL.
   */
  const struct ConefieldPrior *prior;
  /*
   Of a regularizer; otherwise NULL. Since 2.2, as the rest.
   */
  const struct ConefieldRegularizer *regularizer;
  /*
   Of a data term; otherwise NULL.
   */
  const struct ConefieldDataTerm *data_term;
  /*
   Of a basis; otherwise NULL.
   */
  const struct ConefieldBasis *basis;
} ConefieldStage;

/*
 What a plugin is and brings.
 */
typedef struct ConefieldPlugin {
  /*
   Bytes of this table.
   */
  size_t size;
  /*
   [`CONEFIELD_ABI_MAJOR`] as the plugin was built with.
   */
  uint32_t abi_major;
  /*
   [`CONEFIELD_ABI_MINOR`] as the plugin was built with.
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
   Its stage types, one after the other.
   */
  const struct ConefieldStage *stages;
  /*
   How many.
   */
  size_t stage_count;
  /*
   Bytes from one to the next.
   */
  size_t stage_size;
} ConefieldPlugin;

/*
 All is well.
 */
#define CONEFIELD_OK 0

/*
 What was handed over, such as settings, cannot be used; the error text says why.
 */
#define CONEFIELD_INVALID 1

/*
 It could be asked for, but this stage cannot do it.
 */
#define CONEFIELD_UNSUPPORTED 2

/*
 It went wrong.
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
