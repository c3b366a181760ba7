// Views with rows and columns exchanged, and a rim of zeros around each.
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let column = back.rows + 2u;
    let view = (back.columns + 2u) * column;
    for (var i = back.begin + id.x; i < back.end; i += groups.x * 64u) {
        let r = i % column;
        let c = (i % view) / column;
        var value = 0.0;
        if r > 0u && c > 0u && r <= back.rows && c <= back.columns {
            value = images[((i / view) * back.rows + r - 1u) * back.columns + c - 1u];
        }
        padded[i] = value;
    }
}
