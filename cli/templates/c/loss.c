/* A loss for conefield in C: sqrt(d^2 + s^2) - s of the difference d, an absolute value that is rounded near 0. */
#include "conefield_helpers.h"

#define DOC "the absolute difference, rounded near 0"
#define SCHEMA \
    "{\"type\":\"object\",\"properties\":{\"scale\":{\"type\":\"number\",\"default\":0.01," \
    "\"description\":\"Differences well below this count by their square.\"}},\"examples\":[{\"scale\":1.0}]}"

typedef struct {
    double scale;
} Rounded;

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    double scale = number(settings, "scale");
    if (!(scale > 0 && isfinite(scale))) {
        say(error, "scale: found %g, expected a positive finite number", scale);
        return CONEFIELD_INVALID;
    }
    Rounded r = {.scale = scale};
    return hand_over(&r, sizeof r, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, "rounded below %g", ((const Rounded *)stage)->scale);
    return CONEFIELD_OK;
}

/* The loss of each pair, and its derivative with respect to the predicted value. */
static ConefieldStatus at(const void *stage, const double *predicted, const double *measured, size_t count, double *loss,
                          double *slope, struct ConefieldText *error) {
    double scale = ((const Rounded *)stage)->scale;
    for (size_t i = 0; i < count; i++) {
        double d = predicted[i] - measured[i], size = hypot(d, scale);
        loss[i] = d * (d / (size + scale));
        slope[i] = d / size;
    }
    return CONEFIELD_OK;
}

@plugin at@
