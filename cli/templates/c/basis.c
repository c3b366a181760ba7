/* A basis for conefield in C: a coefficient for each block of voxels. */
#include "conefield_helpers.h"

#define DOC "blocks of voxels"
#define SCHEMA \
    "{\"type\":\"object\",\"properties\":{" \
    "\"edge\":{\"type\":\"integer\",\"minimum\":1,\"maximum\":64,\"default\":2,\"description\":\"Voxels along a block's edge.\"}}}"

/* Settings in a spec. */
struct Settings {
    size_t edge;
};

/* The blocks of one grid of voxels. */
struct Blocks {
    struct ConefieldGrid voxels, blocks;
    size_t edge;
};

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    struct Settings s = {.edge = (size_t)number(settings, "edge")};
    return hand_over(&s, sizeof s, stage, error);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    say(text, "blocks of voxels");
    return CONEFIELD_OK;
}

static ConefieldStatus on(const void *stage, const struct ConefieldGrid *voxels, void **expansion,
                          struct ConefieldText *error) {
    struct Blocks b = {.voxels = *voxels, .blocks = *voxels, .edge = ((const struct Settings *)stage)->edge};
    for (size_t k = 0; k < 3; k++) {
        b.blocks.shape[k] = (voxels->shape[k] + b.edge - 1) / b.edge;
        b.blocks.spacing[k] = voxels->spacing[k] * (double)b.edge;
        /* At the far end a block may reach beyond the voxels. */
        double beyond = (double)(b.blocks.shape[k] * b.edge - voxels->shape[k]) * voxels->spacing[k];
        b.blocks.center[k] += 0.5 * beyond;
    }
    return hand_over(&b, sizeof b, expansion, error);
}

static ConefieldStatus info(const void *expansion, struct ConefieldExpansion *info) {
    const struct Blocks *b = expansion;
    *info = (struct ConefieldExpansion){.coefficients = b->blocks, .double_precision = 1};
    return CONEFIELD_OK;
}

/* The block of voxel `i`. */
static size_t block(const struct Blocks *b, size_t i) {
    const size_t *n = b->voxels.shape, *m = b->blocks.shape;
    size_t x = i / (n[1] * n[2]) / b->edge, y = i / n[2] % n[1] / b->edge, z = i % n[2] / b->edge;
    return (x * m[1] + y) * m[2] + z;
}

static size_t count(const struct ConefieldGrid *grid) {
    return grid->shape[0] * grid->shape[1] * grid->shape[2];
}

/* Both directions in one precision: coefficients to voxels, and the sums over the voxels of each block. */
#define BOTH(real, expand, adjoint) \
    static ConefieldStatus expand(const void *expansion, const real *coefficients, real *voxels, struct ConefieldText *error) { \
        const struct Blocks *b = expansion; \
        for (size_t i = 0; i < count(&b->voxels); i++) voxels[i] = coefficients[block(b, i)]; \
        return CONEFIELD_OK; \
    } \
    static ConefieldStatus adjoint(const void *expansion, const real *voxels, real *coefficients, struct ConefieldText *error) { \
        const struct Blocks *b = expansion; \
        memset(coefficients, 0, count(&b->blocks) * sizeof(real)); \
        for (size_t i = 0; i < count(&b->voxels); i++) coefficients[block(b, i)] += voxels[i]; \
        return CONEFIELD_OK; \
    }

BOTH(float, expand, adjoint)
BOTH(double, expand_f64, adjoint_f64)

@plugin on info expand adjoint expand_f64 adjoint_f64@
