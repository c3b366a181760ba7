// Exact lengths inside voxels (Siddon 1985), traversed voxel by voxel (Amanatides and Woo).

fn stage_wall(ray: VoxelRay, k: u32, voxel: i32) -> f32 {
    if ray.ahead[k] == 0.0 {
        return 1e30;
    }
    return (f32(voxel) + select(-0.5, 0.5, ray.ahead[k] > 0.0) - ray.source[k]) / ray.ahead[k];
}

fn stage_walk(ray: VoxelRay) {
    let last = vec3<i32>(stage_shape()) - 1;
    let inside = stage_clip(ray, vec3<f32>(-0.5), vec3<f32>(last) + 0.5);
    if inside.y <= inside.x {
        return;
    }
    let start = ray.source + (inside.x + 1e-6 * (inside.y - inside.x)) * ray.ahead;
    var voxel = clamp(vec3<i32>(floor(start + 0.5)), vec3<i32>(0), last);
    var next = vec3<f32>(stage_wall(ray, 0u, voxel.x), stage_wall(ray, 1u, voxel.y), stage_wall(ray, 2u, voxel.z));
    var t = inside.x;
    // Upper bound of the number of walls that a ray crosses.
    let most = u32(last.x + last.y + last.z) + 4u;
    for (var i = 0u; i < most; i++) {
        var k = 0u;
        if next.y < next[k] {
            k = 1u;
        }
        if next.z < next[k] {
            k = 2u;
        }
        let end = min(next[k], inside.y);
        if end > t {
            stage_visit(vec3<u32>(voxel), (end - t) * ray.length);
            t = end;
        }
        if next[k] >= inside.y {
            return;
        }
        // DirectX's compiler refuses to write a component that data chooses.
        let own = vec3<u32>(k) == vec3<u32>(0u, 1u, 2u);
        voxel += select(vec3<i32>(0), vec3<i32>(select(-1, 1, ray.ahead[k] > 0.0)), own);
        if voxel[k] < 0 || voxel[k] > last[k] {
            return;
        }
        next = select(next, vec3<f32>(stage_wall(ray, k, voxel[k])), own);
    }
}
