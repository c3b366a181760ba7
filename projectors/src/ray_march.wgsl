// Ray marching, as in ray_march.rs, which adds `stage_PUBLISHED`, `stage_STRATIFIED` and `stage_END_TO_END`.

fn stage_sample(ray: Ray, i: u32, training: bool) -> vec4<f32> {
    let range = select(ray.inside, ray.published, stage_PUBLISHED);
    let intervals = select(ray.count, max(ray.count - 1u, 1u), stage_END_TO_END);
    let delta = (range.y - range.x) / f32(intervals);
    var place = select(0.5, 0.0, stage_END_TO_END);
    if stage_STRATIFIED && training {
        place = random_unit(random_mix(ray.seed, vec2<u32>(i, 0u)));
    }
    let t = range.x + (f32(i) + place) * delta;
    return vec4<f32>(ray.origin + t * ray.direction, select(delta, 0.0, stage_END_TO_END && i + 1u == ray.count));
}
