/* An initializer for conefield in C: fills parameters before training.
 *
 * This start fills every block of the encoder with uniform numbers; every other block stays as its stage's own scheme made
 * it.
 */
#include "conefield_plugin.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TEXT(literal) { (const uint8_t *)(literal), sizeof(literal) - 1 }

/* Writes a line for people. */
static void say(struct ConefieldText *out, const char *line) {
    if (out == NULL) return;
    out->length = strlen(line);
    memcpy(out->data, line, out->length < out->capacity ? out->length : out->capacity);
}

/* The number under `key` of the settings. The host has checked them against the schema and filled in defaults: they are one
 * flat JSON object, and the key is there. */
static double number(struct ConefieldStr settings, const char *key) {
    char text[1024], quoted[64];
    size_t n = settings.length < sizeof text - 1 ? settings.length : sizeof text - 1;
    memcpy(text, settings.data, n);
    text[n] = 0;
    snprintf(quoted, sizeof quoted, "\"%s\":", key);
    const char *at = strstr(text, quoted);
    return at == NULL ? 0.0 : strtod(at + strlen(quoted), NULL);
}

typedef struct {
    double bound;
} Uniform;

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    (void)context;
    (void)width;
    double bound = number(settings, "bound");
    if (!(bound >= 0 && bound < 1e30)) {
        say(error, "bound: found a number below 0, expected at least 0");
        return CONEFIELD_INVALID;
    }
    Uniform *u = malloc(sizeof *u);
    if (u == NULL) return CONEFIELD_FAILED;
    u->bound = bound;
    *stage = u;
    return CONEFIELD_OK;
}

static void destroy(void *stage) {
    free(stage);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    char line[80];
    snprintf(line, sizeof line, "the encoder within %g", ((const Uniform *)stage)->bound);
    say(text, line);
    return CONEFIELD_OK;
}

static ConefieldStatus apply(const void *stage, const struct ConefieldBlock *blocks, size_t block_count, float *params,
                             size_t length, uint8_t *filled, struct ConefieldText *error) {
    (void)length;
    (void)error;
    float bound = (float)((const Uniform *)stage)->bound;
    uint64_t seed = 1;
    for (size_t b = 0; b < block_count; b++) {
        struct ConefieldStr name = blocks[b].name;
        if (name.length < 8 || memcmp(name.data, "encoder.", 8) != 0) continue;
        for (size_t i = 0; i < blocks[b].length; i++) {
            seed = seed * 6364136223846793005u + 1442695040888963407u;
            params[blocks[b].start + i] = bound * (2.0f * (float)(seed >> 40) / 16777216.0f - 1.0f);
        }
        filled[b] = 1;
    }
    return CONEFIELD_OK;
}

static const struct ConefieldInitializer INITIALIZER = {
    .size = sizeof INITIALIZER,
    .apply = apply,
};

static const struct ConefieldStage STAGES[] = {{
    .kind = CONEFIELD_INITIALIZER,
    .name = TEXT("@name@"),
    .doc = TEXT("uniform numbers in the encoder"),
    .schema = TEXT(
        "{\"type\":\"object\",\"properties\":{\"bound\":{\"type\":\"number\",\"minimum\":0,\"default\":0.0001,"
        "\"description\":\"Numbers lie between plus and minus this.\"}}}"),
    .create = create,
    .destroy = destroy,
    .describe = describe,
    .initializer = &INITIALIZER,
}};

static const struct ConefieldPlugin PLUGIN = {
    .size = sizeof PLUGIN,
    .abi_major = CONEFIELD_ABI_MAJOR,
    .abi_minor = CONEFIELD_ABI_MINOR,
    .name = TEXT("@name@"),
    .version = TEXT("0.1.0"),
    .licence = TEXT("Apache-2.0 OR MIT"),
    .stages = STAGES,
    .stage_count = sizeof STAGES / sizeof *STAGES,
    .stage_size = sizeof *STAGES,
};

const struct ConefieldPlugin *conefield_plugin(void) {
    return &PLUGIN;
}
