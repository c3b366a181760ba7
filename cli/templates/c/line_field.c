/* A line field for conefield in C: a sum of Gaussian blobs on a grid, whose line integrals are known in closed form. */
@head@

/* A grid of blobs: parameter i is the height of blob i. */
struct Blobs {
    size_t shape[3], count;
    /* The inverse square of a blob's width. */
    double sharpness;
};

static ConefieldStatus create(const void *context, struct ConefieldStr settings, size_t width, void **stage,
                              struct ConefieldText *error) {
    (void)context;
    (void)width; /* 3: positions */
    (void)error;
    size_t n = (size_t)number(settings, "blobs");
    struct Blobs *b = malloc(sizeof *b);
    if (b == NULL) return CONEFIELD_FAILED;
    *b = (struct Blobs){.shape = {n, n, n}, .count = n * n * n, .sharpness = 2.56 * (double)(n * n)};
    *stage = b;
    return CONEFIELD_OK;
}

static void destroy(void *stage) {
    free(stage);
}

static ConefieldStatus describe(const void *stage, struct ConefieldText *text) {
    char line[80];
    snprintf(line, sizeof line, "%zu blobs per side", ((const struct Blobs *)stage)->shape[0]);
    say(text, line);
    return CONEFIELD_OK;
}

static ConefieldStatus info(const void *stage, struct ConefieldInfo *out) {
    size_t n = ((const struct Blobs *)stage)->count;
    *out = (struct ConefieldInfo){.input = 3, .output = 1, .params = n, .blocks = 1, .macs = n,
                                  .scope = CONEFIELD_SCOPE_ROW, .grads = CONEFIELD_GRADS_DENSE, .double_precision = 1};
    return CONEFIELD_OK;
}

static ConefieldStatus parameter(const void *stage, size_t index, struct ConefieldParameter *out) {
    static const struct ConefieldStr name = TEXT("height");
    (void)index;
    *out = (struct ConefieldParameter){.name = name, .shape = ((const struct Blobs *)stage)->shape, .dimensions = 3};
    return CONEFIELD_OK;
}

/* All blobs start with a height of 0. */
static ConefieldStatus init(const void *stage, uint64_t seed, float *params, size_t length, struct ConefieldText *error) {
    (void)stage;
    (void)seed;
    (void)error;
    memset(params, 0, length * sizeof *params);
    return CONEFIELD_OK;
}

/* The vector from `at` to the centre of blob `i`. */
static void way(const struct Blobs *b, size_t i, const double at[3], double way[3]) {
    size_t n = b->shape[0], place[3] = {i / (n * n), i / n % n, i % n};
    for (size_t k = 0; k < 3; k++) way[k] = ((double)place[k] + 0.5) / (double)n - at[k];
}

