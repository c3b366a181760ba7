// Samples of all rays: one row each.
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var row = id.x; row < step.ray_rows; row += groups.x * 64u) {
        // The last ray that begins at or before this row.
        var low = 0u;
        var high = step.rays;
        while high - low > 1u {
            let middle = (low + high) / 2u;
            if rays[middle].first <= row {
                low = middle;
            } else {
                high = middle;
            }
        }
        samples[row] = projector_sample(rays[low], row - rays[low].first, step.training != 0u);
    }
}
