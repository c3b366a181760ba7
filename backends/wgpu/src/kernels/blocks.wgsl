// Points of blocks: one row each, z fastest.
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let edge = step.edge;
    let each = edge * edge * edge;
    let first = step.ray_rows + step.point_rows;
    for (var i = id.x; i < step.blocks * each; i += groups.x * 64u) {
        let p = i % each;
        let at = vec3<f32>(vec3<u32>(p / (edge * edge), (p / edge) % edge, p % edge));
        samples[first + i] = vec4<f32>(corners[i / each].xyz + at * step.spacing, 0.0);
    }
}
