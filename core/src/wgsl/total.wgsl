var<workgroup> parts: array<f32, 64>;

// The sum of `v` over the 64 invocations of a group, in a fixed order.
fn total(lane: u32, v: f32) -> f32 {
    parts[lane] = v;
    workgroupBarrier();
    for (var half = 32u; half > 0u; half >>= 1u) {
        if lane < half {
            parts[lane] += parts[lane + half];
        }
        workgroupBarrier();
    }
    return parts[0];
}
