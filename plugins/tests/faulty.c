/* Encoders with one fault each, selected by -DFAULT=… or by another NAME, SCHEMA or ENTRY, which the host or the
 * conformance kit must detect. Without a fault it is a valid encoder: y = a * x, each coordinate times a learned
 * number. */
#define _POSIX_C_SOURCE 199309L
#include "faulty.h"

#include <stdatomic.h>
#include <time.h>

enum Fault {
    NONE, WRONG_ABI, SHORT_TABLE, SHORT_FUNCTIONS, NO_FORWARD, NO_STAGES, NOT_A_NUMBER, NOT_A_NUMBER_LATER,
    MORE_CHANNELS, MORE_PARAMETERS, TWIN_BLOCKS, PAST_TILE, NO_FORWARD_PASS, WRONG_PASSES, REDUCES_NOTHING,
    FEW_RESOLUTIONS, MORE_RESOLUTIONS, NAN_RESOLUTION, NEGATIVE_RESOLUTION, BEFORE_GRADIENTS, WRONG_GRADIENT,
    WRONG_INPUT_GRADIENT, REMEMBERS, FAILS, FAILS_LATER, SLEEPS, SLEEPS_IN_CREATE, ABORTS,
    NAN_AT_AN_EDGE,
};
#ifndef ENTRY
#define ENTRY conefield_plugin
#endif
#ifndef NAME
#define NAME "faulty"
#endif
#ifndef SCHEMA
#define SCHEMA "{\"type\":\"object\",\"properties\":{}}"
#endif

static atomic_int calls;

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    (void)context, (void)settings, (void)width, (void)error;
    static int nothing;
    if (FAULT == SLEEPS_IN_CREATE) nanosleep(&(struct timespec){.tv_sec = 600}, NULL);
    *stage = &nothing;
    return CONEFIELD_OK;
}

static void destroy(void *stage) {
    (void)stage;
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    (void)stage;
    say(text, "each coordinate times a number");
    return CONEFIELD_OK;
}

static ConefieldStatus info(const void *stage, struct ConefieldInfo *out) {
    (void)stage;
    *out = (struct ConefieldInfo){
        .input = 3,
        .output = FAULT == MORE_CHANNELS ? 4 : 3,
        .params = FAULT == MORE_PARAMETERS ? 5 : 3,
        .blocks = FAULT == TWIN_BLOCKS ? 3 : 1,
        .macs = 3,
        .grads = CONEFIELD_GRADS_DENSE,
    };
    return CONEFIELD_OK;
}

static ConefieldStatus parameter(const void *stage, size_t index, struct ConefieldParameter *out) {
    (void)stage, (void)index;
    static const size_t shape[] = {FAULT == TWIN_BLOCKS ? 1 : 3};
    *out = (struct ConefieldParameter){.name = TEXT("factor"), .shape = shape, .dimensions = 1};
    return CONEFIELD_OK;
}

static ConefieldStatus init(const void *stage, uint64_t seed, float *params, size_t length, struct ConefieldText *error) {
    (void)stage, (void)seed, (void)error;
    for (size_t i = 0; i < length; i++) params[i] = 1.0f;
    return CONEFIELD_OK;
}

static ConefieldStatus forward(const void *stage, const float *params, struct ConefieldTile x,
                               struct ConefieldTileMut y, struct ConefieldTileMut tape, struct ConefieldText *error) {
    (void)stage, (void)tape;
    int call = atomic_fetch_add(&calls, 1);
    if (FAULT == ABORTS) abort();
    if (FAULT == SLEEPS) nanosleep(&(struct timespec){.tv_sec = 600}, NULL);
    if (FAULT == FAILS || (FAULT == FAILS_LATER && call > 100)) return fails(error, "no more numbers");
    for (size_t c = 0; c < 3; c++)
        for (size_t i = 0; i < x.rows; i++) {
            float v = params[c] * x.data[c * x.stride + i];
            if (FAULT == NOT_A_NUMBER || (FAULT == NOT_A_NUMBER_LATER && call > 100)) v = NAN;
            if (FAULT == NAN_AT_AN_EDGE && x.data[i] > 0.96f && x.data[x.stride + i] > 0.96f) v = NAN;
            if (FAULT == REMEMBERS) v += 1e-6f * (float)(call % 1000);
            y.data[c * y.stride + i] = v;
        }
    if (FAULT == PAST_TILE) y.data[y.channels * y.stride] = 1.0f;
    return CONEFIELD_OK;
}

