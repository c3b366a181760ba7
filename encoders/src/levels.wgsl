// Encoders with several levels, as in levels.rs, which adds `stage_FEATURES` and the calls level by level. A level declares
// `stage_Level`, `stage_Located` and these functions:
// - stage_locate(x, level): where a point lies,
// - stage_moved(at, d, end): the place changed so that the features at `end` 1 less those at `end` 0 are the derivative along
//   axis `d` with respect to the position in cells,
// - stage_level_value(at, level): the features there,
// - stage_level_backward(at, level, dy): adds to the gradients of the level's parameters.

// From the derivatives `dy` with respect to the features to those with respect to the point. The position in cells is
// x·scale + shift.
fn stage_level_slope(
    x: vec3<f32>,
    level: stage_Level,
    dy: ptr<function, array<f32, stage_FEATURES>>,
    scale: f32,
    shift: f32,
) -> vec3<f32> {
    let at = stage_locate(x, level);
    var slope = vec3<f32>(0.0);
    for (var d = 0u; d < 3u; d++) {
        var near = stage_level_value(stage_moved(at, d, 0.0), level);
        var far = stage_level_value(stage_moved(at, d, 1.0), level);
        for (var f = 0u; f < stage_FEATURES; f++) {
            slope[d] += (far[f] - near[f]) * (*dy)[f];
        }
    }
    // Beyond the rim a position is clamped, whatever its value.
    let inside = (x <= vec3<f32>(1.0)) & (x * scale + shift >= vec3<f32>(0.0));
    return select(vec3<f32>(0.0), slope * scale, inside);
}
