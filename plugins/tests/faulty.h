/* What the faulty plugins share. FAULT is a name of the enum Fault of each. */
#include "conefield_plugin.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifndef FAULT
#define FAULT NONE
#endif

#define TEXT(literal) { (const uint8_t *)(literal), sizeof(literal) - 1 }

static void say(struct ConefieldText *out, const char *line) {
    if (out == NULL) return;
    out->length = strlen(line);
    memcpy(out->data, line, out->length < out->capacity ? out->length : out->capacity);
}

static inline ConefieldStatus fails(struct ConefieldText *error, const char *line) {
    say(error, line);
    return CONEFIELD_FAILED;
}

/* Zeros, more than any of these stages holds. */
static inline ConefieldStatus make(void **stage) {
    *stage = calloc(1, 256);
    return *stage == NULL ? CONEFIELD_FAILED : CONEFIELD_OK;
}

static inline ConefieldStatus create_zeros(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                                           struct ConefieldText *error) {
    (void)context, (void)settings, (void)width, (void)error;
    return make(stage);
}

/* A stage of this kind, with its table of functions. */
#define STAGE(code, about, table) \
    { \
        .kind = code, .name = TEXT("faulty"), .doc = TEXT(about), .schema = TEXT("{\"type\":\"object\",\"properties\":{}}"), \
        .create = create_zeros, .destroy = free, .describe = describe, table \
    }

/* The plugin with these stages. */
#define PLUGIN(...) \
    static const struct ConefieldStage STAGES[] = {__VA_ARGS__}; \
    static const struct ConefieldPlugin PLUGIN = { \
        .size = sizeof PLUGIN, \
        .abi_major = CONEFIELD_ABI_MAJOR, \
        .abi_minor = CONEFIELD_ABI_MINOR, \
        .name = TEXT("faulty"), \
        .version = TEXT("0.1.0"), \
        .licence = TEXT("Apache-2.0 OR MIT"), \
        .stages = STAGES, \
        .stage_count = sizeof STAGES / sizeof *STAGES, \
        .stage_size = sizeof *STAGES, \
    }; \
    const struct ConefieldPlugin *conefield_plugin(void) { \
        return &PLUGIN; \
    }
