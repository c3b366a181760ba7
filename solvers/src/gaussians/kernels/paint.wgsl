// Values at the points of a grid: a group takes 4 × 4 × 4 of them.
var<workgroup> held: array<Shape, 64>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    for (var tile = id.x; tile < bins.count; tile += groups.x) {
        let bin = vec3<u32>(tile / (bins.shape.y * bins.shape.z), tile / bins.shape.z % bins.shape.y, tile % bins.shape.z);
        let point = bin * 4u + vec3<u32>(lane / 16u, lane / 4u % 4u, lane % 4u);
        let place = grid.first + vec3<f32>(point) * grid.spacing;
        let begin = min(starts[tile], bins.room);
        let end = min(starts[tile + 1u], bins.room);
        var sum = 0.0;
        for (var at = begin; at < end; at += 64u) {
            workgroupBarrier();
            if at + lane < end {
                held[lane] = shapes[entries[at + lane]];
            }
            workgroupBarrier();
            let count = min(64u, end - at);
            for (var k = 0u; k < count; k++) {
                let s = held[k];
                let m = to_deviations(s, place - s.centre);
                let e = dot(m, m);
                sum += select(0.0, s.density * exp(-0.5 * e), e <= CUT);
            }
        }
        if all(point < grid.shape) {
            values[(point.x * grid.shape.y + point.y) * grid.shape.z + point.z] = sum;
        }
        workgroupBarrier();
    }
}
