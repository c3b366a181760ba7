// Adds the derivative of the similarity to that of the loss, and multiplies by the length of the ray, as the adjoint asks.
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let pixels = view.rows * view.columns;
    for (var i = id.x; i < pixels; i += groups.x * 64u) {
        let b = blurred(i, pixels);
        let more = b[0] + 2.0 * found[i] * b[1] + wanted[i] * b[2];
        gradient[i] = (gradient[i] + more) * ray_length(i % view.columns, i / view.columns);
    }
}
