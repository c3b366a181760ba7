/* Losses with one fault each, selected by -DFAULT=…, which the host or the conformance kit must detect. Without a fault
 * it is a valid loss: half the squared difference. */
#include "faulty.h"

enum Fault {
    NONE, NO_AT, NEGATIVE, NOT_A_NUMBER, PAST_SLOPES, WRONG_SLOPE, FAILS, FITS_ITSELF, FITS_NOT,
};

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    (void)stage;
    say(text, "half the squared difference");
    return CONEFIELD_OK;
}

static ConefieldStatus at(const void *stage, const double *predicted, const double *measured, size_t count, double *loss,
                          double *slope, struct ConefieldText *error) {
    (void)stage;
    if (FAULT == FAILS) return fails(error, "no more numbers");
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
    if (FAULT == FITS_NOT) return fails(error, "no scan suits it");
    *out = (void *)stage;
    return CONEFIELD_OK;
}

static const struct ConefieldLoss LOSS = {
    .size = sizeof LOSS,
    .at = FAULT == NO_AT ? NULL : at,
    .needs_scan = needs_scan,
    .fitted = fitted,
};

PLUGIN(STAGE(CONEFIELD_LOSS, "half the squared difference", .loss = &LOSS))
