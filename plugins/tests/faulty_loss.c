/* Losses with one fault each, selected by -DFAULT=…, which the host or the conformance kit must detect. Without a fault
 * it is a valid loss: half the squared difference. */
#include "conefield_plugin.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum Fault {
    NONE,
    NO_AT,
    NEGATIVE,
    NOT_A_NUMBER,
    PAST_SLOPES,
    WRONG_SLOPE,
    FAILS,
    FITS_ITSELF,
    FITS_NOT,
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
    say(text, "half the squared difference");
    return CONEFIELD_OK;
}

static ConefieldStatus at(const void *stage, const double *predicted, const double *measured, size_t count, double *loss,
                          double *slope, struct ConefieldText *error) {
    (void)stage;
    if (FAULT == FAILS) {
        say(error, "no more numbers");
        return CONEFIELD_FAILED;
    }
    for (size_t i = 0; i < count; i++) {
        double d = predicted[i] - measured[i];
        loss[i] = FAULT == NEGATIVE ? -0.5 * d * d : 0.5 * d * d;
        slope[i] = FAULT == WRONG_SLOPE ? 1.1 * d : d;
        if (FAULT == NOT_A_NUMBER) loss[i] = NAN;
    }
    if (FAULT == PAST_SLOPES && count > 1) slope[count] = 0;
    return CONEFIELD_OK;
}

static uint32_t needs_scan(const void *stage) {
    (void)stage;
    return FAULT == FITS_ITSELF || FAULT == FITS_NOT;
}

static ConefieldStatus fitted(const void *stage, const struct ConefieldNoise *noise, void **out,
                              struct ConefieldText *error) {
    (void)noise;
    if (FAULT == FITS_NOT) {
        say(error, "no scan suits it");
        return CONEFIELD_FAILED;
    }
    *out = (void *)stage;
    return CONEFIELD_OK;
}

static const struct ConefieldLoss LOSS = {
    .size = sizeof LOSS,
    .at = FAULT == NO_AT ? NULL : at,
    .needs_scan = needs_scan,
    .fitted = fitted,
};

static const struct ConefieldStage STAGES[] = {{
    .kind = CONEFIELD_LOSS,
    .name = TEXT("faulty"),
    .doc = TEXT("half the squared difference"),
    .schema = TEXT("{\"type\":\"object\",\"properties\":{}}"),
    .create = create,
    .destroy = destroy,
    .describe = describe,
    .loss = &LOSS,
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
