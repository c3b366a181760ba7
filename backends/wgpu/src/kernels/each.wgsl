@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = LAUNCH.begin + id.x; i < LAUNCH.end; i += groups.x * 64u) {
        BODY
    }
}
