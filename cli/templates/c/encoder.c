/* An encoder for conefield in C: points of the unit cube to features.
 *
 * This start has waves of doubling frequency along each axis, each with an amplitude that is learned:
 * y = a * sin(2^k * pi * x). `conefield plugins check` compares its gradients with finite differences.
 */
#include "conefield_helpers.h"

#define DOC "waves of doubling frequency with learned amplitudes"
#define SCHEMA \
    "{\"type\":\"object\",\"properties\":{\"bands\":{\"type\":\"integer\",\"minimum\":1,\"maximum\":16,\"default\":6," \
    "\"description\":\"Frequencies along each axis.\"}},\"examples\":[{\"bands\":1}]}"

typedef struct {
    size_t bands;
    size_t shape[2];
} Waves;

/* `width` is 3 for an encoder. */
static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    double bands = number(settings, "bands");
    if (!(bands >= 1 && bands <= 16)) {
        say(error, "bands: found %g, expected 1 to 16", bands);
        return CONEFIELD_INVALID;
    }
    Waves w = {.bands = (size_t)bands, .shape = {3, (size_t)bands}};
    return hand_over(&w, sizeof w, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, "%zu waves along each axis", ((const Waves *)stage)->bands);
    return CONEFIELD_OK;
}

static ConefieldStatus info(const void *stage, struct ConefieldInfo *out) {
    size_t n = 3 * ((const Waves *)stage)->bands;
    *out = (struct ConefieldInfo){.input = 3, .output = n, .params = n, .blocks = 1, .macs = 10 * n,
                                  .scope = CONEFIELD_SCOPE_ROW, .grads = CONEFIELD_GRADS_DENSE};
    return CONEFIELD_OK;
}

/* There is one block. */
static ConefieldStatus parameter(const void *stage, size_t index, struct ConefieldParameter *out) {
    *out = (struct ConefieldParameter){.name = TEXT("amplitude"), .shape = ((const Waves *)stage)->shape, .dimensions = 2};
    return CONEFIELD_OK;
}

static ConefieldStatus init(const void *stage, uint64_t seed, float *params, size_t length, struct ConefieldText *error) {
    for (size_t i = 0; i < length; i++) params[i] = 1.0f;
    return CONEFIELD_OK;
}

/* The angular frequency of channel `c`. */
static float frequency(const Waves *w, size_t c) {
    return 3.14159265358979f * (float)(1u << (c % w->bands));
}

static ConefieldStatus forward(const void *stage, const float *params, struct ConefieldTile x,
                               struct ConefieldTileMut y, struct ConefieldTileMut tape, struct ConefieldText *error) {
    const Waves *w = stage;
    for (size_t c = 0; c < 3 * w->bands; c++) {
        const float *from = x.data + (c / w->bands) * x.stride;
        float *to = y.data + c * y.stride;
        for (size_t i = 0; i < x.rows; i++) to[i] = params[c] * sinf(frequency(w, c) * from[i]);
    }
    return CONEFIELD_OK;
}

static ConefieldStatus backward(const void *stage, const float *params, struct ConefieldTile x,
                                struct ConefieldTileMut tape, struct ConefieldTile dy, struct ConefieldGrads grads,
                                struct ConefieldTileMut dx, struct ConefieldText *error) {
    const Waves *w = stage;
    for (size_t c = 0; c < dx.channels; c++) memset(dx.data + c * dx.stride, 0, dx.rows * sizeof(float));
    for (size_t c = 0; c < 3 * w->bands; c++) {
        size_t axis = c / w->bands;
        const float *from = x.data + axis * x.stride, *d = dy.data + c * dy.stride;
        float f = frequency(w, c), sum = 0;
        for (size_t i = 0; i < x.rows; i++) {
            sum += d[i] * sinf(f * from[i]);
            if (dx.data != NULL) dx.data[axis * dx.stride + i] += d[i] * params[c] * f * cosf(f * from[i]);
        }
        add_gradient(grads, c, sum);
    }
    return CONEFIELD_OK;
}

/* For `step_cells` of a projector, as in the spec balanced: resolving a period takes two cells. */
static ConefieldStatus resolutions(const void *stage, double *cells, size_t count, struct ConefieldText *error) {
    for (size_t c = 0; c < count; c++) cells[c] = 1u << (c % ((const Waves *)stage)->bands);
    return CONEFIELD_OK;
}

@plugin info parameter init forward backward resolutions@
