/* A data term for conefield in C: quadratic for small residuals, linear for large ones. */
#include "conefield_helpers.h"

#define DOC "quadratic for small residuals, linear for large ones"
#define SCHEMA \
    "{\"type\":\"object\",\"properties\":{" \
    "\"from\":{\"type\":\"number\",\"exclusiveMinimum\":0,\"default\":3.0,\"description\":\"Residuals of at least this many standard deviations of the noise count by their size.\"}}}"

/* Settings in a spec. */
struct Settings {
    double from;
};

/* The data term of one scan. */
struct Misfit {
    double noise, scale;
};

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    struct Settings s = {.from = number(settings, "from")};
    return hand_over(&s, sizeof s, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, "quadratic for small residuals, linear for large ones");
    return CONEFIELD_OK;
}

static int order(const void *a, const void *b) {
    float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

/* Measures the noise: second differences along rows contain little else, and edges hardly change their median. */
static ConefieldStatus of(const void *stage, const float *measured, const size_t *shape, void **misfit,
                          struct ConefieldText *error) {
    size_t rows = shape[0] * shape[1], columns = shape[2], count = 0;
    float *all = malloc(rows * columns * sizeof *all + 1);
    if (all == NULL) {
        say(error, "no memory");
        return CONEFIELD_FAILED;
    }
    for (size_t r = 0; r < rows; r++) {
        const float *row = measured + r * columns;
        for (size_t c = 1; c + 1 < columns; c++) all[count++] = fabsf(row[c - 1] - 2 * row[c] + row[c + 1]);
    }
    qsort(all, count, sizeof *all, order);
    struct Misfit m = {.noise = count == 0 ? 0 : (double)all[count / 2] / 0.6745 / sqrt(6)};
    m.scale = fmax(((const struct Settings *)stage)->from * m.noise, 1e-6);
    free(all);
    return hand_over(&m, sizeof m, misfit, error);
}

static void bytes(const void *stage, const size_t *shape, uint64_t *held, uint64_t *brief) {
    *held = sizeof(struct Misfit);
    *brief = sizeof(float) * shape[0] * shape[1] * shape[2];
}

static double noise(const void *misfit) {
    return ((const struct Misfit *)misfit)->noise;
}

/* The sum over the pixels of a view; residuals become derivatives. */
static ConefieldStatus differentiate(const void *misfit, size_t view, const float *measured, size_t count, float *residuals,
                                     double *sum, struct ConefieldText *error) {
    double scale = ((const struct Misfit *)misfit)->scale;
    *sum = 0;
    for (size_t i = 0; i < count; i++) {
        double by = residuals[i] / scale, root = hypot(by, 1);
        *sum += scale * scale * (by * by / (root + 1));
        residuals[i] = (float)(residuals[i] / root);
    }
    return CONEFIELD_OK;
}

/* The second derivative is at most 1, and derivatives scatter at most like the noise: values stay unchanged. */
static ConefieldStatus as_they_are(const void *misfit, size_t view, const float *measured, size_t count, float *values,
                                   struct ConefieldText *error) {
    return CONEFIELD_OK;
}

@plugin bytes of noise differentiate curve=as_they_are spread=as_they_are@
