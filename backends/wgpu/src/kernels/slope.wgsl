// Slope of the smoothed total variation at voxel i, with differences times `step`.
fn smoothed_at(p: vec3<u32>) -> vec4<f32> {
    let d = stencil.step * differences(p);
    return vec4<f32>(d, sqrt(dot(d, d) + 1.0));
}

fn slope_at(i: u32) -> f32 {
    let p = place(i);
    let g = stencil.up;
    let here = smoothed_at(p);
    var sum = -dot(g, here.xyz) / here.w;
    if p.x > 0u { let d = smoothed_at(p - vec3<u32>(1u, 0u, 0u)); sum += g.x * d.x / d.w; }
    if p.y > 0u { let d = smoothed_at(p - vec3<u32>(0u, 1u, 0u)); sum += g.y * d.y / d.w; }
    if p.z > 0u { let d = smoothed_at(p - vec3<u32>(0u, 0u, 1u)); sum += g.z * d.z / d.w; }
    return sum;
}
