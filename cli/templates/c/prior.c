/* A prior for conefield in C: half the squared differences of neighbouring points, in small blocks placed at random. */
#include "conefield_helpers.h"

#define DOC "squared differences of neighbouring points"
#define SCHEMA \
    "{\"type\":\"object\",\"properties\":{" \
    "\"weight\":{\"type\":\"number\",\"minimum\":0,\"default\":0.1,\"description\":\"Weight against the mean loss of a ray.\"}," \
    "\"blocks\":{\"type\":\"integer\",\"minimum\":1,\"default\":32,\"description\":\"Blocks a step.\"}," \
    "\"edge\":{\"type\":\"integer\",\"minimum\":2,\"maximum\":32,\"default\":8,\"description\":\"Points along a block's edge.\"}," \
    "\"spacing\":{\"type\":\"number\",\"default\":1.0,\"description\":\"Distance of the points in voxels.\"}}}"

/* The host refuses invalid blocks. */
static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    struct ConefieldBlocks b = {.edge = (size_t)number(settings, "edge"), .count = (size_t)number(settings, "blocks"),
                                .spacing = number(settings, "spacing"), .weight = number(settings, "weight")};
    return hand_over(&b, sizeof b, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, "squared differences, weight %g", ((const struct ConefieldBlocks *)stage)->weight);
    return CONEFIELD_OK;
}

static ConefieldStatus blocks(const void *stage, struct ConefieldBlocks *out) {
    *out = *(const struct ConefieldBlocks *)stage;
    return CONEFIELD_OK;
}

/* The penalty. Adds `scale` times its derivatives to `gradient`. */
static ConefieldStatus block(const void *stage, const double *values, size_t count, double scale, double *gradient,
                             double *penalty, struct ConefieldText *error) {
    size_t edge = ((const struct ConefieldBlocks *)stage)->edge;
    const size_t steps[] = {edge * edge, edge, 1};
    double sum = 0;
    for (size_t axis = 0; axis < 3; axis++) {
        size_t step = steps[axis];
        for (size_t i = 0; i < count; i++) {
            if (i / step % edge + 1 == edge) continue;
            double d = values[i + step] - values[i];
            sum += 0.5 * d * d;
            gradient[i + step] += scale * d;
            gradient[i] -= scale * d;
        }
    }
    *penalty = sum;
    return CONEFIELD_OK;
}

@plugin blocks block@
