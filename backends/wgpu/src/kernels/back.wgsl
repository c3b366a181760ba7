struct SeenView {
    // Constant part, and what x, y, z add.
    depth: vec4<f32>,
    row: vec4<f32>,
    column: vec4<f32>,
    scale: f32,
}

// Geometry of a view's pixels, mm.
struct RowWeights {
    corner: vec3<f32>,
    u: vec3<f32>,
    v: vec3<f32>,
    normal: vec3<f32>,
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
    // First view among the images.
    first: u32,
}
