// Whether `v` is true for any of a group.
fn any_of_group(v: bool) -> bool {
    workgroupBarrier();
    if lane == 0u {
        left[0] = vec4<f32>();
    }
    workgroupBarrier();
    // All write the same.
    if v {
        left[0] = vec4<f32>(1.0);
    }
    workgroupBarrier();
    return workgroupUniformLoad(&left[0]).x > 0.0;
}
