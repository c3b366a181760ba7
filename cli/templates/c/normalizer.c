/* A normalizer for conefield in C: features to features.
 *
 * This start scales and shifts every channel by numbers that are learned: y = w * x + b. `conefield plugins check` compares
 * its gradients with finite differences.
 */
#include "conefield_helpers.h"

#define DOC "a learned scale and shift of every channel"
#define SCHEMA \
    "{\"type\":\"object\",\"properties\":{\"scale\":{\"type\":\"number\",\"default\":1.0," \
    "\"description\":\"The scale that training starts from.\"}}}"

typedef struct {
    size_t width;
    double scale;
} Affine;

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    Affine a = {.width = width, .scale = number(settings, "scale")};
    return hand_over(&a, sizeof a, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, "%zu channels, each with a scale and a shift", ((const Affine *)stage)->width);
    return CONEFIELD_OK;
}

static ConefieldStatus info(const void *stage, struct ConefieldInfo *out) {
    size_t n = ((const Affine *)stage)->width;
    *out = (struct ConefieldInfo){.input = n, .output = n, .params = 2 * n, .blocks = 2, .macs = n,
                                  .scope = CONEFIELD_SCOPE_ROW, .grads = CONEFIELD_GRADS_DENSE};
    return CONEFIELD_OK;
}

static ConefieldStatus parameter(const void *stage, size_t index, struct ConefieldParameter *out) {
    static const struct ConefieldStr names[] = {TEXT("scale"), TEXT("shift")};
    *out = (struct ConefieldParameter){.name = names[index], .shape = &((const Affine *)stage)->width, .dimensions = 1};
    return CONEFIELD_OK;
}

static ConefieldStatus init(const void *stage, uint64_t seed, float *params, size_t length, struct ConefieldText *error) {
    const Affine *a = stage;
    for (size_t i = 0; i < length; i++) params[i] = i < a->width ? (float)a->scale : 0.0f;
    return CONEFIELD_OK;
}

static ConefieldStatus forward(const void *stage, const float *params, struct ConefieldTile x,
                               struct ConefieldTileMut y, struct ConefieldTileMut tape, struct ConefieldText *error) {
    size_t n = ((const Affine *)stage)->width;
    for (size_t c = 0; c < n; c++)
        for (size_t i = 0; i < x.rows; i++)
            y.data[c * y.stride + i] = params[c] * x.data[c * x.stride + i] + params[n + c];
    return CONEFIELD_OK;
}

static ConefieldStatus backward(const void *stage, const float *params, struct ConefieldTile x,
                                struct ConefieldTileMut tape, struct ConefieldTile dy, struct ConefieldGrads grads,
                                struct ConefieldTileMut dx, struct ConefieldText *error) {
    size_t n = ((const Affine *)stage)->width;
    for (size_t c = 0; c < n; c++) {
        const float *d = dy.data + c * dy.stride, *from = x.data + c * x.stride;
        float scale = 0, shift = 0;
        for (size_t i = 0; i < x.rows; i++) {
            scale += d[i] * from[i];
            shift += d[i];
            if (dx.data != NULL) dx.data[c * dx.stride + i] = params[c] * d[i];
        }
        add_gradient(grads, c, scale);
        add_gradient(grads, n + c, shift);
    }
    return CONEFIELD_OK;
}

/* Channels are independent: without some, the rest is a smaller stage of the same kind. The lists of kept items are stored
 * behind it in the same memory and live as long as it does. */
static ConefieldStatus reduce(const void *stage, uint32_t side, const size_t *keep, size_t count,
                              struct ConefieldReduced *out, struct ConefieldText *error) {
    const Affine *a = stage;
    Affine *smaller = malloc(sizeof *smaller + 2 * count * sizeof(struct ConefieldRange) + count * sizeof(size_t));
    if (smaller == NULL) return CONEFIELD_FAILED;
    *smaller = (Affine){.width = count, .scale = a->scale};
    struct ConefieldRange *params = (struct ConefieldRange *)(smaller + 1);
    size_t *channels = (size_t *)(params + 2 * count);
    for (size_t i = 0; i < count; i++) {
        channels[i] = keep[i];
        params[i] = (struct ConefieldRange){keep[i], keep[i] + 1};
        params[count + i] = (struct ConefieldRange){a->width + keep[i], a->width + keep[i] + 1};
    }
    *out = (struct ConefieldReduced){smaller, params, 2 * count, channels, count};
    return CONEFIELD_OK;
}

@plugin info parameter init forward backward reduce@