static size_t passes(const void *stage) {
    (void)stage;
    return FAULT == NO_FORWARD_PASS || FAULT == WRONG_PASSES ? 2 : 1;
}

static ConefieldStatus forward_pass(const void *stage, size_t pass, const float *params, struct ConefieldTile x,
                                    struct ConefieldTileMut y, struct ConefieldTileMut tape, struct ConefieldText *error) {
    ConefieldStatus status = forward(stage, params, x, y, tape, error);
    if (FAULT == WRONG_PASSES && pass == 1) y.data[0] += 1.0f;
    return status;
}

static ConefieldStatus backward(const void *stage, const float *params, struct ConefieldTile x,
                                struct ConefieldTileMut tape, struct ConefieldTile dy, struct ConefieldGrads grads,
                                struct ConefieldTileMut dx, struct ConefieldText *error) {
    (void)stage, (void)tape, (void)error;
    for (size_t c = 0; c < 3; c++) {
        float sum = 0;
        for (size_t i = 0; i < x.rows; i++) {
            sum += dy.data[c * dy.stride + i] * x.data[c * x.stride + i];
            if (dx.data != NULL)
                dx.data[c * dx.stride + i] =
                    params[c] * dy.data[c * dy.stride + i] * (FAULT == WRONG_INPUT_GRADIENT ? -1.0f : 1.0f);
        }
        if (FAULT == WRONG_GRADIENT) sum *= 1.1f;
        if (c >= grads.start && c - grads.start < grads.length) grads.data[c - grads.start] += sum;
    }
    if (FAULT == BEFORE_GRADIENTS) grads.data[-1] = 1.0f;
    return CONEFIELD_OK;
}

/* Every channel resolves 8 cells. */
static ConefieldStatus resolutions(const void *stage, double *cells, size_t count, struct ConefieldText *error) {
    (void)stage, (void)error;
    if (FAULT == FEW_RESOLUTIONS) count -= 1;
    if (FAULT == MORE_RESOLUTIONS) count += 1;
    for (size_t c = 0; c < count; c++) cells[c] = 8.0;
    if (FAULT == NAN_RESOLUTION) cells[1] = NAN;
    if (FAULT == NEGATIVE_RESOLUTION) cells[1] = -8.0;
    return CONEFIELD_OK;
}

/* Claims to remove channels, but returns itself. */
static ConefieldStatus reduce(const void *stage, uint32_t side, const size_t *keep, size_t count,
                              struct ConefieldReduced *out, struct ConefieldText *error) {
    (void)side, (void)keep, (void)count, (void)error;
    static const struct ConefieldRange all = {0, 3};
    static const size_t channels[] = {0, 1, 2};
    *out = (struct ConefieldReduced){
        .stage = (void *)stage, .params = &all, .params_count = 1, .channels = channels, .channels_count = 3};
    return CONEFIELD_OK;
}

static const struct ConefieldMap MAP = {
    .size = FAULT == SHORT_FUNCTIONS ? 24 : sizeof MAP,
    .info = info,
    .parameter = parameter,
    .init = init,
    .forward = FAULT == NO_FORWARD ? NULL : forward,
    .backward = backward,
    .reduce = FAULT == REDUCES_NOTHING ? reduce : NULL,
    .passes = passes,
    .forward_pass = FAULT == NO_FORWARD_PASS ? NULL : forward_pass,
    .resolutions = resolutions,
};

static const struct ConefieldStage STAGES[] = {{
    .kind = CONEFIELD_ENCODER,
    .name = TEXT(NAME),
    .doc = TEXT("each coordinate times a number"),
    .schema = TEXT(SCHEMA),
    .create = create,
    .destroy = destroy,
    .describe = describe,
    .map = &MAP,
}};

static const struct ConefieldPlugin PLUGIN = {
    .size = FAULT == SHORT_TABLE ? 32 : sizeof PLUGIN,
    .abi_major = FAULT == WRONG_ABI ? CONEFIELD_ABI_MAJOR + 1 : CONEFIELD_ABI_MAJOR,
    .abi_minor = CONEFIELD_ABI_MINOR,
    .name = TEXT("faulty"),
    .version = TEXT("0.1.0"),
    .licence = TEXT("Apache-2.0 OR MIT"),
    .stages = STAGES,
    .stage_count = FAULT == NO_STAGES ? 0 : sizeof STAGES / sizeof *STAGES,
    .stage_size = sizeof *STAGES,
};

const struct ConefieldPlugin *ENTRY(void) {
    return &PLUGIN;
}
