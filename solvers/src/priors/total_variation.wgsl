// Isotropic total variation by forward differences, and its derivative.

struct stage_Slope {
    forward: vec3<f32>,
    size: f32,
}

const stage_strides = vec3<u32>(stage_edge * stage_edge, stage_edge, 1u);

fn stage_place(p: u32) -> vec3<u32> {
    return vec3<u32>(p / (stage_edge * stage_edge), (p / stage_edge) % stage_edge, p % stage_edge);
}

fn stage_slope(p: u32) -> stage_Slope {
    let at = stage_place(p);
    let here = stage_value(p);
    var d = vec3<f32>(0.0);
    for (var k = 0u; k < 3u; k++) {
        if at[k] + 1u < stage_edge {
            d[k] = stage_value(p + stage_strides[k]) - here;
        }
    }
    return stage_Slope(d, sqrt(dot(d, d) + stage_smoothing * stage_smoothing));
}

fn stage_at(p: u32) -> vec2<f32> {
    let own = stage_slope(p);
    let at = stage_place(p);
    var d = 0.0;
    if own.size > 0.0 {
        d = -(own.forward.x + own.forward.y + own.forward.z) / own.size;
    }
    for (var k = 0u; k < 3u; k++) {
        if at[k] > 0u {
            let before = stage_slope(p - stage_strides[k]);
            if before.size > 0.0 {
                d += before.forward[k] / before.size;
            }
        }
    }
    return vec2<f32>(own.size - stage_smoothing, d);
}
