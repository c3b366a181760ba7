// Adam (Kingma & Ba 2015, algorithm 1). Gradients are zero afterwards.

struct Rule {
    count: u32,
    rate: f32,
    beta1: f32,
    beta2: f32,
    rest1: f32,
    rest2: f32,
    root: f32,
    eps: f32,
}

@compute @workgroup_size(256)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = id.x; i < rule.count; i += groups.x * 256u) {
        let g = grads[i];
        let m = first[i] * rule.beta1 + g * rule.rest1;
        let v = second[i] * rule.beta2 + g * g * rule.rest2;
        params[i] -= m * rule.rate / (sqrt(v) * rule.root + rule.eps);
        // Decaying moments end at zero, not at denormal numbers.
        first[i] = select(0.0, m, abs(m) > 1e-30);
        second[i] = select(0.0, v, v > 1e-36);
        grads[i] = 0.0;
    }
}
