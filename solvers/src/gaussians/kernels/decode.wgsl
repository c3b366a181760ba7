// log(1 + e) loses the digits of a small e, so that a series takes its place.
fn softplus(x: f32) -> f32 {
    let e = exp(-abs(x));
    let series = e * (1.0 - e * (1.0 / 2.0 - e * (1.0 / 3.0 - e * (1.0 / 4.0 - e * (1.0 / 5.0 - e / 6.0)))));
    return max(x, 0.0) + select(log(1.0 + e), series, e < 0.1);
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = id.x; i < arrayLength(&shapes); i += groups.x * 64u) {
        let p = i * 11u;
        var out = Shape();
        let raw = params[p + 10u];
        // NaN is no free place.
        if !(raw <= FREE) {
            let s = exp(vec3<f32>(params[p + 3u], params[p + 4u], params[p + 5u]));
            let q = unit(vec4<f32>(params[p + 6u], params[p + 7u], params[p + 8u], params[p + 9u])).turn;
            let w = q.x;
            let x = q.y;
            let y = q.z;
            let z = q.w;
            // Row k of M is column k of the rotation over s_k.
            out.centre = vec3<f32>(params[p], params[p + 1u], params[p + 2u]);
            out.density = softplus(raw);
            out.m0 = vec3<f32>(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)) / s.x;
            out.m1 = vec3<f32>(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)) / s.y;
            out.m2 = vec3<f32>(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)) / s.z;
            out.s0 = s.x;
            out.s1 = s.y;
            out.s2 = s.z;
        }
        shapes[i] = out;
    }
}
