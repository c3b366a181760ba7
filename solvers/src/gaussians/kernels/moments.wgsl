var<workgroup> sums: array<array<vec4<f32>, 3>, 64>;

// Keeps the sums of a group's lanes as the moments of Gaussian i.
fn keep_moments(i: u32, lane: u32, own: array<vec4<f32>, 3>) {
    sums[lane] = own;
    workgroupBarrier();
    for (var half = 32u; half > 0u; half >>= 1u) {
        if lane < half {
            for (var k = 0u; k < 3u; k++) {
                sums[lane][k] += sums[lane + half][k];
            }
        }
        workgroupBarrier();
    }
    if lane < 3u {
        moments[3u * i + lane] = sums[0][lane];
    }
    workgroupBarrier();
}
