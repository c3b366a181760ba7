/* A conefield plugin in C: an encoder with one dense grid and trilinear interpolation.
 *
 * Channel k of a point is the weighted sum of feature k at the eight nodes around it. Points outside the unit cube are clamped
 * to its faces. Each parameter is affected by few rows, so gradients are scattered; a call adds only to the parameters in the
 * range that it gets.
 */
#include "conefield_helpers.h"

typedef struct {
    size_t resolution, features;
    size_t shape[4];
} Grid;

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    double resolution = number(settings, "resolution"), features = number(settings, "features");
    if (!(resolution >= 2 && resolution <= 512)) {
        say(error, "resolution: found %g, expected 2 to 512", resolution);
        return CONEFIELD_INVALID;
    }
    if (!(features >= 1 && features <= 32)) {
        say(error, "features: found %g, expected 1 to 32", features);
        return CONEFIELD_INVALID;
    }
    size_t r = (size_t)resolution, f = (size_t)features;
    Grid g = {r, f, {r, r, r, f}};
    return hand_over(&g, sizeof g, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    const Grid *g = stage;
    say(text, "one grid of %zu nodes a side, %zu channels", g->resolution, g->features);
    return CONEFIELD_OK;
}

static size_t params_of(const Grid *g) {
    return g->resolution * g->resolution * g->resolution * g->features;
}

/* A worker may own a slab of the grid along x. Slabs are few and wide, because each one visits all rows. */
static size_t slabs_of(const Grid *g) {
    return g->resolution < 8 ? g->resolution : 8;
}

static ConefieldStatus info(const void *stage, struct ConefieldInfo *out) {
    const Grid *g = stage;
    *out = (struct ConefieldInfo){
        .input = 3,
        .output = g->features,
        .params = params_of(g),
        .blocks = 1,
        .partitions = slabs_of(g),
        .macs = 8 * g->features,
        .scope = CONEFIELD_SCOPE_ROW,
        .grads = CONEFIELD_GRADS_SCATTER,
    };
    return CONEFIELD_OK;
}

static ConefieldStatus parameter(const void *stage, size_t index, struct ConefieldParameter *out) {
    *out = (struct ConefieldParameter){.name = TEXT("grid"), .shape = ((const Grid *)stage)->shape, .dimensions = 4};
    return CONEFIELD_OK;
}

static ConefieldStatus partition(const void *stage, size_t index, struct ConefieldRange *out) {
    const Grid *g = stage;
    size_t slice = params_of(g) / g->resolution;
    size_t slabs = slabs_of(g), first = index * g->resolution / slabs, end = (index + 1) * g->resolution / slabs;
    *out = (struct ConefieldRange){first * slice, end * slice};
    return CONEFIELD_OK;
}

static ConefieldStatus init(const void *stage, uint64_t seed, float *params, size_t length, struct ConefieldText *error) {
    for (size_t i = 0; i < length; i++) params[i] = 1e-2f * uniform(&seed);
    return CONEFIELD_OK;
}

/* The node below a coordinate in cells. NaN compares false: its node is 0. */
static size_t node_below(const Grid *g, float at) {
    size_t node = at > 0.0f ? (size_t)at : 0;
    return node > g->resolution - 2 ? g->resolution - 2 : node;
}

/* Converts a coordinate of the cube to cells of the grid, clamped to the cube. */
static float cells_at(const Grid *g, float p) {
    return (p < 0.0f ? 0.0f : p > 1.0f ? 1.0f : p) * (float)(g->resolution - 1);
}

/* The eight nodes around a point: first parameter, weight, and the weight's derivative along each axis. */
typedef struct {
    size_t at;
    float weight, slope[3];
} Corner;

