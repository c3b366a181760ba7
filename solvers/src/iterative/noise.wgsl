// Weighted least squares with the weights exp(-growth max(p, 0)).

fn stage_weight(power: f32, p: f32) -> f32 {
    return exp(-power * stage_growth * max(p, 0.0));
}

fn stage_differentiate(p: f32, r: f32) -> vec2<f32> {
    let weighted = stage_weight(1.0, p) * r;
    return vec2<f32>(0.5 * weighted * r, weighted);
}

fn stage_curve(p: f32, x: f32) -> f32 {
    return stage_weight(1.0, p) * x;
}

fn stage_spread(p: f32, x: f32) -> f32 {
    return stage_weight(0.5, p) * x;
}
