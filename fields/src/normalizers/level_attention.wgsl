// Attention over levels, as in level_attention.rs, which adds `stage_LEVELS`, `stage_WIDTH` and `stage_BIAS`, and
// writes the code of each channel.

// The weights of the levels.
fn stage_attention(x: ptr<function, array<f32, stage_WIDTH>>) -> array<f32, stage_LEVELS> {
    var a: array<f32, stage_LEVELS>;
    var top = 0.0;
    for (var l = 0u; l < stage_LEVELS; l++) {
        a[l] = stage_param(stage_BIAS + l);
        for (var c = 0u; c < stage_WIDTH; c++) {
            a[l] += stage_param(l * stage_WIDTH + c) * (*x)[c];
        }
        top = select(top, a[l], l == 0u || !(a[l] <= top));
    }
    var sum = 0.0;
    for (var l = 0u; l < stage_LEVELS; l++) {
        // NaN stays.
        let less = a[l] - top;
        a[l] = exp(select(less, -87.0, less < -87.0));
        sum += a[l];
    }
    for (var l = 0u; l < stage_LEVELS; l++) {
        a[l] /= sum;
    }
    return a;
}
