// Blurs MAPS images along rows; pixels beyond the image are 0.
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let pixels = view.rows * view.columns;
    for (var i = id.x; i < pixels; i += groups.x * 64u) {
        let column = i % view.columns;
        var sums: array<f32, MAPS>;
        for (var k = 0u; k < 11u; k++) {
            // From 5 pixels before to 5 after.
            if column + k >= 5u && column + k - 5u < view.columns {
                let at = i + k - 5u;
                let tap = taps[k];
                TAKE
            }
        }
        for (var m = 0u; m < MAPSu; m++) {
            between[m * pixels + i] = sums[m];
        }
    }
}
