// Derivatives with respect to the shapes from the moments of a view: those of the module `view`, in which the terms that grow with
// the distance of the source cancel each other; here they are left out.
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = id.x; i < arrayLength(&shapes); i += groups.x * 64u) {
        if boxes[i].x == 0u {
            rest(i, view.opens == 1u);
            continue;
        }
        let s = shapes[i];
        let g = seen_by(view, s);
        let q0 = moments[3u * i];
        let q1 = moments[3u * i + 1u];
        let q2 = moments[3u * i + 2u];
        let p = array<f32, 6>(q0.x, q0.y, q0.z, q0.w, q1.x, q1.y);
        let l = array<f32, 6>(q1.z, q1.w, q2.x, q2.y, q2.z, q2.w);
        let c = g.z / g.t;
        let d = g.y / g.t;
        let density = p[0] * dot(c, c) + 2.0 * (p[1] * dot(c, g.mu) + p[2] * dot(c, g.mv) + p[4] * dot(g.mu, g.mv))
            + p[3] * dot(g.mu, g.mu) + p[5] * dot(g.mv, g.mv);
        // Σ w(1 - N/a)·MD·Dᵀ.
        let f0 = l[0] * d + l[1] * view.u + l[2] * view.v;
        let f1 = l[1] * d + l[3] * view.u + l[4] * view.v;
        let f2 = l[2] * d + l[4] * view.u + l[5] * view.v;
        // Σ w·|z|²·(part of MD across z)·(D without its part along y)ᵀ.
        let u = view.u - g.along.x * g.y;
        let v = view.v - g.along.y * g.y;
        let b1 = g.zz * (p[3] * u + p[4] * v);
        let b2 = g.zz * (p[4] * u + p[5] * v);
        // Σ w·|part of MD across z|².
        let across = p[3] * dot(g.pu, g.pu) + 2.0 * p[4] * dot(g.pu, g.pv) + p[5] * dot(g.pv, g.pv);
        let k = -s.density * ROOT_TAU;
        let row0 = c.x * f0 + g.mu.x * f1 + g.mv.x * f2 + g.pu.x * b1 + g.pv.x * b2 + across * g.z.x * g.y;
        let row1 = c.y * f0 + g.mu.y * f1 + g.mv.y * f2 + g.pu.y * b1 + g.pv.y * b2 + across * g.z.y * g.y;
        let row2 = c.z * f0 + g.mu.z * f1 + g.mv.z * f2 + g.pu.z * b1 + g.pv.z * b2 + across * g.z.z * g.y;
        let alpha = vec2<f32>(p[1], p[2]) / g.t
            + vec2<f32>(p[3] * g.along.x + p[4] * g.along.y, p[4] * g.along.x + p[5] * g.along.y);
        let by = across * g.z - g.zz * (alpha.x * g.pu + alpha.y * g.pv);
        learn(i, s, view.opens == 1u, k * from_deviations(s, by), k * row0, k * row1, k * row2, ROOT_TAU * density);
    }
}
