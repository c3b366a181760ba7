// Adam (Kingma & Ba 2015, algorithm 1) with a rate per kind of parameter, and the sums for density control.
struct Rule {
    // Rates of centre, scale, rotation, density.
    rates: vec4<f32>,
    beta1: f32,
    beta2: f32,
    root: f32,
    eps: f32,
    // Bounds of the logarithms of the standard deviations.
    widths: vec2<f32>,
    pad: vec2<f32>,
}

// Clamps, but keeps NaN, so that a run with a fault is found.
fn within(x: f32, low: f32, high: f32) -> f32 {
    return select(select(x, high, x > high), low, x < low);
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = id.x; i < arrayLength(&params) / 11u; i += groups.x * 64u) {
        let p = i * 11u;
        if params[p + 10u] <= FREE {
            continue;
        }
        let pull = length(vec3<f32>(grads[p], grads[p + 1u], grads[p + 2u]));
        if pull > 0.0 {
            pulls[i] += vec2<f32>(pull, 1.0);
        }
        for (var k = 0u; k < 11u; k++) {
            let rate = select(select(select(rule.rates.w, rule.rates.z, k < 10u), rule.rates.y, k < 6u), rule.rates.x, k < 3u);
            let g = grads[p + k];
            let m = first[p + k] * rule.beta1 + g * (1.0 - rule.beta1);
            let v = second[p + k] * rule.beta2 + g * g * (1.0 - rule.beta2);
            var x = params[p + k] - m * rate / (sqrt(v) * rule.root + rule.eps);
            if k < 3u {
                x = within(x, 0.0, 1.0);
            } else if k < 6u {
                x = within(x, rule.widths.x, rule.widths.y);
            }
            params[p + k] = x;
            // Decaying moments end at zero, not at denormal numbers.
            first[p + k] = select(0.0, m, abs(m) > 1e-30);
            second[p + k] = select(0.0, v, v > 1e-36);
        }
    }
}
