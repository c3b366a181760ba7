// Trilinear interpolation at the midpoints of equal steps inside the box of the voxels. `stage_SAMPLES`, the number of
// samples along the smallest side of a voxel, comes from stages.rs.

fn stage_walk(ray: VoxelRay) {
    let shape = stage_shape();
    let inside = stage_clip(ray, vec3<f32>(-0.5), vec3<f32>(shape) - 0.5);
    if inside.y <= inside.x {
        return;
    }
    let spacing = stage_spacing();
    let side = min(spacing.x, min(spacing.y, spacing.z));
    let count = max(ceil((inside.y - inside.x) * ray.length * stage_SAMPLES / side), 1.0);
    let step = (inside.y - inside.x) / count;
    let top = vec3<f32>(shape - 1u);
    // A counter in f32 would stand still at 2^24.
    for (var i = 0u; i < u32(count); i++) {
        let p = clamp(ray.source + (inside.x + (f32(i) + 0.5) * step) * ray.ahead, vec3<f32>(0.0), top);
        let cell = min(floor(p), max(top - 1.0, vec3<f32>(0.0)));
        let f = p - cell;
        for (var c = 0u; c < 8u; c++) {
            let further = vec3<u32>(c & 1u, (c >> 1u) & 1u, c >> 2u);
            let w = select(1.0 - f, f, further == vec3<u32>(1u));
            stage_visit(min(vec3<u32>(cell) + further, shape - 1u), w.x * w.y * w.z * step * ray.length);
        }
    }
}
