// Bilinear interpolation from plane to plane of voxel centres across the main direction (Joseph 1982).

fn stage_corner(plane: i32, a: i32, b: i32, main: u32, shape: vec3<i32>, weight: f32) {
    // DirectX's compiler refuses to write a component that data chooses.
    let across = select(vec3<i32>(a, b, plane), vec3<i32>(b, plane, a), main == 1u);
    let at = select(across, vec3<i32>(plane, a, b), main == 0u);
    if all(at >= vec3<i32>(0)) && all(at < shape) {
        stage_visit(vec3<u32>(at), weight);
    }
}

fn stage_walk(ray: VoxelRay) {
    let shape = vec3<i32>(stage_shape());
    let size = abs(ray.ahead);
    var main = 2u;
    if size.x >= size.y && size.x >= size.z {
        main = 0u;
    } else if size.y >= size.z {
        main = 1u;
    }
    // One more plane on all sides: positions on the edge are tested voxel by voxel.
    let inside = stage_clip(ray, vec3<f32>(-1.0), vec3<f32>(shape));
    if inside.y <= inside.x {
        return;
    }
    let first_end = ray.source[main] + inside.x * ray.ahead[main];
    let last_end = ray.source[main] + inside.y * ray.ahead[main];
    let first = max(i32(ceil(min(first_end, last_end) - 1.0)), 0);
    let last = min(i32(floor(max(first_end, last_end) + 1.0)), shape[main] - 1);
    let step = ray.length / size[main];
    let u = (main + 1u) % 3u;
    let v = (main + 2u) % 3u;
    for (var plane = first; plane <= last; plane++) {
        let t = (f32(plane) - ray.source[main]) / ray.ahead[main];
        if t <= 0.0 {
            continue;
        }
        let a = ray.source[u] + t * ray.ahead[u];
        let b = ray.source[v] + t * ray.ahead[v];
        let ca = floor(a);
        let cb = floor(b);
        let fa = a - ca;
        let fb = b - cb;
        let i = i32(ca);
        let j = i32(cb);
        stage_corner(plane, i, j, main, shape, (1.0 - fa) * (1.0 - fb) * step);
        stage_corner(plane, i, j + 1, main, shape, (1.0 - fa) * fb * step);
        stage_corner(plane, i + 1, j, main, shape, fa * (1.0 - fb) * step);
        stage_corner(plane, i + 1, j + 1, main, shape, fa * fb * step);
    }
}
