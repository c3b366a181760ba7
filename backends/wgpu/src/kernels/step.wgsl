struct Step {
    // Rows: samples of rays, then points, then points of blocks.
    rows: u32,
    ray_rows: u32,
    rays: u32,
    point_rows: u32,
    blocks: u32,
    // Points along a block's edge.
    edge: u32,
    // Rows from one channel of the features to the next.
    stride: u32,
    // Whether random positions are random.
    training: u32,
    // Factors of the loss of a ray, the loss of a point and the penalty of a block.
    ray_scale: f32,
    point_scale: f32,
    block_scale: f32,
    // Distance of neighbouring points in a block.
    spacing: vec3<f32>,
}

// The row of an invocation.
var<private> row: u32;
