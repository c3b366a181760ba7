// A copy of the parameters in half precision.
@compute @workgroup_size(256)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let n = arrayLength(&params);
    for (var i = id.x; i < arrayLength(&halves); i += groups.x * 256u) {
        if 2u * i < n {
            // A number past the end counts as the last one.
            halves[i] = pack(params[2u * i], params[min(2u * i + 1u, n - 1u)]);
        }
    }
}
