// Voxel p of `values`, or of the planes before and after those in the buffer.
fn value(p: vec3<u32>) -> f32 {
    let shape = stencil.shape;
    let inner = p.y * shape.z + p.z;
    if p.x < stencil.held { return before[inner]; }
    if p.x >= stencil.held + stencil.planes { return after[inner]; }
    return values[(p.x - stencil.held) * shape.y * shape.z + inner];
}

// Forward differences at voxel p, times `up`; 0 across the far faces.
fn differences(p: vec3<u32>) -> vec3<f32> {
    let shape = stencil.shape;
    let here = value(p);
    var d = vec3<f32>();
    if p.x + 1u < shape.x { d.x = value(p + vec3<u32>(1u, 0u, 0u)) - here; }
    if p.y + 1u < shape.y { d.y = value(p + vec3<u32>(0u, 1u, 0u)) - here; }
    if p.z + 1u < shape.z { d.z = value(p + vec3<u32>(0u, 0u, 1u)) - here; }
    return d * stencil.up;
}
