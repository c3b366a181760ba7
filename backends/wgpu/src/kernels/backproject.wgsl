// Voxel-driven, distance-weighted back-projection (Feldkamp, Davis and Kress 1984): a voxel an invocation.

struct SeenView {
    // Constant part, and what x, y, z add.
    depth: vec4<f32>,
    row: vec4<f32>,
    column: vec4<f32>,
    scale: f32,
}

struct Back {
    shape: vec3<u32>,
    views: u32,
    // First plane of x in the buffer, and voxels of this launch.
    held: u32,
    begin: u32,
    end: u32,
    rows: u32,
    columns: u32,
}

fn pixel(view: u32, row: i32, column: i32) -> f32 {
    if row < 0 || column < 0 || row >= i32(back.rows) || column >= i32(back.columns) {
        return 0.0;
    }
    return images[(view * back.rows + u32(row)) * back.columns + u32(column)];
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let line = back.shape.z;
    let plane = back.shape.y * line;
    for (var i = back.begin + id.x; i < back.end; i += groups.x * 64u) {
        let at = vec4<f32>(1.0, f32(back.held + i / plane), f32((i / line) % back.shape.y), f32(i % line));
        var sum = 0.0;
        for (var v = 0u; v < back.views; v++) {
            let depth = dot(views[v].depth, at);
            if depth <= 0.0 {
                continue;
            }
            let row = dot(views[v].row, at) / depth;
            let column = dot(views[v].column, at) / depth;
            if row <= -1.0 || column <= -1.0 || row >= f32(back.rows) || column >= f32(back.columns) {
                continue;
            }
            let r = i32(floor(row));
            let c = i32(floor(column));
            let fr = row - floor(row);
            let fc = column - floor(column);
            let low = (1.0 - fc) * pixel(v, r, c) + fc * pixel(v, r, c + 1);
            let high = (1.0 - fc) * pixel(v, r + 1, c) + fc * pixel(v, r + 1, c + 1);
            sum += views[v].scale / (depth * depth) * ((1.0 - fr) * low + fr * high);
        }
        volume[i] += sum;
    }
}
