// Derivatives with respect to the shapes from the moments of a block.
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = id.x; i < arrayLength(&shapes); i += groups.x * 64u) {
        if boxes[i].x == 0u {
            continue;
        }
        let s = shapes[i];
        let q0 = moments[3u * i];
        let q1 = moments[3u * i + 1u];
        let q2 = moments[3u * i + 2u];
        let spread = mat3x3<f32>(q1.xyz, vec3<f32>(q1.y, q1.w, q2.x), vec3<f32>(q1.z, q2.x, q2.y));
        let centre = s.density * from_deviations(s, to_deviations(s, q0.yzw));
        let d = -s.density;
        learn(i, s, false, centre, d * (spread * s.m0), d * (spread * s.m1), d * (spread * s.m2), q0.x);
    }
}
