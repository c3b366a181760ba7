// A level of a hash grid, as in hash_grid.rs, which adds `stage_PRIMES`.

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

struct stage_Located {
    corner: vec3<u32>,
    fraction: vec3<f32>,
}

const stage_CORNERS = 8u;

fn stage_locate(x: vec3<f32>, level: stage_Level) -> stage_Located {
    let p = x * level.scale + 0.5;
    // A NaN coordinate counts as 0.
    let q = select(vec3<f32>(0.0), min(p, vec3<f32>(level.scale + 0.5)), p > vec3<f32>(0.0));
    let corner = min(floor(q), vec3<f32>(level.last));
    return stage_Located(vec3<u32>(corner), q - corner);
}

fn stage_moved(at: stage_Located, d: u32, end: f32) -> stage_Located {
    var moved = at;
    moved.fraction = select(at.fraction, vec3<f32>(end), vec3<u32>(0u, 1u, 2u) == vec3<u32>(d));
    return moved;
}

// Corner `c` is further along x, y, z if bits 0, 1, 2 are set.
fn stage_corner(at: stage_Located, level: stage_Level, c: u32) -> stage_Corner {
    let v = at.corner + vec3<u32>(c & 1u, (c >> 1u) & 1u, c >> 2u);
    let direct = v.x + (v.y + v.z * level.side) * level.side;
    let h = v * stage_PRIMES;
    let hashed = (h.x ^ h.y ^ h.z) & level.mask;
    let entry = level.start + select(hashed, direct, level.side != 0u) * stage_FEATURES;
    let w = select(1.0 - at.fraction, at.fraction, vec3<bool>((c & 1u) != 0u, (c & 2u) != 0u, (c & 4u) != 0u));
    return stage_Corner(entry, w.x * w.y * w.z);
}
