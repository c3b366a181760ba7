// Planes of a volume with what lies beside them.
struct Stencil {
    shape: vec3<u32>,
    // First voxel of this launch, and the first after it.
    begin: u32,
    // Weights of differences, times τ for the primal and over L·τ for the dual.
    down: vec3<f32>,
    end: u32,
    up: vec3<f32>,
    // First plane of x in the buffer, and how many.
    held: u32,
    planes: u32,
    step: f32,
    momentum: f32,
    pull: f32,
    // Bounds of the primal.
    low: f32,
    high: f32,
}

// Position of voxel i of the buffer.
fn place(i: u32) -> vec3<u32> {
    let shape = stencil.shape;
    return vec3<u32>(stencil.held + i / (shape.y * shape.z), i / shape.z % shape.y, i % shape.z);
}
