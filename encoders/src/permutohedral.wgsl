// Multi-resolution hash of a permutohedral lattice, as in permutohedral.rs, which adds `stage_FEATURES`, `stage_PRIMES`
// and the calls level by level.

struct stage_Level {
    scale: f32,
    // Pairs of vertices per side if the level is indexed directly, else 0.
    side: u32,
    // Number of entries minus one.
    last: u32,
    // First parameter.
    start: u32,
}

struct stage_Simplex {
    cell: vec3<u32>,
    // Number of the other two fractions that precede each one.
    rank: vec3<u32>,
    // Barycentric coordinates of the corners.
    weight: vec4<f32>,
}

fn stage_locate(x: vec3<f32>, level: stage_Level) -> stage_Simplex {
    // A NaN coordinate counts as 0.
    let p = select(vec3<f32>(0.0), min(x, vec3<f32>(1.0)), x > vec3<f32>(0.0));
    let u = (p.yxx + p.zzy) * level.scale;
    let cell = floor(u);
    let f = u - cell;
    let fg = u32(f.x >= f.y);
    let fh = u32(f.x >= f.z);
    let gh = u32(f.y >= f.z);
    let rank = vec3<u32>(2u - fg - fh, 1u + fg - gh, fh + gh);
    let top = max(max(f.x, f.y), f.z);
    let bottom = min(min(f.x, f.y), f.z);
    let middle = max(min(f.x, f.y), min(max(f.x, f.y), f.z));
    return stage_Simplex(vec3<u32>(cell), rank, vec4<f32>(1.0 - top, top - middle, middle - bottom, bottom));
}

// First parameter of corner `c`.
fn stage_entry(level: stage_Level, at: stage_Simplex, c: u32) -> u32 {
    let k = at.cell + select(vec3<u32>(0u), vec3<u32>(1u), at.rank < vec3<u32>(c));
    let h = k * stage_PRIMES;
    let hashed = (h.x ^ h.y ^ h.z) & level.last;
    let v = 2u + k.x + k.y + k.z - 2u * k;
    let half = v >> vec3<u32>(1u);
    let pair = (half.x * level.side + half.y) * level.side + half.z;
    let direct = min(2u * pair + (v.x & 1u), level.last);
    return level.start + select(hashed, direct, level.side != 0u) * stage_FEATURES;
}

fn stage_level_forward(x: vec3<f32>, level: stage_Level) -> array<f32, stage_FEATURES> {
    let at = stage_locate(x, level);
    var sum: array<f32, stage_FEATURES>;
    for (var c = 0u; c < 4u; c++) {
        let entry = stage_entry(level, at, c);
        for (var f = 0u; f < stage_FEATURES; f++) {
            sum[f] += at.weight[c] * stage_param(entry + f);
        }
    }
    return sum;
}

// Adds to the gradients of the level's entries; returns the derivative with respect to the point.
fn stage_level_backward(x: vec3<f32>, level: stage_Level, dy: ptr<function, array<f32, stage_FEATURES>>) -> vec3<f32> {
    let at = stage_locate(x, level);
    var along: array<f32, 4>;
    for (var c = 0u; c < 4u; c++) {
        let entry = stage_entry(level, at, c);
        stage_features_grad(entry, at.weight[c], dy);
        if stage_wants_dx {
            for (var f = 0u; f < stage_FEATURES; f++) {
                along[c] += stage_param(entry + f) * (*dy)[f];
            }
        }
    }
    // With respect to a fraction: the corner that it adds to, minus the one before.
    var by: vec3<f32>;
    for (var d = 0u; d < 3u; d++) {
        by[d] = along[at.rank[d] + 1u] - along[at.rank[d]];
    }
    // Beyond the rim a position is clamped, whatever its value.
    let inside = (x >= vec3<f32>(0.0)) & (x <= vec3<f32>(1.0));
    return select(vec3<f32>(0.0), (by.yxx + by.zzy) * level.scale, inside);
}
