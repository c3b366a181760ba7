/* A regularizer for conefield in C: quadratic smoothness, half the squared differences of neighbouring coefficients. */
#include "conefield_helpers.h"

#define DOC "squared differences of neighbours"
#define SCHEMA \
    "{\"type\":\"object\",\"properties\":{" \
    "\"weight\":{\"type\":\"number\",\"minimum\":0,\"default\":100.0,\"description\":\"Times the noise, for differences of 1/mm.\"}," \
    "\"inner\":{\"type\":\"integer\",\"minimum\":1,\"maximum\":1000,\"default\":4,\"description\":\"Steps for each update.\"}}}"

/* Settings in a spec. */
struct Settings {
    double weight;
    size_t inner;
};

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    struct Settings s = {.weight = number(settings, "weight"), .inner = (size_t)number(settings, "inner")};
    return hand_over(&s, sizeof s, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, "squared differences of neighbours");
    return CONEFIELD_OK;
}

/* The penalty on one grid. */
struct Penalty {
    size_t shape[3], count, inner;
    /* Weight of a squared difference along each axis. */
    float strength[3];
    /* The result of the last call, from which the next one starts; then the gradient of the penalty. */
    float numbers[];
};

static uint64_t bytes(const void *stage, const struct ConefieldGrid *grid) {
    return sizeof(struct Penalty) + 2 * sizeof(float) * grid->shape[0] * grid->shape[1] * grid->shape[2];
}

static ConefieldStatus on(const void *stage, const struct ConefieldGrid *grid, void **penalty, struct ConefieldText *error) {
    struct Penalty *p = calloc(1, bytes(stage, grid));
    if (p == NULL) {
        say(error, "no memory");
        return CONEFIELD_FAILED;
    }
    const double *spacing = grid->spacing;
    double side = cbrt(spacing[0] * spacing[1] * spacing[2]);
    for (size_t k = 0; k < 3; k++) {
        p->shape[k] = grid->shape[k];
        p->strength[k] = (float)(side / spacing[k] * side / spacing[k]);
    }
    p->count = grid->shape[0] * grid->shape[1] * grid->shape[2];
    p->inner = ((const struct Settings *)stage)->inner;
    *penalty = p;
    return CONEFIELD_OK;
}

/* The weight, as a multiple of the scan's noise in the gradient of the data term. */
static ConefieldStatus weight(const void *stage, const struct ConefieldGrid *grid, double (*noise)(void *, double),
                              void *context, double *weight, struct ConefieldText *error) {
    *weight = noise(context, ((const struct Settings *)stage)->weight);
    return CONEFIELD_OK;
}

/* The penalty of `x`. Adds its gradient to `slope`, unless that is NULL. */
static double differences(const struct Penalty *p, const float *x, float *slope) {
    const size_t steps[] = {p->shape[1] * p->shape[2], p->shape[2], 1};
    double sum = 0;
    for (size_t axis = 0; axis < 3; axis++) {
        size_t step = steps[axis], n = p->shape[axis];
        for (size_t i = 0; i < p->count; i++) {
            if (i / step % n + 1 == n) continue;
            float d = p->strength[axis] * (x[i + step] - x[i]);
            sum += 0.5 * (double)d * (double)(x[i + step] - x[i]);
            if (slope == NULL) continue;
            slope[i + step] += d;
            slope[i] -= d;
        }
    }
    return sum;
}

static ConefieldStatus value(const void *penalty, const float *x, size_t count, double *value, struct ConefieldText *error) {
    *value = differences(penalty, x, NULL);
    return CONEFIELD_OK;
}

/* Takes some gradient steps towards the minimum of half the squared distance from `v` plus tau times the penalty. */
static ConefieldStatus prox(void *penalty, const float *v, size_t count, float tau, float *u, struct ConefieldText *error) {
    struct Penalty *p = penalty;
    float *at = p->numbers, *slope = p->numbers + count;
    float share = 1 / (1 + tau * 4 * (p->strength[0] + p->strength[1] + p->strength[2]));
    for (size_t k = 0; k < p->inner; k++) {
        memset(slope, 0, count * sizeof *slope);
        differences(p, at, slope);
        for (size_t i = 0; i < count; i++) {
            float next = (1 - share) * at[i] + share * (v[i] - tau * slope[i]);
            at[i] = next > 0 ? next : 0;
        }
    }
    memcpy(u, at, count * sizeof *u);
    return CONEFIELD_OK;
}

/* The state from which the next call of `prox` starts, for checkpoints. */
static ConefieldStatus state(void *penalty, size_t index, struct ConefieldState *state) {
    static const struct ConefieldStr name = TEXT("u");
    struct Penalty *p = penalty;
    if (index > 0) return CONEFIELD_UNSUPPORTED;
    *state = (struct ConefieldState){.name = name, .data = p->numbers, .length = p->count};
    return CONEFIELD_OK;
}

@plugin bytes on weight value prox state@
