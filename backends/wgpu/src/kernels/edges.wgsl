// Central differences at voxel i, smoothed by 1-2-1 along the other two axes (Sobel), times `up`. Voxels outside the
// volume repeat the nearest one; there is no difference across the far faces.
fn edge_at(i: u32) -> vec3<f32> {
    let shape = vec3<i32>(stencil.shape);
    let p = vec3<i32>(place(i));
    var s = vec3<f32>();
    for (var a = -1; a <= 1; a++) {
        for (var b = -1; b <= 1; b++) {
            for (var c = -1; c <= 1; c++) {
                let at = clamp(p + vec3<i32>(a, b, c), vec3<i32>(), shape - 1);
                let d = vec3<f32>(f32(a), f32(b), f32(c));
                let w = vec3<f32>(0.5) - 0.25 * abs(d);
                s += 0.5 * d * vec3<f32>(w.y * w.z, w.x * w.z, w.x * w.y) * value(vec3<u32>(at));
            }
        }
    }
    return select(s * stencil.up, vec3<f32>(), p + 1 == shape);
}
