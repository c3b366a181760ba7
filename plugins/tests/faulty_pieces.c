/* A regularizer, a data term, a basis and a line field, one of them with one fault, selected by -DFAULT=…, which the host
 * or the conformance kit must detect. Without a fault they are valid: half the squares of coefficients, half the squares of
 * residuals, the voxels themselves, and one blob in the middle of the cube. */
#include "faulty.h"

enum Fault {
    NONE, R_NO_PROX, R_NEGATIVE, R_NOT_A_NUMBER, R_PAST, R_BELOW, R_FAILS, R_NO_GRID, R_ITSELF, R_TWIN_STATE,
    R_WEIGHT, R_HALVED, R_FORGETS, R_LATER, D_NO_OF, D_NEGATIVE, D_NOT_A_NUMBER, D_PAST, D_NOISE, D_NO_SCAN, D_STEEP,
    D_LOW_BOUND, D_LATER, B_NO_COEFFICIENTS, B_PAST, B_UNWRITTEN, B_FAILS, B_LONG_ADJOINT, B_LATER, L_NO_LINES,
    L_PAST, L_MISSED, L_LONG_ADJOINT,
};

/* Calls of this process. */
static _Atomic size_t calls;

/* Whether the fault `later` occurs: after some calls. */
static int later(enum Fault fault) {
    return FAULT == fault && calls++ > 20;
}

/* Settings, a penalty, a misfit or an expansion: a grid, and the state of a penalty. */
struct Stage {
    struct ConefieldGrid grid;
    float state;
};

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    (void)stage;
    say(text, "for tests");
    return CONEFIELD_OK;
}

static ConefieldStatus on(const void *stage, const struct ConefieldGrid *grid, void **made, struct ConefieldText *error) {
    if (FAULT == R_NO_GRID) return fails(error, "no such grid");
    if (FAULT == R_ITSELF) {
        *made = (void *)stage;
        return CONEFIELD_OK;
    }
    if (make(made) != CONEFIELD_OK) return CONEFIELD_FAILED;
    ((struct Stage *)*made)->grid = *grid;
    return CONEFIELD_OK;
}

static size_t count(const void *stage) {
    const size_t *n = ((const struct Stage *)stage)->grid.shape;
    return n[0] * n[1] * n[2];
}

/* The regularizer. */

static ConefieldStatus weight(const void *stage, const struct ConefieldGrid *grid, double (*noise)(void *, double),
                              void *context, double *weight, struct ConefieldText *error) {
    (void)stage, (void)grid, (void)error;
    *weight = FAULT == R_WEIGHT ? NAN : noise(context, 1.0);
    return CONEFIELD_OK;
}

static ConefieldStatus value(const void *penalty, const float *x, size_t n, double *value, struct ConefieldText *error) {
    (void)penalty, (void)error;
    *value = 0;
    for (size_t i = 0; i < n; i++) *value += 0.5 * (double)x[i] * (double)x[i];
    if (FAULT == R_NEGATIVE) *value = -*value;
    return CONEFIELD_OK;
}

static ConefieldStatus prox(void *penalty, const float *v, size_t n, float tau, float *u, struct ConefieldText *error) {
    struct Stage *p = penalty;
    if (FAULT == R_FAILS || later(R_LATER)) return fails(error, "no more numbers");
    float by = FAULT == R_HALVED ? 1 + 0.5f * tau : 1 + tau;
    /* The first call is slightly wrong, and this is not part of the state. */
    if (FAULT == R_FORGETS && p->state == 0) by *= 1.01f;
    p->state = 1;
    for (size_t i = 0; i < n; i++) u[i] = v[i] > 0 || FAULT == R_BELOW ? v[i] / by : 0;
    if (FAULT == R_NOT_A_NUMBER) u[0] = NAN;
    if (FAULT == R_PAST) u[n] = 1;
    return CONEFIELD_OK;
}

static ConefieldStatus state(void *penalty, size_t index, struct ConefieldState *state) {
    static const struct ConefieldStr name = TEXT("calls");
    if (FAULT == R_FORGETS || index > (FAULT == R_TWIN_STATE)) return CONEFIELD_UNSUPPORTED;
    *state = (struct ConefieldState){.name = name, .data = &((struct Stage *)penalty)->state, .length = 1};
    return CONEFIELD_OK;
}

static uint64_t bytes(const void *stage, const struct ConefieldGrid *grid) {
    (void)stage, (void)grid;
    return sizeof(struct Stage);
}

static const struct ConefieldRegularizer REGULARIZER = {
    .size = sizeof REGULARIZER,
    .bytes = bytes,
    .on = on,
    .weight = weight,
    .value = value,
    .prox = FAULT == R_NO_PROX ? NULL : prox,
    .state = state,
};

