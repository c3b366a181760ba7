// Whether `v` is true for any of a group.
fn any_of_group(v: bool) -> bool {
    workgroupBarrier();
    left[lane] = select(0.0, 1.0, v);
    workgroupBarrier();
    for (var half = 32u; half > 0u; half >>= 1u) {
        if lane < half {
            left[lane] += left[lane + half];
        }
        workgroupBarrier();
    }
    return workgroupUniformLoad(&left[0]) > 0.0;
}
