// A level of cubic B-splines, as in b_spline_grid.rs.

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
    // Weights of the four coefficients along each axis.
    weights: array<vec4<f32>, 3>,
}

const stage_CORNERS = 64u;

fn stage_locate(x: vec3<f32>, level: stage_Level) -> stage_Located {
    let cells = vec3<f32>(f32(level.cells));
    let p = x * cells;
    // A NaN coordinate counts as 0.
    let q = select(vec3<f32>(0.0), min(p, cells), p > vec3<f32>(0.0));
    let cell = min(floor(q), cells - 1.0);
    let c = vec3<u32>(cell);
    let first = level.start + ((c.x * level.side + c.y) * level.side + c.z) * stage_FEATURES;
    let t = q - cell;
    return stage_Located(first, t, array<vec4<f32>, 3>(stage_splines(t.x), stage_splines(t.y), stage_splines(t.z)));
}

// The four B-splines that affect a cell.
fn stage_splines(t: f32) -> vec4<f32> {
    let rest = 1.0 - t;
    let first = rest * rest * rest / 6.0;
    let second = ((3.0 * t - 6.0) * t * t + 4.0) / 6.0;
    let last = t * t * t / 6.0;
    return vec4<f32>(first, second, 1.0 - first - second - last, last);
}

// Their derivatives take the place of the weights.
fn stage_moved(at: stage_Located, d: u32, end: f32) -> stage_Located {
    let t = at.t[d];
    let rest = 1.0 - t;
    let first = -0.5 * rest * rest;
    let second = (1.5 * t - 2.0) * t;
    let last = 0.5 * t * t;
    var moved = at;
    moved.weights[d] = end * vec4<f32>(first, second, -first - second - last, last);
    return moved;
}

fn stage_corner(at: stage_Located, level: stage_Level, c: u32) -> stage_Corner {
    let i = c >> 4u;
    let j = (c >> 2u) & 3u;
    let k = c & 3u;
    let entry = at.first + ((i * level.side + j) * level.side + k) * stage_FEATURES;
    return stage_Corner(entry, at.weights[0][i] * at.weights[1][j] * at.weights[2][k]);
}
