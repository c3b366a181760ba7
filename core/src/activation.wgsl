// Activations as in activation.rs: value and derivative. Comparisons keep NaN, which `min` and `max` may drop.

fn stage_none(x: f32) -> vec2<f32> {
    return vec2<f32>(x, 1.0);
}

fn stage_relu(x: f32) -> vec2<f32> {
    return vec2<f32>(select(x, 0.0, x <= 0.0), select(0.0, 1.0, x > 0.0));
}

fn stage_leaky_relu(x: f32) -> vec2<f32> {
    let slope = select(0.01, 1.0, x > 0.0);
    return vec2<f32>(x * slope, slope);
}

// x·Φ(x), |error| of Φ < 3e-7, by Abramowitz & Stegun 7.1.26, which shares its exponential with the density.
fn stage_gelu(x: f32) -> vec2<f32> {
    let e = exp(max(-0.5 * x * x, -87.0));
    let t = 1.0 / (abs(x) * 0.23164189 + 1.0);
    let p = 0.5 * ((((1.0614054 * t - 1.453152) * t + 1.4214138) * t - 0.28449674) * t + 0.2548296);
    let tail = p * t * e;
    let cdf = select(tail, 1.0 - tail, x >= 0.0);
    return vec2<f32>(x * cdf, x * (e * 0.3989423) + cdf);
}

fn stage_squareplus(x: f32) -> vec2<f32> {
    // Above 1e18 the square would overflow, and the root equals |x| to the last bit.
    let small = min(abs(x), 1e18);
    let root = max(sqrt(small * small + 1.52382103), abs(x));
    return vec2<f32>((x + root) * 0.5, (x / root + 1.0) * 0.5);
}

fn stage_logistic(x: f32) -> f32 {
    let e = exp(-select(abs(x), 87.0, abs(x) > 87.0));
    return select(e, 1.0, x >= 0.0) / (1.0 + e);
}

fn stage_softplus(x: f32) -> vec2<f32> {
    // ln(1 + e) by its series if 1 + e would lose digits of e.
    let e = exp(-select(abs(x), 87.0, abs(x) > 87.0));
    let log = select(log(1.0 + e), e * (1.0 - e * (0.5 - e * (1.0 / 3.0 - e * 0.25))), e < 0.03);
    return vec2<f32>(select(x, 0.0, x <= 0.0) + log, stage_logistic(x));
}

fn stage_sigmoid(x: f32) -> vec2<f32> {
    let y = stage_logistic(x);
    return vec2<f32>(y, y * (1.0 - y));
}
