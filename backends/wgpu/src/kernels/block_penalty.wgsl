// A prior's penalty of each block and its derivative with respect to every point: one group per block.

var<private> base: u32;

fn prior_value(p: u32) -> f32 {
    return mu[base + p];
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let each = step.edge * step.edge * step.edge;
    base = step.ray_rows + step.point_rows + group.x * each;
    var sum = 0.0;
    for (var p = lane; p < each; p += 64u) {
        let found = prior_at(p);
        sum += found.x;
        dmu[base + p] = found.y * step.block_scale;
    }
    let whole = total(lane, sum);
    if lane == 0u {
        losses[step.rays + (step.point_rows + 63u) / 64u + group.x] = whole;
    }
}
