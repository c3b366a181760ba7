// Isotropic total variation by forward differences and its derivative: a group a block.

var<private> base: u32;

struct Slope {
    forward: vec3<f32>,
    size: f32,
}

fn slope(p: u32) -> Slope {
    let edge = step.edge;
    let strides = vec3<u32>(edge * edge, edge, 1u);
    let at = vec3<u32>(p / (edge * edge), (p / edge) % edge, p % edge);
    let here = mu[base + p];
    var d = vec3<f32>(0.0);
    for (var k = 0u; k < 3u; k++) {
        if at[k] + 1u < edge {
            d[k] = mu[base + p + strides[k]] - here;
        }
    }
    return Slope(d, sqrt(dot(d, d) + step.smoothing * step.smoothing));
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let edge = step.edge;
    let each = edge * edge * edge;
    let strides = vec3<u32>(edge * edge, edge, 1u);
    base = step.ray_rows + step.point_rows + group.x * each;
    var sum = 0.0;
    for (var p = lane; p < each; p += 64u) {
        let own = slope(p);
        sum += own.size - step.smoothing;
        let at = vec3<u32>(p / (edge * edge), (p / edge) % edge, p % edge);
        var d = 0.0;
        if own.size > 0.0 {
            d = -(own.forward.x + own.forward.y + own.forward.z) / own.size;
        }
        for (var k = 0u; k < 3u; k++) {
            if at[k] > 0u {
                let before = slope(p - strides[k]);
                if before.size > 0.0 {
                    d += before.forward[k] / before.size;
                }
            }
        }
        dmu[base + p] = d * step.tv_scale;
    }
    let whole = total(lane, sum);
    if lane == 0u {
        losses[step.rays + (step.point_rows + 63u) / 64u + group.x] = whole;
    }
}
