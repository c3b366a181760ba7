// The penalty of a block, and its derivative with respect to the value at each point.
fn prior_value(p: u32) -> f32 {
    return values[p];
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    var sum = 0.0;
    for (var p = id.x * 64u + lane; p < grid.count; p += groups.x * 64u) {
        let v = prior_at(p);
        sum += grid.scale * v.x;
        by[p] = grid.scale * v.y;
    }
    let all = total(lane, sum);
    if lane == 0u {
        partial[id.x] = vec2<f32>(all, 0.0);
    }
}
