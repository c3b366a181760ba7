/* A projector for conefield in C: rays to samples, each with its length.
 *
 * This start takes the middles of equal intervals within the reconstruction box. The line integral is the sum of
 * attenuation times length; the host computes it and its adjoint if `integrate` and `adjoint` are NULL.
 */
#include "conefield_helpers.h"

#define DOC "equal intervals within the box"
#define SCHEMA \
    "{\"type\":\"object\",\"properties\":{\"samples\":{\"type\":\"integer\",\"minimum\":1,\"default\":128," \
    "\"description\":\"Samples of every ray that meets the box.\"}}}"

typedef struct {
    size_t samples;
} March;

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    double samples = number(settings, "samples");
    if (!(samples >= 1 && samples <= 65536)) {
        say(error, "samples: found %g, expected 1 to 65536", samples);
        return CONEFIELD_INVALID;
    }
    March m = {.samples = (size_t)samples};
    return hand_over(&m, sizeof m, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, "%zu samples per ray", ((const March *)stage)->samples);
    return CONEFIELD_OK;
}

static size_t max_samples(const void *stage, const struct ConefieldRay *ray) {
    return ray->inside[1] > ray->inside[0] ? ((const March *)stage)->samples : 0;
}

/* Nothing is random here. `capacity` is the result of max_samples. */
static ConefieldStatus sample(const void *stage, const struct ConefieldRay *ray, const uint64_t *seed, float *points,
                              float *weights, size_t capacity, size_t *count, struct ConefieldText *error) {
    size_t n = max_samples(stage, ray);
    float near = ray->inside[0], length = n > 0 ? (ray->inside[1] - near) / (float)n : 0.0f;
    for (size_t i = 0; i < n; i++) {
        float t = near + ((float)i + 0.5f) * length;
        for (size_t k = 0; k < 3; k++) points[3 * i + k] = ray->origin[k] + t * ray->direction[k];
        weights[i] = length;
    }
    *count = n;
    return CONEFIELD_OK;
}

@plugin max_samples sample@
