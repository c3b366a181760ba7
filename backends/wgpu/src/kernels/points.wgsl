// The loss of known points and its derivative: 64 points per group.
@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = group.x * 64u + lane;
    let row = step.ray_rows + i;
    var found = vec2<f32>(0.0);
    if i < step.point_rows {
        found = loss_at(mu[row], targets[i]);
        dmu[row] = found.y * step.point_scale;
    }
    let sum = total(lane, found.x);
    if lane == 0u {
        losses[step.rays + group.x] = sum;
    }
}
