// Layer normalization, as in layer_norm.rs, which adds `stage_WIDTH`, `stage_EPS` and `stage_AFFINE`.

struct stage_Row {
    first: f32,
    mean: f32,
    // Reciprocal standard deviation.
    root: f32,
    // 1, except for rows that would overflow when squared.
    scale: f32,
}

fn stage_row(x: ptr<function, array<f32, stage_WIDTH>>) -> stage_Row {
    var largest = 0.0;
    for (var c = 0u; c < stage_WIDTH; c++) {
        largest = max(largest, abs((*x)[c]));
    }
    // 2^50 and 2^-80.
    let scale = select(1.0, 8.271806125530277e-25, largest > 1.125899906842624e15);
    let first = (*x)[0] * scale;
    var mean = 0.0;
    for (var c = 0u; c < stage_WIDTH; c++) {
        mean += (*x)[c] * scale - first;
    }
    mean *= 1.0 / f32(stage_WIDTH);
    var variance = 0.0;
    for (var c = 0u; c < stage_WIDTH; c++) {
        let d = ((*x)[c] * scale - first) - mean;
        variance += d * d;
    }
    // At least 2^-120, whose root is finite.
    let eps = max(stage_EPS * scale * scale, 7.52316384526264e-37);
    return stage_Row(first, mean, 1.0 / sqrt(variance * (1.0 / f32(stage_WIDTH)) + eps), scale);
}

fn stage_normal(x: ptr<function, array<f32, stage_WIDTH>>, r: stage_Row, c: u32) -> f32 {
    return (((*x)[c] * r.scale - r.first) - r.mean) * r.root;
}

fn stage_gamma(o: u32) -> f32 {
    if stage_AFFINE {
        return stage_param(o);
    }
    return 1.0;
}

fn stage_forward(x: ptr<function, array<f32, stage_WIDTH>>, y: ptr<function, array<f32, stage_WIDTH>>) {
    let r = stage_row(x);
    for (var o = 0u; o < stage_WIDTH; o++) {
        let n = stage_normal(x, r, o);
        if stage_AFFINE {
            (*y)[o] = n * stage_param(o) + stage_param(stage_WIDTH + o);
        } else {
            (*y)[o] = n;
        }
    }
}

fn stage_backward(
    x: ptr<function, array<f32, stage_WIDTH>>,
    dy: ptr<function, array<f32, stage_WIDTH>>,
    dx: ptr<function, array<f32, stage_WIDTH>>,
) {
    let r = stage_row(x);
    stage_gradients(x, r, dy);
    if !stage_wants_dx {
        return;
    }
    // With g = γ·dy: dx = (g − mean(g) − x̂·mean(g·x̂))/deviation, means over all channels.
    var mean = 0.0;
    var along = 0.0;
    for (var c = 0u; c < stage_WIDTH; c++) {
        let g = (*dy)[c] * stage_gamma(c);
        (*dx)[c] = g;
        mean += g;
        along += g * stage_normal(x, r, c);
    }
    mean *= 1.0 / f32(stage_WIDTH);
    along *= 1.0 / f32(stage_WIDTH);
    for (var c = 0u; c < stage_WIDTH; c++) {
        (*dx)[c] = ((*dx)[c] - mean - stage_normal(x, r, c) * along) * (r.root * r.scale);
    }
}
