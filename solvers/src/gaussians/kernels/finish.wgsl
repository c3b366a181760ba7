// Adds the partial sums of a view or of a block to the statistics of a step: loss, dissimilarity, penalty; largest lists.
var<workgroup> all: array<vec2<f32>, 64>;

@compute @workgroup_size(64)
fn main(@builtin(local_invocation_index) lane: u32) {
    var own = vec2<f32>();
    for (var i = lane; i < bins.count; i += 64u) {
        own += partial[i];
    }
    all[lane] = own;
    workgroupBarrier();
    for (var half = 32u; half > 0u; half >>= 1u) {
        if lane < half {
            all[lane] += all[lane + half];
        }
        workgroupBarrier();
    }
    if lane == 0u {
        FINISH
    }
}
