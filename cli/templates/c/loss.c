/* A loss for conefield in C: sqrt(d^2 + s^2) - s of the difference d, an absolute value that is rounded near 0. */
@head@

typedef struct {
    double scale;
} Rounded;

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    (void)context;
    (void)width; /* 0 for a loss */
    double scale = number(settings, "scale");
    if (!(scale > 0 && isfinite(scale))) {
        char line[80];
        snprintf(line, sizeof line, "scale: found %g, expected a positive finite number", scale);
        say(error, line);
        return CONEFIELD_INVALID;
    }
    Rounded *r = malloc(sizeof *r);
    if (r == NULL) return CONEFIELD_FAILED;
    *r = (Rounded){.scale = scale};
    *stage = r;
    return CONEFIELD_OK;
}

static void destroy(void *stage) {
    free(stage);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    char line[80];
    snprintf(line, sizeof line, "rounded below %g", ((const Rounded *)stage)->scale);
    say(text, line);
    return CONEFIELD_OK;
}

/* The loss of each pair, and its derivative with respect to the predicted value. */
static ConefieldStatus at(const void *stage, const double *predicted, const double *measured, size_t count, double *loss,
                          double *slope, struct ConefieldText *error) {
    (void)error;
    double scale = ((const Rounded *)stage)->scale;
    for (size_t i = 0; i < count; i++) {
        double d = predicted[i] - measured[i], size = hypot(d, scale);
        loss[i] = d * (d / (size + scale));
        slope[i] = d / size;
    }
    return CONEFIELD_OK;
}

static const struct ConefieldLoss LOSS = {
    .size = sizeof LOSS,
    .at = at,
};

static const struct ConefieldStage STAGES[] = {{
    .kind = CONEFIELD_LOSS,
    .name = TEXT("@name@"),
    .doc = TEXT("the absolute difference, rounded near 0"),
    .schema = TEXT(
        "{\"type\":\"object\",\"properties\":{\"scale\":{\"type\":\"number\",\"default\":0.01,"
        "\"description\":\"Differences well below this count by their square.\"}},\"examples\":[{\"scale\":1.0}]}"),
    .create = create,
    .destroy = destroy,
    .describe = describe,
    .loss = &LOSS,
}};

@plugin@