/* The data term. */

static ConefieldStatus of(const void *stage, const float *measured, const size_t *shape, void **misfit,
                          struct ConefieldText *error) {
    (void)stage, (void)measured, (void)shape;
    if (FAULT == D_NO_SCAN) return fails(error, "no such scan");
    return make(misfit);
}

static double noise(const void *misfit) {
    (void)misfit;
    return FAULT == D_NOISE ? NAN : 0.03;
}

static ConefieldStatus differentiate(const void *misfit, size_t view, const float *measured, size_t n, float *residuals,
                                     double *sum, struct ConefieldText *error) {
    (void)misfit, (void)view, (void)measured;
    if (later(D_LATER)) return fails(error, "no more numbers");
    *sum = 0;
    for (size_t i = 0; i < n; i++) *sum += 0.5 * (double)residuals[i] * (double)residuals[i];
    for (size_t i = 0; FAULT == D_STEEP && i < n; i++) residuals[i] *= 1.1f;
    if (FAULT == D_NEGATIVE) *sum = -*sum;
    if (FAULT == D_NOT_A_NUMBER) residuals[0] = NAN;
    return CONEFIELD_OK;
}

static ConefieldStatus curve(const void *misfit, size_t view, const float *measured, size_t n, float *values,
                             struct ConefieldText *error) {
    (void)misfit, (void)view, (void)measured, (void)error;
    for (size_t i = 0; FAULT == D_LOW_BOUND && i < n; i++) values[i] *= 0.5f;
    if (FAULT == D_PAST) values[n] = 1;
    return CONEFIELD_OK;
}

static ConefieldStatus spread(const void *misfit, size_t view, const float *measured, size_t n, float *values,
                              struct ConefieldText *error) {
    (void)misfit, (void)view, (void)measured, (void)error;
    for (size_t i = 0; FAULT == D_LOW_BOUND && i < n; i++) values[i] *= 0.5f;
    return CONEFIELD_OK;
}

static const struct ConefieldDataTerm DATA_TERM = {
    .size = sizeof DATA_TERM,
    .of = FAULT == D_NO_OF ? NULL : of,
    .noise = noise,
    .differentiate = differentiate,
    .curve = curve,
    .spread = spread,
};

/* The basis. */

static ConefieldStatus expansion(const void *expansion, struct ConefieldExpansion *info) {
    *info = (struct ConefieldExpansion){.coefficients = ((const struct Stage *)expansion)->grid};
    if (FAULT == B_NO_COEFFICIENTS) info->coefficients.shape[0] = 0;
    return CONEFIELD_OK;
}

static ConefieldStatus expand(const void *expansion, const float *coefficients, float *voxels, struct ConefieldText *error) {
    size_t n = count(expansion);
    if (FAULT == B_FAILS || later(B_LATER)) return fails(error, "no more numbers");
    for (size_t i = 0; i < n - (FAULT == B_UNWRITTEN); i++) voxels[i] = coefficients[i];
    if (FAULT == B_PAST) voxels[n] = 1;
    return CONEFIELD_OK;
}

static ConefieldStatus adjoint(const void *expansion, const float *voxels, float *coefficients, struct ConefieldText *error) {
    (void)error;
    for (size_t i = 0; i < count(expansion); i++) coefficients[i] = voxels[i] * (FAULT == B_LONG_ADJOINT ? 1.01f : 1.0f);
    return CONEFIELD_OK;
}

static const struct ConefieldBasis BASIS = {
    .size = sizeof BASIS,
    .on = on,
    .info = expansion,
    .expand = expand,
    .adjoint = adjoint,
};

/* The line field: a height times a bell of one over 1 + 16 squared distances. */

static ConefieldStatus info(const void *stage, struct ConefieldInfo *out) {
    (void)stage;
    *out = (struct ConefieldInfo){.input = 3, .output = 1, .params = 1, .blocks = 1, .macs = 8, .double_precision = 1,
                                  .scope = CONEFIELD_SCOPE_ROW, .grads = CONEFIELD_GRADS_DENSE};
    return CONEFIELD_OK;
}

static ConefieldStatus parameter(const void *stage, size_t index, struct ConefieldParameter *out) {
    static const struct ConefieldStr name = TEXT("height");
    static const size_t one = 1;
    (void)stage, (void)index;
    *out = (struct ConefieldParameter){.name = name, .shape = &one, .dimensions = 1};
    return CONEFIELD_OK;
}

static ConefieldStatus init(const void *stage, uint64_t seed, float *params, size_t length, struct ConefieldText *error) {
    (void)stage, (void)seed, (void)error;
    for (size_t i = 0; i < length; i++) params[i] = 0.5f;
    return CONEFIELD_OK;
}

