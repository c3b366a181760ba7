// The footprints of all Gaussians on a view, and their boxes: no pixel outside is reached. With m = √(CUT·zz/(zz - CUT)) times
// `along` in units of pu and pv, the pixels lie in |x| ≤ √(…)/t + m·x: an ellipse if |m| < 1.

// Rounding of a box's sides: pixels, and a share of its size.
const SLACK = vec2<f32>(0.01, 1e-4);

fn range(middle: f32, half: f32, count: u32) -> u32 {
    let reach = half + SLACK.x + SLACK.y * half;
    let first = clamp(ceil(middle - reach), 0.0, f32(count));
    let end = clamp(floor(middle + reach) + 1.0, first, f32(count));
    return u32(first) | u32(end) << 16u;
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = id.x; i < arrayLength(&shapes); i += groups.x * 64u) {
        boxes[i] = vec4<u32>();
        let s = shapes[i];
        if s.density == 0.0 {
            continue;
        }
        let g = seen_by(view, s);
        // Behind the source, or around it.
        if !(g.t > 1e-9 && g.zz > 1.0001 * CUT) {
            continue;
        }
        let b11 = length(g.pu);
        let b12 = dot(g.pu, g.pv) / b11;
        let b22 = length(cross(g.pu, g.pv)) / b11;
        let root = sqrt(CUT * g.zz / (g.zz - CUT));
        let m1 = root * g.along.x / b11;
        let m2 = (root * g.along.y - b12 * m1) / b22;
        let rest = 1.0 - m1 * m1 - m2 * m2;
        // Not an ellipse: the Gaussian reaches the plane of the source.
        if !(b11 > 0.0 && b22 > 0.0 && rest > 0.0) {
            continue;
        }
        // du and dv in units of pu and pv.
        let column = vec2<f32>(1.0, -b12 / b22) / b11;
        let row = vec2<f32>(0.0, 1.0 / b22);
        let m = vec2<f32>(m1, m2);
        let by = vec2<f32>(dot(column, m), dot(row, m));
        let scale = root / (g.t * rest);
        let half = scale * sqrt(rest * vec2<f32>(dot(column, column), dot(row, row)) + by * by);
        let middle = g.at + scale * by;
        let columns = range(middle.x, half.x, view.columns);
        let rows = range(middle.y, half.y, view.rows);
        if (columns & 0xffffu) == columns >> 16u || (rows & 0xffffu) == rows >> 16u {
            continue;
        }
        let c = g.z / g.t;
        seen[i] = Footprint(
            g.at,
            g.zz * vec2<f32>(dot(g.pu, g.pu), 2.0 * dot(g.pu, g.pv)),
            vec4<f32>(g.zz * dot(g.pv, g.pv), dot(c, c), 2.0 * dot(c, g.mu), 2.0 * dot(c, g.mv)),
            vec4<f32>(dot(g.mu, g.mu), 2.0 * dot(g.mu, g.mv), dot(g.mv, g.mv), s.density * ROOT_TAU),
        );
        boxes[i] = vec4<u32>(1u << 16u, rows, columns, 0u);
    }
}
