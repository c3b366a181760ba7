// Moments of a block's derivatives over the points of each Gaussian, a group for each: of w = dμ·exp(-½|Md|²), times 1, d, and
// the upper half of d·dᵀ.
@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    for (var i = id.x; i < arrayLength(&boxes); i += groups.x) {
        let box = boxes[i].xyz;
        if box.x == 0u {
            continue;
        }
        let begin = box & vec3<u32>(0xffffu);
        let size = max((box >> vec3<u32>(16u)) - begin, vec3<u32>(1u));
        let count = size.x * size.y * size.z;
        let s = shapes[i];
        var a0 = vec4<f32>();
        var a1 = vec4<f32>();
        var a2 = vec4<f32>();
        for (var k = lane; k < count; k += 64u) {
            let p = begin + vec3<u32>(k / (size.y * size.z), k / size.z % size.y, k % size.z);
            let d = grid.first + vec3<f32>(p) * grid.spacing - s.centre;
            let m = to_deviations(s, d);
            let e = dot(m, m);
            if e <= CUT {
                let w = by[(p.x * grid.shape.y + p.y) * grid.shape.z + p.z] * exp(-0.5 * e);
                a0 += w * vec4<f32>(1.0, d);
                a1 += w * vec4<f32>(d.x * d, d.y * d.y);
                a2 += w * vec4<f32>(d.y * d.z, d.z * d.z, 0.0, 0.0);
            }
        }
        keep_moments(i, lane, array<vec4<f32>, 3>(a0, a1, a2));
    }
}
