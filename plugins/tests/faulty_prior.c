/* Priors with one fault each, selected by -DFAULT=…, which the host or the conformance kit must detect. Without a fault
 * it is a valid prior: half the squares of the values. */
#include "faulty.h"

enum Fault {
    NONE, FLAT_BLOCKS, NEGATIVE, NOT_A_NUMBER, BEFORE_GRADIENT, WRONG_GRADIENT, OVERWRITES, FAILS,
};

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
    if (FAULT == FAILS) return fails(error, "no more numbers");
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

PLUGIN(STAGE(CONEFIELD_PRIOR, "half the squares of values", .prior = &PRIOR))
