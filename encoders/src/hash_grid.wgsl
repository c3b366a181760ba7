// Multi-resolution hash grid, as in hash_grid.rs, which adds `stage_FEATURES`, `stage_PRIMES` and the calls level by
// level.

struct stage_Level {
    // Position in cells: x·scale + 1/2, at most `top`.
    scale: f32,
    // The last cell of a side.
    last: f32,
    // Vertices per side if the level is indexed directly, else 0.
    side: u32,
    // Number of entries minus one, for hashed indices.
    mask: u32,
    // First parameter.
    start: u32,
}

struct stage_Cell {
    corner: vec3<u32>,
    fraction: vec3<f32>,
}

fn stage_locate(x: vec3<f32>, level: stage_Level) -> stage_Cell {
    let p = x * level.scale + 0.5;
    // A NaN coordinate counts as 0.
    let q = select(vec3<f32>(0.0), min(p, vec3<f32>(level.scale + 0.5)), p > vec3<f32>(0.0));
    let corner = min(floor(q), vec3<f32>(level.last));
    return stage_Cell(vec3<u32>(corner), q - corner);
}

// First parameter of corner `c`, which is further along x, y, z if bits 0, 1, 2 are set.
fn stage_entry(level: stage_Level, cell: stage_Cell, c: u32) -> u32 {
    let v = cell.corner + vec3<u32>(c & 1u, (c >> 1u) & 1u, c >> 2u);
    let direct = v.x + (v.y + v.z * level.side) * level.side;
    let h = v * stage_PRIMES;
    let hashed = (h.x ^ h.y ^ h.z) & level.mask;
    return level.start + select(hashed, direct, level.side != 0u) * stage_FEATURES;
}

fn stage_weights(cell: stage_Cell, c: u32) -> vec3<f32> {
    return select(1.0 - cell.fraction, cell.fraction, vec3<bool>((c & 1u) != 0u, (c & 2u) != 0u, (c & 4u) != 0u));
}

fn stage_level_forward(x: vec3<f32>, level: stage_Level) -> array<f32, stage_FEATURES> {
    let cell = stage_locate(x, level);
    var sum: array<f32, stage_FEATURES>;
    for (var c = 0u; c < 8u; c++) {
        let entry = stage_entry(level, cell, c);
        let w = stage_weights(cell, c);
        for (var f = 0u; f < stage_FEATURES; f++) {
            sum[f] += w.x * w.y * w.z * stage_param(entry + f);
        }
    }
    return sum;
}

// Adds to the gradients of the level's entries; returns the derivative with respect to the point.
fn stage_level_backward(x: vec3<f32>, level: stage_Level, dy: ptr<function, array<f32, stage_FEATURES>>) -> vec3<f32> {
    let cell = stage_locate(x, level);
    var slope = vec3<f32>(0.0);
    for (var c = 0u; c < 8u; c++) {
        let entry = stage_entry(level, cell, c);
        let w = stage_weights(cell, c);
        stage_features_grad(entry, w.x * w.y * w.z, dy);
        if stage_wants_dx {
            var along = 0.0;
            for (var f = 0u; f < stage_FEATURES; f++) {
                along += stage_param(entry + f) * (*dy)[f];
            }
            let sign = select(vec3<f32>(-1.0), vec3<f32>(1.0), vec3<bool>((c & 1u) != 0u, (c & 2u) != 0u, (c & 4u) != 0u));
            slope += along * sign * vec3<f32>(w.y * w.z, w.x * w.z, w.x * w.y);
        }
    }
    // Beyond the rim a position is clamped, whatever its value.
    let inside = (x <= vec3<f32>(1.0)) & (x * level.scale + 0.5 >= vec3<f32>(0.0));
    return select(vec3<f32>(0.0), slope * level.scale, inside);
}
