// Beer-Lambert line integrals, their loss, and its derivative with respect to every sample: one group per ray.
@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let first = rays[group.x].first;
    let count = rays[group.x].count;
    var sum = 0.0;
    for (var i = lane; i < count; i += 64u) {
        sum += samples[first + i].w * mu[first + i];
    }
    let found = loss_at(total(lane, sum), rays[group.x].measured);
    if lane == 0u {
        losses[group.x] = found.x;
    }
    let slope = found.y * step.ray_scale;
    for (var i = lane; i < count; i += 64u) {
        dmu[first + i] = samples[first + i].w * slope;
    }
}
