// Multi-resolution dense grid, as in dense_grid.rs, which adds `stage_FEATURES` and the calls level by level.

struct stage_Level {
    side: vec3<u32>,
    strides: vec3<u32>,
    cells: f32,
    // First parameter.
    start: u32,
}

fn stage_at(x: vec3<f32>, level: stage_Level) -> stage_Located {
    return stage_trilinear_locate(x, level.side, level.strides, vec3<f32>(level.cells), 0.0);
}

fn stage_level_forward(x: vec3<f32>, level: stage_Level) -> array<f32, stage_FEATURES> {
    let at = stage_at(x, level);
    var sum: array<f32, stage_FEATURES>;
    for (var c = 0u; c < 8u; c++) {
        let entry = level.start + stage_trilinear_index(at, level.strides, c) * stage_FEATURES;
        let w = stage_trilinear_weight(at, c);
        for (var f = 0u; f < stage_FEATURES; f++) {
            sum[f] += w * stage_param(entry + f);
        }
    }
    return sum;
}

// Adds to the gradients of the level's entries; returns the derivative with respect to the point.
fn stage_level_backward(x: vec3<f32>, level: stage_Level, dy: ptr<function, array<f32, stage_FEATURES>>) -> vec3<f32> {
    let at = stage_at(x, level);
    var slope = vec3<f32>(0.0);
    for (var c = 0u; c < 8u; c++) {
        let entry = level.start + stage_trilinear_index(at, level.strides, c) * stage_FEATURES;
        let w = stage_trilinear_weight(at, c);
        stage_features_grad(entry, w, dy);
        if stage_wants_dx {
            var along = 0.0;
            for (var f = 0u; f < stage_FEATURES; f++) {
                along += stage_param(entry + f) * (*dy)[f];
            }
            slope += along * stage_trilinear_slopes(at, c);
        }
    }
    return slope;
}
