// Total variation of a limited arc, along edges n if there are any: slopes along stage_MIDDLE cost stage_FACTOR as much.
// The dual is kept as (I - n nT) A p, with A = I - (1 - stage_FACTOR) stage_MIDDLE stage_MIDDLET.

fn stage_less(m: vec3<f32>, share: f32, v: vec3<f32>) -> vec3<f32> {
    return v - m * (share * dot(m, v));
}

fn stage_ascend(p: vec3<f32>, d: vec3<f32>, n: vec3<f32>) -> vec3<f32> {
    let share = 1.0 - stage_FACTOR;
    let slope = stage_less(stage_MIDDLE, share, stage_less(n, 1.0, d));
    let freed = stage_less(n, -1.0 / (1.0 - dot(n, n)), p);
    let q = stage_less(stage_MIDDLE, 1.0 - 1.0 / stage_FACTOR, freed) + slope;
    return stage_less(n, 1.0, stage_less(stage_MIDDLE, share, q / max(1.0, length(q))));
}

fn stage_cost(d: vec3<f32>, n: vec3<f32>) -> f32 {
    return length(stage_less(stage_MIDDLE, 1.0 - stage_FACTOR, stage_less(n, 1.0, d)));
}
