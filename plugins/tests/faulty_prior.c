/* Priors with one fault each, selected by -DFAULT=…, which the host or the conformance kit must detect. Without a fault
 * it is a valid prior: half the squares of the values. */
#include "conefield_plugin.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum Fault {
    NONE,
    FLAT_BLOCKS,
    NEGATIVE,
    NOT_A_NUMBER,
    BEFORE_GRADIENT,
    WRONG_GRADIENT,
    OVERWRITES,
    FAILS,
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

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    (void)context, (void)settings, (void)width, (void)error;
    *stage = malloc(1);
    return *stage == NULL ? CONEFIELD_FAILED : CONEFIELD_OK;
}

static void destroy(void *stage) {
    free(stage);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    (void)stage;
    say(text, "half the squares of values");
    return CONEFIELD_OK;
}

static ConefieldStatus blocks(const void *stage, struct ConefieldBlocks *out) {
    (void)stage;
    *out = (struct ConefieldBlocks){.edge = FAULT == FLAT_BLOCKS ? 1 : 4, .count = 8, .spacing = 1.0, .weight = 0.1};
    return CONEFIELD_OK;
}

static ConefieldStatus block(const void *stage, const double *values, size_t count, double scale, double *gradient,
                             double *penalty, struct ConefieldText *error) {
    (void)stage;
    if (FAULT == FAILS) {
        say(error, "no more numbers");
        return CONEFIELD_FAILED;
    }
    double sum = 0;
    for (size_t i = 0; i < count; i++) {
        sum += 0.5 * values[i] * values[i];
        double slope = scale * values[i] * (FAULT == WRONG_GRADIENT ? 1.1 : 1.0);
        gradient[i] = FAULT == OVERWRITES ? slope : gradient[i] + slope;
    }
    if (FAULT == BEFORE_GRADIENT) gradient[-1] = 1.0;
    *penalty = FAULT == NEGATIVE ? -sum : FAULT == NOT_A_NUMBER ? NAN : sum;
    return CONEFIELD_OK;
}

static const struct ConefieldPrior PRIOR = {
    .size = sizeof PRIOR,
    .blocks = blocks,
    .block = block,
};

static const struct ConefieldStage STAGES[] = {{
    .kind = CONEFIELD_PRIOR,
    .name = TEXT("faulty"),
    .doc = TEXT("half the squares of values"),
    .schema = TEXT("{\"type\":\"object\",\"properties\":{}}"),
    .create = create,
    .destroy = destroy,
    .describe = describe,
    .prior = &PRIOR,
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
