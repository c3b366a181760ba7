// Trilinear interpolation on a regular grid over the unit cube, as in conefield_core::trilinear.

struct stage_Located {
    // Entry of the cell's first corner.
    base: u32,
    fraction: vec3<f32>,
    // Derivative of the position in cells with respect to the point; 0 where it was clamped. Levels of encoders have
    // their own.
    slope: vec3<f32>,
}

// `side`: vertices per axis; `strides`: offsets to the next vertex.
fn stage_trilinear_locate(x: vec3<f32>, side: vec3<u32>, strides: vec3<u32>, scale: vec3<f32>, shift: f32) -> stage_Located {
    let top = vec3<f32>(side - 1u);
    let last = max(top - 1.0, vec3<f32>(0.0));
    let p = x * scale + shift;
    let inside = (p >= vec3<f32>(0.0)) & (p <= top);
    // A NaN coordinate counts as 0.
    let q = select(vec3<f32>(0.0), min(p, top), p > vec3<f32>(0.0));
    let cell = min(floor(q), last);
    return stage_Located(dot(vec3<u32>(cell), strides), q - cell, select(vec3<f32>(0.0), scale, inside));
}

// Entry of corner `c`, which is further along x, y, z if bits 0, 1, 2 are set.
fn stage_trilinear_index(l: stage_Located, strides: vec3<u32>, c: u32) -> u32 {
    return l.base + dot(vec3<u32>(c & 1u, (c >> 1u) & 1u, c >> 2u), strides);
}

fn stage_trilinear_weight(l: stage_Located, c: u32) -> f32 {
    let f = select(1.0 - l.fraction, l.fraction, vec3<bool>((c & 1u) != 0u, (c & 2u) != 0u, (c & 4u) != 0u));
    return f.x * f.y * f.z;
}

// The same place moved to `end` 0 or 1 of the cell along axis `d`. A value is linear in between: at end 1, less that at end
// 0, it is the derivative with respect to the position in cells.
fn stage_moved(l: stage_Located, d: u32, end: f32) -> stage_Located {
    var moved = l;
    moved.fraction = select(l.fraction, vec3<f32>(end), vec3<u32>(0u, 1u, 2u) == vec3<u32>(d));
    return moved;
}
