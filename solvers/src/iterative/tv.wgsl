// Total variation: a step of the dual variable p of a voxel along the differences d, and the penalty of d.

fn stage_ascend(p: vec3<f32>, d: vec3<f32>, n: vec3<f32>) -> vec3<f32> {
    let q = p + d;
    return q / max(1.0, length(q));
}

fn stage_cost(d: vec3<f32>, n: vec3<f32>) -> f32 {
    return length(d);
}
