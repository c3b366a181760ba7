// The part of a ray inside a box of voxels, from the source on: entry and exit, with exit ≤ entry if the ray misses it.
// As in walk.rs.
fn stage_clip(ray: VoxelRay, lower: vec3<f32>, upper: vec3<f32>) -> vec2<f32> {
    var near = 0.0;
    var far = 1e30;
    for (var k = 0u; k < 3u; k++) {
        if ray.ahead[k] == 0.0 {
            if ray.source[k] < lower[k] || ray.source[k] > upper[k] {
                return vec2<f32>(1.0, 0.0);
            }
            continue;
        }
        let a = (lower[k] - ray.source[k]) / ray.ahead[k];
        let b = (upper[k] - ray.source[k]) / ray.ahead[k];
        near = max(near, min(a, b));
        far = min(far, max(a, b));
    }
    return vec2<f32>(near, far);
}
