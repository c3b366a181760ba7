// The functions of all kinds of stages, in the order of the C tables. The tables, the C header and the host's checks
// are made from this file.
tables! {
/// Functions of an encoder, normalizer or field. `stage` is the result of `create`.
ConefieldMap {
    /// Widths and counts; constant for a stage.
    required info(stage: *const c_void, info: *mut ConefieldInfo) -> ConefieldStatus;
    /// Block `index` of the parameters. NULL if there are none.
    optional parameter(stage: *const c_void, index: usize, parameter: *mut ConefieldParameter) -> ConefieldStatus;
    /// Initializes all parameters, reproducible by `seed`. NULL if there are none.
    optional init(stage: *const c_void, seed: u64, params: *mut f32, length: usize,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// Overwrites `y` with f(x; params), and `tape` with the data for backward.
    required forward(stage: *const c_void, params: *const f32, x: ConefieldTile, y: ConefieldTileMut,
        tape: ConefieldTileMut, error: *mut ConefieldText) -> ConefieldStatus;
    /// Given `dy` = ∂L/∂y, adds ∂L/∂params to `grads` and, unless its data is NULL, overwrites `dx` with ∂L/∂x. `tape`
    /// holds the values of forward and may be used as scratch; it has no channels for a stage with scattered gradients.
    /// The summation order of a parameter's gradient must not depend on the range in `grads`.
    required backward(stage: *const c_void, params: *const f32, x: ConefieldTile, tape: ConefieldTileMut,
        dy: ConefieldTile, grads: ConefieldGrads, dx: ConefieldTileMut, error: *mut ConefieldText) -> ConefieldStatus;
    /// `forward` in double precision, for checking gradients; NULL if there is none.
    optional forward_f64(stage: *const c_void, params: *const f64, x: ConefieldTile64, y: ConefieldTileMut64,
        tape: ConefieldTileMut64, error: *mut ConefieldText) -> ConefieldStatus;
    /// `backward` in double precision; NULL if there is none.
    optional backward_f64(stage: *const c_void, params: *const f64, x: ConefieldTile64, tape: ConefieldTileMut64,
        dy: ConefieldTile64, grads: ConefieldGrads64, dx: ConefieldTileMut64,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// Range `index` of the parameters that a worker may own; ranges are disjoint, ascending and cover all parameters.
    /// NULL: one range.
    optional partition(stage: *const c_void, index: usize, range: *mut ConefieldRange) -> ConefieldStatus;
    /// Creates a smaller stage. With `side` [`CONEFIELD_OUTPUTS`], an encoder that computes only the outputs `keep`;
    /// with [`CONEFIELD_INPUTS`], a normalizer or field with only the inputs `keep`. `keep` is ascending. NULL: not
    /// supported; masks that need it are refused.
    optional reduce(stage: *const c_void, side: u32, keep: *const usize, keep_count: usize,
        reduced: *mut ConefieldReduced, error: *mut ConefieldText) -> ConefieldStatus;
    /// WGSL of the same formula: functions `stage_forward` and `stage_backward` of a row; see
    /// docs/guide/writing-stages.md. NULL: CPU only.
    optional wgsl(stage: *const c_void, source: *mut ConefieldText) -> ConefieldStatus;
    /// Number of passes of `forward`, each over a table of its own; constant for a stage. A host with many tiles runs
    /// one pass for all of them before the next, while its table is in the cache. NULL: one pass.
    optional passes(stage: *const c_void) -> usize;
    /// Pass `pass` of `forward`, from 0; all passes in order give the same bits as `forward`. A pass keeps the output
    /// of the other passes. NULL if `passes` is NULL.
    optional forward_pass(stage: *const c_void, pass: usize, params: *const f32, x: ConefieldTile,
        y: ConefieldTileMut, tape: ConefieldTileMut, error: *mut ConefieldText) -> ConefieldStatus;
    /// For an encoder: writes the resolution of each of its `count` channels in cells along the unit cube's side,
    /// finite numbers above 0. Projectors may count in the finest cell, and channels finer than the data can be left
    /// out. Returns [`CONEFIELD_UNSUPPORTED`] if unknown. NULL: unknown.
    optional resolutions(stage: *const c_void, cells: *mut f64, count: usize,
        error: *mut ConefieldText) -> ConefieldStatus;
}

/// Functions of a projector.
ConefieldProjector {
    /// Maximum number of samples that `sample` writes for `ray`; 0 if it misses the scene.
    required max_samples(stage: *const c_void, ray: *const ConefieldRay) -> usize;
    /// Writes the samples of `ray`: positions `x, y, z` in the unit cube to `points`, the length of each in cube sides
    /// to `weights`, and their number (at most `capacity`) to `count`. `seed` determines random positions; with NULL
    /// (rendering) none are random.
    required sample(stage: *const c_void, ray: *const ConefieldRay, seed: *const u64, points: *mut f32,
        weights: *mut f32, capacity: usize, count: *mut usize, error: *mut ConefieldText) -> ConefieldStatus;
    /// The line integral of `count` attenuations. NULL: their sum, weighted by the lengths.
    optional integrate(stage: *const c_void, weights: *const f32, mu: *const f64, count: usize) -> f64;
    /// The exact adjoint of `integrate`: overwrites `dmu` with its derivatives times `dline`. NULL if `integrate` is
    /// NULL.
    optional adjoint(stage: *const c_void, weights: *const f32, dline: f64, dmu: *mut f64, count: usize);
    /// Creates the projector for a scene with these lengths and sets `fitted` to it. A projector whose settings do not
    /// depend on them leaves `fitted` unchanged. NULL: the settings never depend on them.
    optional fitted(stage: *const c_void, lengths: *const ConefieldLengths, fitted: *mut *mut c_void,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// WGSL of `sample`, for a projector that integrates like one without `integrate`: a function `stage_sample`; see
    /// docs/guide/writing-stages.md. NULL: CPU only.
    optional wgsl(stage: *const c_void, source: *mut ConefieldText) -> ConefieldStatus;
}

/// Functions of an initializer. Optional functions may be NULL.
ConefieldInitializer {
    /// Initializes some of `params`, after every stage's own initialization, and sets the entry of each initialized
    /// block in `filled` to 1.
    required apply(stage: *const c_void, blocks: *const ConefieldBlock, block_count: usize, params: *mut f32,
        length: usize, filled: *mut u8, error: *mut ConefieldText) -> ConefieldStatus;
    /// Optional. Refuses parameters that do not fit, before a run begins.
    optional check(stage: *const c_void, blocks: *const ConefieldBlock, block_count: usize,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// Optional. The weights file named by the settings; [`CONEFIELD_UNSUPPORTED`] if there is none. The
    /// host reads the file and continues with the stage that `with_weights` creates.
    optional weights(stage: *const c_void, path: *mut ConefieldStr) -> ConefieldStatus;
    /// Required together with `weights`. Creates a stage with these weights, which are valid during the
    /// call.
    optional with_weights(stage: *const c_void, tensors: *const ConefieldTensor, count: usize, out: *mut *mut c_void,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// Optional. The file of a known volume that the field learns in `steps` steps after weights are
    /// initialized; [`CONEFIELD_UNSUPPORTED`] if there is none.
    optional volume(stage: *const c_void, path: *mut ConefieldStr, steps: *mut u64) -> ConefieldStatus;
}

/// Functions of a loss.
ConefieldLoss {
    /// Compares `count` predicted values with measured ones: writes the loss of each pair to `loss`, and its derivative
    /// with respect to the predicted value to `slope`. A loss is 0 if both values agree, never negative, and NaN if a
    /// value is NaN.
    required at(stage: *const c_void, predicted: *const f64, measured: *const f64, count: usize, loss: *mut f64,
        slope: *mut f64, error: *mut ConefieldText) -> ConefieldStatus;
    /// 1 if the loss is fitted to the scan: training then uses the result of `fitted`. NULL: it is not.
    optional needs_scan(stage: *const c_void) -> u32;
    /// Creates the loss for a scan with this noise and sets `fitted` to it; a loss that does not depend on the noise
    /// leaves `fitted` unchanged. NULL if `needs_scan` is NULL.
    optional fitted(stage: *const c_void, noise: *const ConefieldNoise, fitted: *mut *mut c_void,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// WGSL of `at`: a function `stage_at`; see docs/guide/writing-stages.md. NULL: CPU only.
    optional wgsl(stage: *const c_void, source: *mut ConefieldText) -> ConefieldStatus;
}

/// Functions of a prior.
ConefieldPrior {
    /// Its blocks; constant for a stage.
    required blocks(stage: *const c_void, blocks: *mut ConefieldBlocks) -> ConefieldStatus;
    /// Writes the non-negative penalty of one block to `penalty`. `values` are those of its `count = edge³` points, z
    /// fastest. Adds `scale` times the derivative with respect to each of them to `gradient`. The penalty is NaN if a
    /// value is NaN.
    required block(stage: *const c_void, values: *const f64, count: usize, scale: f64, gradient: *mut f64,
        penalty: *mut f64, error: *mut ConefieldText) -> ConefieldStatus;
    /// WGSL of `block`: a function `stage_at`; see docs/guide/writing-stages.md. NULL: CPU only.
    optional wgsl(stage: *const c_void, source: *mut ConefieldText) -> ConefieldStatus;
}

/// Functions of a regularizer: a convex penalty R of coefficients, for any grid. The result of `on` is a stage of its
/// own, which `destroy` frees; it is the argument of `value`, `prox`, `adapt` and `state`.
ConefieldRegularizer {
    /// Bytes held by the penalty on `grid`. NULL: negligible.
    optional bytes(stage: *const c_void, grid: *const ConefieldGrid) -> u64;
    /// Creates the penalty on `grid`.
    required on(stage: *const c_void, grid: *const ConefieldGrid, penalty: *mut *mut c_void,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// The weight λ, 0 or more, for attenuation in 1/mm and lengths in mm. `noise(context, k)` returns k times the root
    /// mean square of the scan's noise in the gradient of the data term; it takes a back-projection.
    required weight(stage: *const c_void, grid: *const ConefieldGrid,
        noise: Option<unsafe extern "C" fn(context: *mut c_void, k: f64) -> f64>, context: *mut c_void,
        weight: *mut f64, error: *mut ConefieldText) -> ConefieldStatus;
    /// R(x), 0 or more, of the `count` coefficients of the grid.
    required value(penalty: *const c_void, x: *const f32, count: usize, value: *mut f64,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// Overwrites `u` with the coefficients ≥ 0 that minimize `½‖u − v‖² + tau·R(u)`, or approaches them with each call
    /// for the same `v`.
    required prox(penalty: *mut c_void, v: *const f32, count: usize, tau: f32, u: *mut f32,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// Entry `index` of the state from which the next `prox` starts, for checkpoints; [`CONEFIELD_UNSUPPORTED`] past
    /// the last. NULL: no state.
    optional state(penalty: *mut c_void, index: usize, state: *mut ConefieldState) -> ConefieldStatus;
    /// Adapts the penalty to the coefficients `x`, before each pass over the scan. The result depends on `x` only and
    /// is not part of `state`. Writes the new R(x); returns [`CONEFIELD_UNSUPPORTED`] if the penalty does not change.
    /// NULL: it never changes.
    optional adapt(penalty: *mut c_void, x: *const f32, count: usize, value: *mut f64,
        error: *mut ConefieldText) -> ConefieldStatus;
}

/// Functions of a data term `Σ φ(r)` of residuals `r = measured − predicted`. The result of `of` is a stage of its own,
/// which `destroy` frees; it is the argument of all functions except `bytes` and `of`. Each call is for one image:
/// `count` pixels of view `view`, with its line integrals `measured`, row by row.
ConefieldDataTerm {
    /// Bytes held for a scan of `shape` (views, rows, columns), and temporary bytes of `of`. NULL: negligible.
    optional bytes(stage: *const c_void, shape: *const usize, held: *mut u64, brief: *mut u64);
    /// Creates the data term for the line integrals `measured`, which it does not keep.
    required of(stage: *const c_void, measured: *const f32, shape: *const usize, misfit: *mut *mut c_void,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// Standard deviation of the noise of line integrals near 0.
    required noise(misfit: *const c_void) -> f64;
    /// Overwrites residuals with the derivatives φ'(r), and `sum` with the sum of all φ(r).
    required differentiate(misfit: *const c_void, view: usize, measured: *const f32, count: usize,
        residuals: *mut f32, sum: *mut f64, error: *mut ConefieldText) -> ConefieldStatus;
    /// Multiplies each value by an upper bound of φ''.
    required curve(misfit: *const c_void, view: usize, measured: *const f32, count: usize, values: *mut f32,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// Multiplies each value by the standard deviation of φ' under noise, in units of `noise`.
    required spread(misfit: *const c_void, view: usize, measured: *const f32, count: usize, values: *mut f32,
        error: *mut ConefieldText) -> ConefieldStatus;
}

/// Functions of a basis: a matrix B from coefficients to voxels. Its entries are non-negative, unless coefficients are
/// samples. The result of `on` is a stage of its own, which `destroy` frees; it is the argument of all other functions.
ConefieldBasis {
    /// Creates the basis for the voxels of a grid. The number of coefficients depends on the grid's shape only.
    required on(stage: *const c_void, voxels: *const ConefieldGrid, expansion: *mut *mut c_void,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// Its properties on this grid; constant.
    required info(expansion: *const c_void, info: *mut ConefieldExpansion) -> ConefieldStatus;
    /// Overwrites `voxels` with `B·coefficients`.
    required expand(expansion: *const c_void, coefficients: *const f32, voxels: *mut f32,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// Overwrites `coefficients` with `Bᵀ·voxels`, the exact adjoint.
    required adjoint(expansion: *const c_void, voxels: *const f32, coefficients: *mut f32,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// `expand` in double precision, for checks. NULL: there is none.
    optional expand_f64(expansion: *const c_void, coefficients: *const f64, voxels: *mut f64,
        error: *mut ConefieldText) -> ConefieldStatus;
    /// `adjoint` in double precision. NULL if `expand_f64` is NULL.
    optional adjoint_f64(expansion: *const c_void, voxels: *const f64, coefficients: *mut f64,
        error: *mut ConefieldText) -> ConefieldStatus;
}
}