static double dot(const double a[3], const double b[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* The line integral of blob `i`, with a height of 1, along a ray. */
static double along(const struct Blobs *b, size_t i, const struct ConefieldRay *ray) {
    const double from[3] = {ray->origin[0], ray->origin[1], ray->origin[2]};
    const double direction[3] = {ray->direction[0], ray->direction[1], ray->direction[2]};
    double to[3];
    way(b, i, from, to);
    double ahead = dot(to, direction), square = dot(to, to) - ahead * ahead;
    return sqrt(6.283185307179586 / b->sharpness) * exp(-0.5 * square * b->sharpness);
}

static int inside(const struct ConefieldRay *ray) {
    return ray->inside[1] > ray->inside[0];
}

/* All functions in one precision: values at points and line integrals, each with their gradients. */
#define PRECISION(real, Tile, TileMut, Grads, forward, backward, project, backproject) \
    static ConefieldStatus forward(const void *stage, const real *params, struct Tile x, struct TileMut y, \
                                   struct TileMut tape, struct ConefieldText *error) { \
        const struct Blobs *b = stage; \
        (void)tape; \
        (void)error; \
        for (size_t r = 0; r < x.rows; r++) { \
            const double at[3] = {x.data[r], x.data[x.stride + r], x.data[2 * x.stride + r]}; \
            double sum = 0, to[3]; \
            for (size_t i = 0; i < b->count; i++) { \
                way(b, i, at, to); \
                sum += params[i] * exp(-0.5 * b->sharpness * dot(to, to)); \
            } \
            y.data[r] = (real)sum; \
        } \
        return CONEFIELD_OK; \
    } \
    static ConefieldStatus backward(const void *stage, const real *params, struct Tile x, struct TileMut tape, \
                                    struct Tile dy, struct Grads grads, struct TileMut dx, struct ConefieldText *error) { \
        const struct Blobs *b = stage; \
        (void)tape; \
        (void)error; \
        for (size_t r = 0; r < x.rows; r++) { \
            const double at[3] = {x.data[r], x.data[x.stride + r], x.data[2 * x.stride + r]}; \
            double slope[3] = {0, 0, 0}, to[3]; \
            for (size_t i = 0; i < b->count; i++) { \
                way(b, i, at, to); \
                double d = dy.data[r] * exp(-0.5 * b->sharpness * dot(to, to)); \
                if (i >= grads.start && i - grads.start < grads.length) grads.data[i - grads.start] += (real)d; \
                for (size_t k = 0; k < 3; k++) slope[k] += d * params[i] * b->sharpness * to[k]; \
            } \
            for (size_t k = 0; dx.data != NULL && k < 3; k++) dx.data[k * dx.stride + r] = (real)slope[k]; \
        } \
        return CONEFIELD_OK; \
    } \
    static ConefieldStatus project(const void *stage, const real *params, const struct ConefieldRay *rays, size_t count, \
                                   real *out, struct ConefieldText *error) { \
        const struct Blobs *b = stage; \
        (void)error; \
        for (size_t r = 0; r < count; r++) { \
            double sum = 0; \
            for (size_t i = 0; inside(&rays[r]) && i < b->count; i++) sum += params[i] * along(b, i, &rays[r]); \
            out[r] = (real)sum; \
        } \
        return CONEFIELD_OK; \
    } \
    /* The adjoint uses the same lengths. */ \
    static ConefieldStatus backproject(const void *stage, const real *params, const struct ConefieldRay *rays, \
                                       size_t count, const real *dlines, struct Grads grads, \
                                       struct ConefieldText *error) { \
        (void)params; \
        (void)error; \
        for (size_t r = 0; r < count; r++) \
            for (size_t i = 0; inside(&rays[r]) && i < grads.length; i++) \
                grads.data[i] += (real)(dlines[r] * along(stage, grads.start + i, &rays[r])); \
        return CONEFIELD_OK; \
    }

PRECISION(float, ConefieldTile, ConefieldTileMut, ConefieldGrads, forward, backward, project, backproject)
PRECISION(double, ConefieldTile64, ConefieldTileMut64, ConefieldGrads64, forward_f64, backward_f64, project_f64,
          backproject_f64)

static const struct ConefieldMap MAP = {
    .size = sizeof MAP,
    .info = info,
    .parameter = parameter,
    .init = init,
    .forward = forward,
    .backward = backward,
    .forward_f64 = forward_f64,
    .backward_f64 = backward_f64,
    .project = project,
    .backproject = backproject,
    .project_f64 = project_f64,
    .backproject_f64 = backproject_f64,
};

static const struct ConefieldStage STAGES[] = {{
    .kind = CONEFIELD_LINE_FIELD,
    .name = TEXT("@name@"),
    .doc = TEXT("Gaussian blobs on a grid"),
    .schema = TEXT(
        "{\"type\":\"object\",\"properties\":{"
        "\"blobs\":{\"type\":\"integer\",\"minimum\":2,\"maximum\":64,\"default\":12,\"description\":\"Blobs along the cube's side.\"}}}"),
    .create = create,
    .destroy = destroy,
    .describe = describe,
    .map = &MAP,
}};

@plugin@
