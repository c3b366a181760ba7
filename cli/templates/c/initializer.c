/* An initializer for conefield in C: fills parameters before training.
 *
 * This start fills every block of the encoder with uniform numbers; every other block keeps the initialization by its
 * own stage.
 */
@head@

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

@plugin@
