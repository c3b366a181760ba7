// A grid of voxels as the field, as in voxel_grid.rs, which adds `stage_SIDE`, `stage_STRIDES` and `stage_output`, the
// activation.

fn stage_at(x: ptr<function, array<f32, 3>>) -> stage_Located {
    let p = vec3<f32>((*x)[0], (*x)[1], (*x)[2]);
    return stage_trilinear_locate(p, stage_SIDE, stage_STRIDES, vec3<f32>(stage_SIDE), -0.5);
}

fn stage_value(at: stage_Located) -> f32 {
    var sum = 0.0;
    for (var c = 0u; c < 8u; c++) {
        sum += stage_trilinear_weight(at, c) * stage_param(stage_trilinear_index(at, stage_STRIDES, c));
    }
    return sum;
}

fn stage_forward(x: ptr<function, array<f32, 3>>, y: ptr<function, array<f32, 1>>) {
    (*y)[0] = stage_output(stage_value(stage_at(x))).x;
}

fn stage_backward(x: ptr<function, array<f32, 3>>, dy: ptr<function, array<f32, 1>>, dx: ptr<function, array<f32, 3>>) {
    let at = stage_at(x);
    let d = (*dy)[0] * stage_output(stage_value(at)).y;
    for (var c = 0u; c < 8u; c++) {
        stage_grad(stage_trilinear_index(at, stage_STRIDES, c), stage_trilinear_weight(at, c) * d);
    }
    for (var k = 0u; k < 3u && stage_wants_dx; k++) {
        (*dx)[k] = (stage_value(stage_moved(at, k, 1.0)) - stage_value(stage_moved(at, k, 0.0))) * at.slope[k] * d;
    }
}
