// Features of planes, as in planes.rs, which adds `stage_FEATURES`, `stage_LINES` and the calls level by level: one
// call per orientation with lines, one call for all three planes without.

struct stage_Level {
    cells: u32,
    // The first.
    orientation: u32,
    // First parameter.
    start: u32,
}

struct stage_Place {
    // Parameter of the first corner on the plane, and of the first node on the line.
    corner: u32,
    node: u32,
    // Offset from a corner to the next along the plane's first axis.
    stride: u32,
    // Position within the cell, along the plane's two axes and along the line.
    t: vec3<f32>,
}

// A point's coordinates along the two axes of a plane and along its line.
fn stage_turn(x: vec3<f32>, orientation: u32) -> vec3<f32> {
    if orientation == 0u {
        return x;
    }
    if orientation == 1u {
        return x.xzy;
    }
    return x.yzx;
}

// The inverse of the above.
fn stage_turn_back(x: vec3<f32>, orientation: u32) -> vec3<f32> {
    if orientation == 0u {
        return x;
    }
    if orientation == 1u {
        return x.xzy;
    }
    return x.zxy;
}

fn stage_place(x: vec3<f32>, level: stage_Level, orientation: u32) -> stage_Place {
    let cells = vec3<f32>(f32(level.cells));
    let p = stage_turn(x, orientation) * cells;
    // A NaN coordinate counts as 0.
    let q = select(vec3<f32>(0.0), min(p, cells), p > vec3<f32>(0.0));
    let cell = min(floor(q), cells - 1.0);
    let c = vec3<u32>(cell);
    let nodes = level.cells + 1u;
    let plane = nodes * nodes * stage_FEATURES;
    let start = level.start + (orientation - level.orientation) * plane;
    let corner = start + (c.x * nodes + c.y) * stage_FEATURES;
    return stage_Place(corner, start + plane + c.z * stage_FEATURES, nodes * stage_FEATURES, q - cell);
}

// Feature `f` on the plane, with the weights `a` and `b` of nodes along its axes.
fn stage_plane(at: stage_Place, a: vec2<f32>, b: vec2<f32>, f: u32) -> f32 {
    let near = b.x * stage_param(at.corner + f) + b.y * stage_param(at.corner + stage_FEATURES + f);
    let far = b.x * stage_param(at.corner + at.stride + f) + b.y * stage_param(at.corner + at.stride + stage_FEATURES + f);
    return a.x * near + a.y * far;
}

fn stage_line(at: stage_Place, c: vec2<f32>, f: u32) -> f32 {
    if !stage_LINES {
        return 1.0;
    }
    return c.x * stage_param(at.node + f) + c.y * stage_param(at.node + stage_FEATURES + f);
}

fn stage_weights(t: f32) -> vec2<f32> {
    return vec2<f32>(1.0 - t, t);
}

fn stage_last(level: stage_Level) -> u32 {
    return select(3u, level.orientation + 1u, stage_LINES);
}

fn stage_level_forward(x: vec3<f32>, level: stage_Level) -> array<f32, stage_FEATURES> {
    var sum: array<f32, stage_FEATURES>;
    for (var o = level.orientation; o < stage_last(level); o++) {
        let at = stage_place(x, level, o);
        for (var f = 0u; f < stage_FEATURES; f++) {
            let plane = stage_plane(at, stage_weights(at.t.x), stage_weights(at.t.y), f);
            sum[f] += plane * stage_line(at, stage_weights(at.t.z), f);
        }
    }
    return sum;
}

// Adds to the gradients of the planes and lines; returns the derivative with respect to the point.
fn stage_level_backward(x: vec3<f32>, level: stage_Level, dy: ptr<function, array<f32, stage_FEATURES>>) -> vec3<f32> {
    let ends = vec2<f32>(-1.0, 1.0);
    var slope = vec3<f32>(0.0);
    for (var o = level.orientation; o < stage_last(level); o++) {
        let at = stage_place(x, level, o);
        let a = stage_weights(at.t.x);
        let b = stage_weights(at.t.y);
        let c = stage_weights(at.t.z);
        var along = vec3<f32>(0.0);
        for (var f = 0u; f < stage_FEATURES; f++) {
            let d = (*dy)[f];
            let line = stage_line(at, c, f);
            let corner = at.corner + f;
            stage_grad(corner, a.x * b.x * d * line);
            stage_grad(corner + stage_FEATURES, a.x * b.y * d * line);
            stage_grad(corner + at.stride, a.y * b.x * d * line);
            stage_grad(corner + at.stride + stage_FEATURES, a.y * b.y * d * line);
            let plane = stage_plane(at, a, b, f);
            if stage_LINES {
                stage_grad(at.node + f, c.x * d * plane);
                stage_grad(at.node + stage_FEATURES + f, c.y * d * plane);
            }
            if stage_wants_dx {
                along.x += d * line * stage_plane(at, ends, b, f);
                along.y += d * line * stage_plane(at, a, ends, f);
                if stage_LINES {
                    along.z += d * plane * stage_line(at, ends, f);
                }
            }
        }
        slope += stage_turn_back(along, o);
    }
    // Beyond the rim a position is clamped, whatever its value.
    let inside = (x >= vec3<f32>(0.0)) & (x <= vec3<f32>(1.0));
    return select(vec3<f32>(0.0), slope * f32(level.cells), inside);
}