/* The line integral of the bell along the part of a ray that is inside. */
static double line(const struct ConefieldRay *ray) {
    double ahead = 0, square = 0;
    for (size_t k = 0; k < 3; k++) {
        double way = 0.5 - (double)ray->origin[k];
        ahead += way * (double)ray->direction[k];
        square += way * way;
    }
    double wide = sqrt(1.0 / 16 + square - ahead * ahead);
    return (atan(((double)ray->inside[1] - ahead) / wide) - atan(((double)ray->inside[0] - ahead) / wide)) / (16 * wide);
}

#define PRECISION(real, Tile, TileMut, Grads, forward, backward, project, backproject) \
    static ConefieldStatus forward(const void *stage, const real *params, struct Tile x, struct TileMut y, \
                                   struct TileMut tape, struct ConefieldText *error) { \
        (void)stage, (void)tape, (void)error; \
        for (size_t r = 0; r < x.rows; r++) { \
            double square = 0; \
            for (size_t k = 0; k < 3; k++) square += pow(x.data[k * x.stride + r] - 0.5, 2); \
            y.data[r] = (real)(params[0] / (1 + 16 * square)); \
        } \
        return CONEFIELD_OK; \
    } \
    static ConefieldStatus backward(const void *stage, const real *params, struct Tile x, struct TileMut tape, \
                                    struct Tile dy, struct Grads grads, struct TileMut dx, struct ConefieldText *error) { \
        (void)stage, (void)tape, (void)error; \
        for (size_t r = 0; r < x.rows; r++) { \
            double square = 0; \
            for (size_t k = 0; k < 3; k++) square += pow(x.data[k * x.stride + r] - 0.5, 2); \
            double bell = 1 / (1 + 16 * square); \
            if (grads.start == 0 && grads.length > 0) grads.data[0] += (real)(dy.data[r] * bell); \
            for (size_t k = 0; dx.data != NULL && k < 3; k++) \
                dx.data[k * dx.stride + r] = \
                    (real)(-32 * dy.data[r] * params[0] * bell * bell * (x.data[k * x.stride + r] - 0.5)); \
        } \
        return CONEFIELD_OK; \
    } \
    static ConefieldStatus project(const void *stage, const real *params, const struct ConefieldRay *rays, size_t n, \
                                   real *out, struct ConefieldText *error) { \
        (void)stage, (void)error; \
        for (size_t r = 0; r < n; r++) out[r] = rays[r].inside[1] > rays[r].inside[0] ? (real)(params[0] * line(&rays[r])) : 0; \
        for (size_t r = 0; FAULT == L_MISSED && r < n; r++) out[r] += (real)0.1; \
        if (FAULT == L_PAST) out[n] = 1; \
        return CONEFIELD_OK; \
    } \
    static ConefieldStatus backproject(const void *stage, const real *params, const struct ConefieldRay *rays, size_t n, \
                                       const real *dlines, struct Grads grads, struct ConefieldText *error) { \
        (void)stage, (void)params, (void)error; \
        if (grads.start > 0 || grads.length == 0) return CONEFIELD_OK; \
        for (size_t r = 0; r < n; r++) \
            if (rays[r].inside[1] > rays[r].inside[0]) \
                grads.data[0] += (real)(dlines[r] * line(&rays[r]) * (FAULT == L_LONG_ADJOINT ? 1.1 : 1.0)); \
        return CONEFIELD_OK; \
    }

PRECISION(float, ConefieldTile, ConefieldTileMut, ConefieldGrads, forward, backward, project, backproject)
PRECISION(double, ConefieldTile64, ConefieldTileMut64, ConefieldGrads64, forward_f64, backward_f64, project_f64,
          backproject_f64)

static const struct ConefieldMap MAP = {
    .size = sizeof MAP,
    .info = info,
    .parameter = parameter,
    .init = init,
    .forward = forward,
    .backward = backward,
    .forward_f64 = forward_f64,
    .backward_f64 = backward_f64,
    .project = FAULT == L_NO_LINES ? NULL : project,
    .backproject = backproject,
    .project_f64 = project_f64,
    .backproject_f64 = backproject_f64,
};

PLUGIN(STAGE(CONEFIELD_REGULARIZER, "for tests", .regularizer = &REGULARIZER),
       STAGE(CONEFIELD_DATA_TERM, "for tests", .data_term = &DATA_TERM),
       STAGE(CONEFIELD_BASIS, "for tests", .basis = &BASIS),
       STAGE(CONEFIELD_LINE_FIELD, "for tests", .map = &MAP))
