// Pyramid of cubic B-splines, as in b_spline_grid.rs, which adds `stage_FEATURES` and the calls level by level.

struct stage_Level {
    cells: u32,
    // Coefficients per side.
    side: u32,
    // First parameter.
    start: u32,
}

struct stage_Located {
    // First parameter of the first coefficient that affects the cell.
    first: u32,
    // Position within the cell.
    t: vec3<f32>,
}

fn stage_locate(x: vec3<f32>, level: stage_Level) -> stage_Located {
    let cells = vec3<f32>(f32(level.cells));
    let p = x * cells;
    // A NaN coordinate counts as 0.
    let q = select(vec3<f32>(0.0), min(p, cells), p > vec3<f32>(0.0));
    let cell = min(floor(q), cells - 1.0);
    let c = vec3<u32>(cell);
    let entry = (c.x * level.side + c.y) * level.side + c.z;
    return stage_Located(level.start + entry * stage_FEATURES, q - cell);
}

// The four B-splines that affect a cell.
fn stage_splines(t: f32) -> vec4<f32> {
    let rest = 1.0 - t;
    let first = rest * rest * rest / 6.0;
    let second = ((3.0 * t - 6.0) * t * t + 4.0) / 6.0;
    let last = t * t * t / 6.0;
    return vec4<f32>(first, second, 1.0 - first - second - last, last);
}

fn stage_spline_slopes(t: f32) -> vec4<f32> {
    let rest = 1.0 - t;
    let first = -0.5 * rest * rest;
    let second = (1.5 * t - 2.0) * t;
    let last = 0.5 * t * t;
    return vec4<f32>(first, second, -first - second - last, last);
}

fn stage_level_forward(x: vec3<f32>, level: stage_Level) -> array<f32, stage_FEATURES> {
    let at = stage_locate(x, level);
    var a = stage_splines(at.t.x);
    var b = stage_splines(at.t.y);
    var c = stage_splines(at.t.z);
    var sum: array<f32, stage_FEATURES>;
    for (var n = 0u; n < 64u; n++) {
        let i = n >> 4u;
        let j = (n >> 2u) & 3u;
        let k = n & 3u;
        let entry = at.first + ((i * level.side + j) * level.side + k) * stage_FEATURES;
        let w = a[i] * b[j] * c[k];
        for (var f = 0u; f < stage_FEATURES; f++) {
            sum[f] += w * stage_param(entry + f);
        }
    }
    return sum;
}

// Adds to the gradients of the level's coefficients; returns the derivative with respect to the point.
fn stage_level_backward(x: vec3<f32>, level: stage_Level, dy: ptr<function, array<f32, stage_FEATURES>>) -> vec3<f32> {
    let at = stage_locate(x, level);
    var a = stage_splines(at.t.x);
    var b = stage_splines(at.t.y);
    var c = stage_splines(at.t.z);
    var da = stage_spline_slopes(at.t.x);
    var db = stage_spline_slopes(at.t.y);
    var dc = stage_spline_slopes(at.t.z);
    var slope = vec3<f32>(0.0);
    for (var n = 0u; n < 64u; n++) {
        let i = n >> 4u;
        let j = (n >> 2u) & 3u;
        let k = n & 3u;
        let entry = at.first + ((i * level.side + j) * level.side + k) * stage_FEATURES;
        let w = a[i] * b[j] * c[k];
        stage_features_grad(entry, w, dy);
        if stage_wants_dx {
            var along = 0.0;
            for (var f = 0u; f < stage_FEATURES; f++) {
                along += stage_param(entry + f) * (*dy)[f];
            }
            slope += along * vec3<f32>(da[i] * b[j] * c[k], a[i] * db[j] * c[k], a[i] * b[j] * dc[k]);
        }
    }
    // Beyond the rim a position is clamped, whatever its value.
    let inside = (x >= vec3<f32>(0.0)) & (x <= vec3<f32>(1.0));
    return select(vec3<f32>(0.0), slope * f32(level.cells), inside);
}
