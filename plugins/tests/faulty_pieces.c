/* A regularizer, a data term and a basis, one of them with one fault, selected by -DFAULT=…, which the host
 * or the conformance kit must detect. Without a fault they are valid: half the squares of coefficients, half the squares of
 * residuals, and the voxels themselves. */
#include "faulty.h"

enum Fault {
    NONE, R_NO_PROX, R_NEGATIVE, R_NOT_A_NUMBER, R_PAST, R_BELOW, R_FAILS, R_NO_GRID, R_ITSELF, R_TWIN_STATE,
    R_WEIGHT, R_HALVED, R_FORGETS, R_LATER, D_NO_OF, D_NEGATIVE, D_NOT_A_NUMBER, D_PAST, D_NOISE, D_NO_SCAN, D_STEEP,
    D_LOW_BOUND, D_LATER, B_NO_COEFFICIENTS, B_PAST, B_UNWRITTEN, B_FAILS, B_LONG_ADJOINT, B_LATER,
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

PLUGIN(STAGE(CONEFIELD_REGULARIZER, "for tests", .regularizer = &REGULARIZER),
       STAGE(CONEFIELD_DATA_TERM, "for tests", .data_term = &DATA_TERM),
       STAGE(CONEFIELD_BASIS, "for tests", .basis = &BASIS))
