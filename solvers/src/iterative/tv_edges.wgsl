// Directional total variation: the same with edges n, across which differences cost less. The dual is kept as
// (I - n nT) p.

fn stage_ascend(p: vec3<f32>, d: vec3<f32>, n: vec3<f32>) -> vec3<f32> {
    let q = p + d + n * (dot(n, p) / (1.0 - dot(n, n)) - dot(n, d));
    return (q - n * dot(n, q)) / max(1.0, length(q));
}

fn stage_cost(d: vec3<f32>, n: vec3<f32>) -> f32 {
    return length(d - n * dot(n, d));
}
