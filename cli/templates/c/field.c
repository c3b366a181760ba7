/* A field for conefield in C: features to attenuation.
 *
 * This start is a weighted sum through a softplus, which is never negative: y = log(1 + exp(w * x + b)).
 * `conefield plugins check` compares its gradients with finite differences.
 */
#include "conefield_helpers.h"

#define DOC "a weighted sum through a softplus"
#define SCHEMA \
    "{\"type\":\"object\",\"properties\":{\"bias\":{\"type\":\"number\",\"default\":-1.0," \
    "\"description\":\"The shift that training starts from.\"}}}"

typedef struct {
    size_t width, one;
    double bias;
} Sum;

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    Sum s = {.width = width, .one = 1, .bias = number(settings, "bias")};
    return hand_over(&s, sizeof s, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, "softplus of a sum of %zu channels", ((const Sum *)stage)->width);
    return CONEFIELD_OK;
}

/* One number per row of tape: the derivative of the softplus. */
static ConefieldStatus info(const void *stage, struct ConefieldInfo *out) {
    size_t n = ((const Sum *)stage)->width;
    *out = (struct ConefieldInfo){.input = n, .output = 1, .params = n + 1, .blocks = 2, .tape = 1, .macs = n,
                                  .scope = CONEFIELD_SCOPE_ROW, .grads = CONEFIELD_GRADS_DENSE};
    return CONEFIELD_OK;
}

static ConefieldStatus parameter(const void *stage, size_t index, struct ConefieldParameter *out) {
    static const struct ConefieldStr names[] = {TEXT("weight"), TEXT("bias")};
    const Sum *s = stage;
    *out = (struct ConefieldParameter){.name = names[index], .shape = index == 0 ? &s->width : &s->one, .dimensions = 1};
    return CONEFIELD_OK;
}

static ConefieldStatus init(const void *stage, uint64_t seed, float *params, size_t length, struct ConefieldText *error) {
    const Sum *s = stage;
    for (size_t i = 0; i < length; i++) params[i] = uniform(&seed) / sqrtf((float)s->width);
    params[s->width] = (float)s->bias;
    return CONEFIELD_OK;
}

static ConefieldStatus forward(const void *stage, const float *params, struct ConefieldTile x,
                               struct ConefieldTileMut y, struct ConefieldTileMut tape, struct ConefieldText *error) {
    const Sum *s = stage;
    for (size_t i = 0; i < x.rows; i++) y.data[i] = params[s->width];
    for (size_t c = 0; c < s->width; c++)
        for (size_t i = 0; i < x.rows; i++) y.data[i] += params[c] * x.data[c * x.stride + i];
    for (size_t i = 0; i < x.rows; i++) {
        float sum = y.data[i];
        tape.data[i] = 1.0f / (1.0f + expf(-sum));
        y.data[i] = fmaxf(sum, 0.0f) + log1pf(expf(-fabsf(sum)));
    }
    return CONEFIELD_OK;
}

static ConefieldStatus backward(const void *stage, const float *params, struct ConefieldTile x,
                                struct ConefieldTileMut tape, struct ConefieldTile dy, struct ConefieldGrads grads,
                                struct ConefieldTileMut dx, struct ConefieldText *error) {
    const Sum *s = stage;
    float bias = 0;
    /* From here on the tape holds the gradient of the sum. */
    for (size_t i = 0; i < x.rows; i++) bias += tape.data[i] *= dy.data[i];
    for (size_t c = 0; c < s->width; c++) {
        float weight = 0;
        for (size_t i = 0; i < x.rows; i++) {
            weight += x.data[c * x.stride + i] * tape.data[i];
            if (dx.data != NULL) dx.data[c * dx.stride + i] = params[c] * tape.data[i];
        }
        add_gradient(grads, c, weight);
    }
    add_gradient(grads, s->width, bias);
    return CONEFIELD_OK;
}

@plugin info parameter init forward backward@
