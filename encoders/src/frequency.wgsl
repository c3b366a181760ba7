// Frequency bands, as in frequency.rs, which adds the calls wave by wave.

// sin(2π·t) and cos(2π·t). Whole turns cancel exactly; the rest is at most an eighth of a turn, where the truncation
// error of the series is below half a unit in the last place.
fn stage_sin_cos_turns(turns: f32) -> vec2<f32> {
    // From 2^24 on every float is an integer.
    let t = select(turns, 0.0, abs(turns) >= 16777216.0);
    let quarter = round(t * 4.0);
    let a = (t - 0.25 * quarter) * 6.2831853;
    let q = quarter - floor(quarter * 0.25) * 4.0;
    let s = a * a;
    let sin = a * (1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0))));
    let cos = 1.0 - s / 2.0 * (1.0 - s / 12.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0))));
    let odd = q == 1.0 || q == 3.0;
    let both = select(vec2<f32>(sin, cos), vec2<f32>(cos, sin), odd);
    return vec2<f32>(select(both.x, -both.x, q >= 2.0), select(both.y, -both.y, q == 1.0 || q == 2.0));
}
