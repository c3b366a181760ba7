/* Projectors with one fault each when they are fitted to a scene, selected by -DFAULT=…, which the host or the conformance
 * kit must detect. Without a fault it is a valid projector: equal intervals inside the box, twice as many after fitting. */
#include "conefield_plugin.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum Fault {
    NONE,
    FITS_ITSELF,
    FITS_NOT,
    FITS_NAN,
    FITS_LONGER,
};
#ifndef FAULT
#define FAULT NONE
#endif

#define TEXT(literal) { (const uint8_t *)(literal), sizeof(literal) - 1 }

static void say(struct ConefieldText *out, const char *line) {
    if (out == NULL) return;
    out->length = strlen(line);
    memcpy(out->data, line, out->length < out->capacity ? out->length : out->capacity);
}

typedef struct {
    int fitted;
} Rays;

static ConefieldStatus make(int fitted, void **stage) {
    Rays *r = malloc(sizeof *r);
    if (r == NULL) return CONEFIELD_FAILED;
    *r = (Rays){.fitted = fitted};
    *stage = r;
    return CONEFIELD_OK;
}

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    (void)context, (void)settings, (void)width, (void)error;
    return make(0, stage);
}

static void destroy(void *stage) {
    free(stage);
}

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
    if (FAULT == FITS_NOT || !(lengths->voxel_mm > 0)) {
        say(error, "no scene suits it");
        return CONEFIELD_FAILED;
    }
    if (FAULT == FITS_ITSELF) {
        *out = (void *)stage;
        return CONEFIELD_OK;
    }
    return make(1, out);
}

static const struct ConefieldProjector PROJECTOR = {
    .size = sizeof PROJECTOR,
    .max_samples = max_samples,
    .sample = sample,
    .fitted = fitted,
};

static const struct ConefieldStage STAGES[] = {{
    .kind = CONEFIELD_PROJECTOR,
    .name = TEXT("faulty"),
    .doc = TEXT("equal intervals"),
    .schema = TEXT("{\"type\":\"object\",\"properties\":{}}"),
    .create = create,
    .destroy = destroy,
    .describe = describe,
    .projector = &PROJECTOR,
}};

static const struct ConefieldPlugin PLUGIN = {
    .size = sizeof PLUGIN,
    .abi_major = CONEFIELD_ABI_MAJOR,
    .abi_minor = CONEFIELD_ABI_MINOR,
    .name = TEXT("faulty"),
    .version = TEXT("0.1.0"),
    .licence = TEXT("Apache-2.0 OR MIT"),
    .stages = STAGES,
    .stage_count = sizeof STAGES / sizeof *STAGES,
    .stage_size = sizeof *STAGES,
};

const struct ConefieldPlugin *conefield_plugin(void) {
    return &PLUGIN;
}
