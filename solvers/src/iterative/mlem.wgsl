// Poisson's likelihood of line integrals a = p - r.

fn stage_differentiate(p: f32, r: f32) -> vec2<f32> {
    let a = p - r;
    if (a <= stage_least) {
        return vec2<f32>(0.0, 0.0);
    }
    let q = max(p, 0.0);
    let logarithm = select(0.0, q * log(max(q, stage_least) / a), q > 0.0);
    return vec2<f32>(logarithm - q + a, r / a);
}

fn stage_curve(p: f32, x: f32) -> f32 {
    return x / max(p, stage_least);
}

fn stage_spread(p: f32, x: f32) -> f32 {
    return x / sqrt(max(p, stage_least));
}
