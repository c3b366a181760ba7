/* An initializer for conefield in C: fills parameters before training.
 *
 * This start fills every block of the encoder with uniform numbers; every other block keeps the initialization by its
 * own stage.
 */
#include "conefield_helpers.h"

#define DOC "uniform numbers in the encoder"
#define SCHEMA \
    "{\"type\":\"object\",\"properties\":{\"bound\":{\"type\":\"number\",\"minimum\":0,\"default\":0.0001," \
    "\"description\":\"Numbers lie between plus and minus this.\"}}}"

typedef struct {
    double bound;
} Uniform;

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    double bound = number(settings, "bound");
    if (!(bound >= 0 && bound < 1e30)) {
        say(error, "bound: found %g, expected at least 0", bound);
        return CONEFIELD_INVALID;
    }
    Uniform u = {.bound = bound};
    return hand_over(&u, sizeof u, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, "the encoder within %g", ((const Uniform *)stage)->bound);
    return CONEFIELD_OK;
}

static ConefieldStatus apply(const void *stage, const struct ConefieldBlock *blocks, size_t block_count, float *params,
                             size_t length, uint8_t *filled, struct ConefieldText *error) {
    float bound = (float)((const Uniform *)stage)->bound;
    uint64_t seed = 1;
    for (size_t b = 0; b < block_count; b++) {
        struct ConefieldStr name = blocks[b].name;
        if (name.length < 8 || memcmp(name.data, "encoder.", 8) != 0) continue;
        for (size_t i = 0; i < blocks[b].length; i++) params[blocks[b].start + i] = bound * uniform(&seed);
        filled[b] = 1;
    }
    return CONEFIELD_OK;
}

@plugin apply@