static void corners_of(const Grid *g, struct ConefieldTile x, size_t row, Corner corners[8]) {
    size_t node[3];
    float right[3], cells[3];
    for (size_t k = 0; k < 3; k++) {
        float p = x.data[k * x.stride + row];
        cells[k] = p > 0.0f && p < 1.0f ? (float)(g->resolution - 1) : 0.0f;
        float at = cells_at(g, p);
        node[k] = node_below(g, at);
        right[k] = at - (float)node[k];
    }
    for (size_t i = 0; i < 8; i++) {
        size_t step[3] = {i >> 2, i >> 1 & 1, i & 1};
        float w[3], d[3];
        for (size_t k = 0; k < 3; k++) {
            w[k] = step[k] ? right[k] : 1.0f - right[k];
            d[k] = step[k] ? cells[k] : -cells[k];
        }
        corners[i].at =
            (((node[0] + step[0]) * g->resolution + node[1] + step[1]) * g->resolution + node[2] + step[2]) * g->features;
        corners[i].weight = w[0] * w[1] * w[2];
        corners[i].slope[0] = d[0] * w[1] * w[2];
        corners[i].slope[1] = w[0] * d[1] * w[2];
        corners[i].slope[2] = w[0] * w[1] * d[2];
    }
}

static ConefieldStatus forward(const void *stage, const float *params, struct ConefieldTile x,
                               struct ConefieldTileMut y, struct ConefieldTileMut tape, struct ConefieldText *error) {
    const Grid *g = stage;
    for (size_t row = 0; row < x.rows; row++) {
        Corner corners[8];
        corners_of(g, x, row, corners);
        for (size_t c = 0; c < g->features; c++) {
            float sum = 0;
            for (size_t i = 0; i < 8; i++) sum += corners[i].weight * params[corners[i].at + c];
            y.data[c * y.stride + row] = sum;
        }
    }
    return CONEFIELD_OK;
}

static ConefieldStatus backward(const void *stage, const float *params, struct ConefieldTile x,
                                struct ConefieldTileMut tape, struct ConefieldTile dy, struct ConefieldGrads grads,
                                struct ConefieldTileMut dx, struct ConefieldText *error) {
    const Grid *g = stage;
    size_t slice = params_of(g) / g->resolution;
    for (size_t row = 0; row < x.rows; row++) {
        Corner corners[8];
        float slope[3] = {0, 0, 0};
        if (dx.data == NULL) {
            /* Most rows belong to other slabs. */
            size_t node = node_below(g, cells_at(g, x.data[row]));
            if ((node + 2) * slice <= grads.start || node * slice >= grads.start + grads.length) continue;
        }
        corners_of(g, x, row, corners);
        for (size_t i = 0; i < 8; i++) {
            for (size_t c = 0; c < g->features; c++) {
                float d = dy.data[c * dy.stride + row];
                size_t at = corners[i].at + c;
                add_gradient(grads, at, d * corners[i].weight);
                for (size_t k = 0; k < 3; k++) slope[k] += d * params[at] * corners[i].slope[k];
            }
        }
        if (dx.data != NULL)
            for (size_t k = 0; k < 3; k++) dx.data[k * dx.stride + row] = slope[k];
    }
    return CONEFIELD_OK;
}

static const struct ConefieldMap MAP = {
    .size = sizeof MAP,
    .info = info,
    .parameter = parameter,
    .init = init,
    .forward = forward,
    .backward = backward,
    .partition = partition,
};

static const struct ConefieldStage STAGES[] = {{
    .kind = CONEFIELD_ENCODER,
    .name = TEXT("one-grid"),
    .doc = TEXT("one dense grid, read trilinearly"),
    .schema = TEXT(
        "{\"type\":\"object\",\"properties\":{"
        "\"resolution\":{\"type\":\"integer\",\"minimum\":2,\"maximum\":512,\"default\":32,"
        "\"description\":\"Nodes along a side.\"},"
        "\"features\":{\"type\":\"integer\",\"minimum\":1,\"maximum\":32,\"default\":8,"
        "\"description\":\"Channels.\"}},"
        "\"examples\":[{\"resolution\":2,\"features\":1},{\"resolution\":7,\"features\":3}]}"),
    .create = create,
    .destroy = free,
    .describe = describe,
    .map = &MAP,
}};

static const struct ConefieldPlugin PLUGIN = {
    .size = sizeof PLUGIN,
    .abi_major = CONEFIELD_ABI_MAJOR,
    .abi_minor = CONEFIELD_ABI_MINOR,
    .name = TEXT("dense"),
    .version = TEXT("0.1.0"),
    .licence = TEXT("Apache-2.0 OR MIT"),
    .stages = STAGES,
    .stage_count = sizeof STAGES / sizeof *STAGES,
    .stage_size = sizeof *STAGES,
};

const struct ConefieldPlugin *conefield_plugin(void) {
    return &PLUGIN;
}
