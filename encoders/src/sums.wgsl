// Levels whose features are weighted sums of entries. `stage_corner` is one of `stage_CORNERS` entries where a point lies.

struct stage_Corner {
    // First parameter.
    entry: u32,
    weight: f32,
}

fn stage_level_value(at: stage_Located, level: stage_Level) -> array<f32, stage_FEATURES> {
    var sum: array<f32, stage_FEATURES>;
    for (var c = 0u; c < stage_CORNERS; c++) {
        let corner = stage_corner(at, level, c);
        for (var f = 0u; f < stage_FEATURES; f++) {
            sum[f] += corner.weight * stage_param(corner.entry + f);
        }
    }
    return sum;
}

fn stage_level_backward(at: stage_Located, level: stage_Level, dy: ptr<function, array<f32, stage_FEATURES>>) {
    for (var c = 0u; c < stage_CORNERS; c++) {
        let corner = stage_corner(at, level, c);
        stage_features_grad(corner.entry, corner.weight, dy);
    }
}
