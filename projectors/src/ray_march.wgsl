// Ray marching: the twin of ray_march.rs, which gives `stage_PUBLISHED` and `stage_STRATIFIED`.

fn stage_sample(ray: Ray, i: u32, training: bool) -> vec4<f32> {
    let range = select(ray.inside, ray.published, stage_PUBLISHED);
    let delta = (range.y - range.x) / f32(ray.count);
    var place = 0.5;
    if stage_STRATIFIED && training {
        place = random_unit(random_mix(ray.seed, vec2<u32>(i, 0u)));
    }
    let t = range.x + (f32(i) + place) * delta;
    return vec4<f32>(ray.origin + t * ray.direction, delta);
}
