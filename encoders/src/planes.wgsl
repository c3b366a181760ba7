// Planes of a level, as in planes.rs, which adds `stage_LINES`: one orientation with a line, or all three planes without.

struct stage_Level {
    cells: u32,
    // The first.
    orientation: u32,
    // First parameter.
    start: u32,
}

struct stage_Located {
    cell: vec3<f32>,
    // Position within the cell.
    t: vec3<f32>,
}

struct stage_Place {
    // Parameter of the first corner on the plane, and of the first node on the line.
    corner: u32,
    node: u32,
    // Offset from a corner to the next along the plane's first axis.
    stride: u32,
    // Weights of both nodes along the plane's two axes and along the line.
    a: vec2<f32>,
    b: vec2<f32>,
    c: vec2<f32>,
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

fn stage_locate(x: vec3<f32>, level: stage_Level) -> stage_Located {
    let cells = vec3<f32>(f32(level.cells));
    let p = x * cells;
    // A NaN coordinate counts as 0.
    let q = select(vec3<f32>(0.0), min(p, cells), p > vec3<f32>(0.0));
    let cell = min(floor(q), cells - 1.0);
    return stage_Located(cell, q - cell);
}

fn stage_moved(at: stage_Located, d: u32, end: f32) -> stage_Located {
    var moved = at;
    moved.t = select(at.t, vec3<f32>(end), vec3<u32>(0u, 1u, 2u) == vec3<u32>(d));
    return moved;
}

fn stage_place(at: stage_Located, level: stage_Level, orientation: u32) -> stage_Place {
    let c = vec3<u32>(stage_turn(at.cell, orientation));
    let t = stage_turn(at.t, orientation);
    let nodes = level.cells + 1u;
    let plane = nodes * nodes * stage_FEATURES;
    let start = level.start + (orientation - level.orientation) * plane;
    let corner = start + (c.x * nodes + c.y) * stage_FEATURES;
    let node = start + plane + c.z * stage_FEATURES;
    let s = 1.0 - t;
    let weights = array<vec2<f32>, 3>(vec2<f32>(s.x, t.x), vec2<f32>(s.y, t.y), vec2<f32>(s.z, t.z));
    return stage_Place(corner, node, nodes * stage_FEATURES, weights[0], weights[1], weights[2]);
}

// Feature `f` on the plane.
fn stage_plane(at: stage_Place, f: u32) -> f32 {
    let corner = at.corner + f;
    let near = at.b.x * stage_param(corner) + at.b.y * stage_param(corner + stage_FEATURES);
    let far = at.b.x * stage_param(corner + at.stride) + at.b.y * stage_param(corner + at.stride + stage_FEATURES);
    return at.a.x * near + at.a.y * far;
}

fn stage_line(at: stage_Place, f: u32) -> f32 {
    if !stage_LINES {
        return 1.0;
    }
    return at.c.x * stage_param(at.node + f) + at.c.y * stage_param(at.node + stage_FEATURES + f);
}

fn stage_last(level: stage_Level) -> u32 {
    return select(3u, level.orientation + 1u, stage_LINES);
}

fn stage_level_value(at: stage_Located, level: stage_Level) -> array<f32, stage_FEATURES> {
    var sum: array<f32, stage_FEATURES>;
    for (var o = level.orientation; o < stage_last(level); o++) {
        let place = stage_place(at, level, o);
        for (var f = 0u; f < stage_FEATURES; f++) {
            sum[f] += stage_plane(place, f) * stage_line(place, f);
        }
    }
    return sum;
}

fn stage_level_backward(at: stage_Located, level: stage_Level, dy: ptr<function, array<f32, stage_FEATURES>>) {
    for (var o = level.orientation; o < stage_last(level); o++) {
        let place = stage_place(at, level, o);
        for (var f = 0u; f < stage_FEATURES; f++) {
            let d = (*dy)[f];
            let line = stage_line(place, f);
            let corner = place.corner + f;
            stage_grad(corner, place.a.x * place.b.x * d * line);
            stage_grad(corner + stage_FEATURES, place.a.x * place.b.y * d * line);
            stage_grad(corner + place.stride, place.a.y * place.b.x * d * line);
            stage_grad(corner + place.stride + stage_FEATURES, place.a.y * place.b.y * d * line);
            if stage_LINES {
                let plane = stage_plane(place, f);
                stage_grad(place.node + f, place.c.x * d * plane);
                stage_grad(place.node + stage_FEATURES + f, place.c.y * d * plane);
            }
        }
    }
}
