// Voxel-driven, distance-weighted back-projection (Feldkamp, Davis and Kress 1984): four voxels per invocation. Neighbouring
// lanes have neighbouring z and so neighbouring rows of a view, which `padded` holds one after the other.

fn share(v: u32, at: vec4<f32>) -> f32 {
    let depth = dot(seen_views[v].depth, at);
    let near = 1.0 / depth;
    let seen = vec2<f32>(dot(seen_views[v].row, at), dot(seen_views[v].column, at)) * near;
    let size = vec2<f32>(f32(back.rows), f32(back.columns));
    let inside = depth > 0.0 && all(seen > vec2<f32>(-1.0)) && all(seen < size);
    // The rim of zeros is row and column -1.
    let place = select(vec2<f32>(-1.0), seen, inside);
    let low = floor(place);
    let f = place - low;
    let corner = vec2<u32>(vec2<i32>(low) + 1);
    let column = back.rows + 2u;
    let i = (v * (back.columns + 2u) + corner.y) * column + corner.x;
    let left = mix(padded[i], padded[i + 1u], f.x);
    let right = mix(padded[i + column], padded[i + column + 1u], f.x);
    return select(0.0, seen_views[v].scale * near * near * mix(left, right, f.y), inside);
}

fn voxel(i: u32) -> vec4<f32> {
    let line = back.shape.z;
    let plane = back.shape.y * line;
    return vec4<f32>(1.0, f32(back.held + i / plane), f32((i / line) % back.shape.y), f32(i % line));
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = back.begin + group.x * 256u + lane; i < back.end; i += groups.x * 256u) {
        let at0 = voxel(i);
        let at1 = voxel(i + 64u);
        let at2 = voxel(i + 128u);
        let at3 = voxel(i + 192u);
        var sum = vec4<f32>();
        for (var v = 0u; v < back.views; v++) {
            sum += vec4<f32>(share(v, at0), share(v, at1), share(v, at2), share(v, at3));
        }
        volume[i] += sum.x;
        if i + 64u < back.end { volume[i + 64u] += sum.y; }
        if i + 128u < back.end { volume[i + 128u] += sum.z; }
        if i + 192u < back.end { volume[i + 192u] += sum.w; }
    }
}
