// The line integrals of a view, their loss, and its derivative with respect to each. A group takes 16 × 16 pixels, a lane four
// of a column; footprints pass through workgroup memory.
var<workgroup> held: array<Footprint, 64>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    for (var tile = id.x; tile < bins.count; tile += groups.x) {
        let column = tile % bins.shape.z * 16u + lane % 16u;
        let rows = tile / bins.shape.z * 16u + lane / 16u + vec4<u32>(0u, 4u, 8u, 12u);
        let begin = min(starts[tile], bins.room);
        let end = min(starts[tile + 1u], bins.room);
        var sums = vec4<f32>();
        for (var at = begin; at < end; at += 64u) {
            workgroupBarrier();
            if at + lane < end {
                held[lane] = seen[entries[at + lane]];
            }
            workgroupBarrier();
            let count = min(64u, end - at);
            for (var k = 0u; k < count; k++) {
                let f = held[k];
                let du = f32(column) - f.middle.x;
                let dv = vec4<f32>(rows) - f.middle.y;
                let a = square(f, du, dv);
                let x = numerator(f, du, dv) / a;
                let value = f.a3_weight.w * inverseSqrt(a) * exp(-0.5 * x);
                sums += select(vec4<f32>(), value, (x <= vec4<f32>(CUT)) & (a > vec4<f32>()));
            }
        }
        var loss = 0.0;
        for (var k = 0u; k < 4u; k++) {
            if column < view.columns && rows[k] < view.rows {
                let pixel = rows[k] * view.columns + column;
                let ray = ray_length(column, rows[k]);
                let line = sums[k] * ray;
                let d = loss_at(line, wanted[pixel]);
                found[pixel] = line;
                gradient[pixel] = d.y * view.scale * select(ray, 1.0, SSIM);
                loss += d.x * view.scale;
            }
        }
        let all = total(lane, loss);
        if lane == 0u {
            partial[tile].x = all;
        }
        workgroupBarrier();
    }
}
