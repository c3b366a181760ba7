// Moments of a view's derivatives over the pixels of each Gaussian, a group for each: of w = dA·a^(-3/2)·exp(-N/2a) and of
// w·(1 - N/a), times 1, du, dv, du², du·dv, dv².
@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    for (var i = id.x; i < arrayLength(&boxes); i += groups.x) {
        let box = boxes[i];
        let rows = vec2<u32>(box.y & 0xffffu, box.y >> 16u);
        let columns = vec2<u32>(box.z & 0xffffu, box.z >> 16u);
        let width = max(columns.y - columns.x, 1u);
        let count = width * (rows.y - rows.x);
        let f = seen[i];
        var a0 = vec4<f32>();
        var a1 = vec4<f32>();
        var a2 = vec4<f32>();
        for (var k = lane; k < count; k += 64u) {
            let row = rows.x + k / width;
            let column = columns.x + k % width;
            let du = f32(column) - f.middle.x;
            let dv = f32(row) - f.middle.y;
            let a = square(f, du, vec4<f32>(dv)).x;
            let x = numerator(f, du, vec4<f32>(dv)).x / a;
            if x <= CUT && a > 0.0 {
                let root = inverseSqrt(a);
                let w = gradient[row * view.columns + column] * root * root * root * exp(-0.5 * x);
                let l = w * (1.0 - x);
                a0 += w * vec4<f32>(1.0, du, dv, du * du);
                a1 += vec4<f32>(w * du * dv, w * dv * dv, l, l * du);
                a2 += l * vec4<f32>(dv, du * du, du * dv, dv * dv);
            }
        }
        keep_moments(i, lane, array<vec4<f32>, 3>(a0, a1, a2));
    }
}
