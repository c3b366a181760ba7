// A level of a hashed permutohedral lattice, as in permutohedral.rs, which adds `stage_PRIMES`.

struct stage_Level {
    scale: f32,
    // Pairs of vertices per side if the level is indexed directly, else 0.
    side: u32,
    // Number of entries minus one.
    last: u32,
    // First parameter.
    start: u32,
}

struct stage_Located {
    cell: vec3<u32>,
    // Number of the other two fractions that precede each one.
    rank: vec3<u32>,
    // Barycentric coordinates of the corners.
    weight: vec4<f32>,
}

const stage_CORNERS = 4u;

fn stage_locate(x: vec3<f32>, level: stage_Level) -> stage_Located {
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
    return stage_Located(vec3<u32>(cell), rank, vec4<f32>(1.0 - top, top - middle, middle - bottom, bottom));
}

// Along an axis two fractions grow. The weight of the corner that a fraction adds to grows with it, that of the one before
// falls.
fn stage_moved(at: stage_Located, d: u32, end: f32) -> stage_Located {
    var moved = at;
    moved.weight = vec4<f32>(0.0);
    for (var k = 1u; k < 3u; k++) {
        // Not by index: DirectX 12 writes no component of a vector whose number only the data give.
        let rank = vec4<u32>(at.rank[(d + k) % 3u]);
        let corner = vec4<u32>(0u, 1u, 2u, 3u);
        moved.weight += end * (vec4<f32>(corner == rank + 1u) - vec4<f32>(corner == rank));
    }
    return moved;
}

fn stage_corner(at: stage_Located, level: stage_Level, c: u32) -> stage_Corner {
    let k = at.cell + select(vec3<u32>(0u), vec3<u32>(1u), at.rank < vec3<u32>(c));
    let h = k * stage_PRIMES;
    let hashed = (h.x ^ h.y ^ h.z) & level.last;
    let v = 2u + k.x + k.y + k.z - 2u * k;
    let half = v >> vec3<u32>(1u);
    let pair = (half.x * level.side + half.y) * level.side + half.z;
    let direct = min(2u * pair + (v.x & 1u), level.last);
    let entry = level.start + select(hashed, direct, level.side != 0u) * stage_FEATURES;
    return stage_Corner(entry, at.weight[c]);
}
