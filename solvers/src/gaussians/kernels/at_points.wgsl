// Values at scattered points: `grid` is the unit cube in cells, which are the bins.
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = id.x; i < grid.count; i += groups.x * 64u) {
        let p = vec3<f32>(points[3u * i], points[3u * i + 1u], points[3u * i + 2u]);
        let cell = vec3<u32>(clamp(floor(p / grid.spacing), vec3<f32>(), vec3<f32>(grid.shape - 1u)));
        let bin = (cell.x * bins.shape.y + cell.y) * bins.shape.z + cell.z;
        let end = min(starts[bin + 1u], bins.room);
        var sum = 0.0;
        for (var at = starts[bin]; at < end; at++) {
            let s = shapes[entries[at]];
            let m = to_deviations(s, p - s.centre);
            let e = dot(m, m);
            if e <= CUT {
                sum += s.density * exp(-0.5 * e);
            }
        }
        values[i] = sum;
    }
}
