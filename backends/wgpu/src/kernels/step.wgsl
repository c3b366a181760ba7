struct Step {
    // Rows: first the samples of rays, then points, then those of blocks.
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
    // What the loss of a ray, the loss of a point and the penalty of a block count by.
    ray_scale: f32,
    point_scale: f32,
    block_scale: f32,
    // Distance of neighbouring points in a block.
    spacing: vec3<f32>,
}

// The row that an invocation is at.
var<private> row: u32;
