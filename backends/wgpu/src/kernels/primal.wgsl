// v - τ ∇ᵀp within the bounds at voxel i; v is the gradient's buffer.
fn primal_of(i: u32) -> f32 {
    let plane = stencil.shape.y * stencil.shape.z;
    let at = place(i);
    // No difference across the far faces.
    let inner = at + vec3<u32>(1u) < stencil.shape;
    var d = select(vec3<f32>(), -vec3<f32>(dual_x[i], dual_y[i], dual_z[i]), inner);
    if at.x > 0u {
        if i >= plane { d.x += dual_x[i - plane]; } else { d.x += before[i]; }
    }
    if at.y > 0u { d.y += dual_y[i - stencil.shape.z]; }
    if at.z > 0u { d.z += dual_z[i - 1u]; }
    return min(stencil.high, max(stencil.low, gradient[i] - dot(d, stencil.down)));
}
