/* Projectors with one fault each when they are fitted to a scene, selected by -DFAULT=…, which the host or the conformance
 * kit must detect. Without a fault it is a valid projector: equal intervals inside the box, twice as many after fitting. */
#include "faulty.h"

enum Fault {
    NONE, FITS_ITSELF, FITS_NOT, FITS_NAN, FITS_LONGER,
};

typedef struct {
    int fitted;
} Rays;

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, ((const Rays *)stage)->fitted ? "32 samples, fitted" : "16 samples");
    return CONEFIELD_OK;
}

static size_t max_samples(const void *stage, const struct ConefieldRay *ray) {
    if (!(ray->inside[1] > ray->inside[0])) return 0;
    return ((const Rays *)stage)->fitted ? 32 : 16;
}

static ConefieldStatus sample(const void *stage, const struct ConefieldRay *ray, const uint64_t *seed, float *points,
                              float *weights, size_t capacity, size_t *count, struct ConefieldText *error) {
    (void)seed, (void)error;
    int fitted = ((const Rays *)stage)->fitted;
    float delta = (ray->inside[1] - ray->inside[0]) / (float)capacity;
    for (size_t i = 0; i < capacity; i++) {
        float t = ray->inside[0] + ((float)i + 0.5f) * delta;
        for (int k = 0; k < 3; k++) points[3 * i + k] = ray->origin[k] + t * ray->direction[k];
        weights[i] = fitted && FAULT == FITS_LONGER ? 1.1f * delta : delta;
        if (fitted && FAULT == FITS_NAN) weights[i] = NAN;
    }
    *count = capacity;
    return CONEFIELD_OK;
}

static ConefieldStatus fitted(const void *stage, const struct ConefieldLengths *lengths, void **out,
                              struct ConefieldText *error) {
    if (FAULT == FITS_NOT || !(lengths->voxel_mm > 0)) return fails(error, "no scene suits it");
    if (FAULT == FITS_ITSELF) {
        *out = (void *)stage;
        return CONEFIELD_OK;
    }
    if (make(out) != CONEFIELD_OK) return CONEFIELD_FAILED;
    ((Rays *)*out)->fitted = 1;
    return CONEFIELD_OK;
}

static const struct ConefieldProjector PROJECTOR = {
    .size = sizeof PROJECTOR,
    .max_samples = max_samples,
    .sample = sample,
    .fitted = fitted,
};

PLUGIN(STAGE(CONEFIELD_PROJECTOR, "equal intervals", .projector = &PROJECTOR))
