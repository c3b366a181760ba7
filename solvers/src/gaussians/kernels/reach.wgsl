// The boxes of points that the Gaussians reach.
fn range(low: f32, high: f32, count: u32) -> u32 {
    let first = clamp(ceil(low - grid.slack), 0.0, f32(count));
    let end = clamp(floor(high + 0.01) + 1.0, first, f32(count));
    return u32(first) | u32(end) << 16u;
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = id.x; i < arrayLength(&shapes); i += groups.x * 64u) {
        let s = shapes[i];
        boxes[i] = vec4<u32>();
        if s.density == 0.0 {
            continue;
        }
        // Σ_jj = Σ_k (R_jk s_k)² with R_jk = M_kj s_k.
        let a = s.m0 * s.s0 * s.s0;
        let b = s.m1 * s.s1 * s.s1;
        let c = s.m2 * s.s2 * s.s2;
        let reach = sqrt(CUT * (a * a + b * b + c * c));
        let low = (s.centre - reach - grid.first) / grid.spacing;
        let high = (s.centre + reach - grid.first) / grid.spacing;
        let x = range(low.x, high.x, grid.shape.x);
        let y = range(low.y, high.y, grid.shape.y);
        let z = range(low.z, high.z, grid.shape.z);
        if (x & 0xffffu) < x >> 16u && (y & 0xffffu) < y >> 16u && (z & 0xffffu) < z >> 16u {
            boxes[i] = vec4<u32>(x, y, z, 0u);
        }
    }
}
