// A proximal gradient update of a volume: one voxel per invocation.

struct Proximal {
    shape: vec3<u32>,
    // First voxel of this launch, and the first after it.
    begin: u32,
    // Weights of differences, times τ for the primal and over L·τ for the dual.
    down: vec3<f32>,
    end: u32,
    up: vec3<f32>,
    step: f32,
    momentum: f32,
    pull: f32,
}

// A voxel's position along y and z.
fn place(i: u32) -> vec2<u32> {
    return vec2<u32>(i / proximal.shape.z % proximal.shape.y, i % proximal.shape.z);
}
