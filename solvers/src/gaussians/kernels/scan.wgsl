// Where each bin's list begins, and where they end; the counts are zero afterwards. One group; each lane takes a run of bins.
var<workgroup> sums: array<u32, 256>;

// The sum, at most the largest number: no buffer has room for lists of that length.
fn together(a: u32, b: u32) -> u32 {
    return a + min(b, 0xffffffffu - a);
}

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let each = (bins.count + 255u) / 256u;
    let begin = min(lane * each, bins.count);
    let end = min(begin + each, bins.count);
    var own = 0u;
    for (var i = begin; i < end; i++) {
        own = together(own, counts[i]);
    }
    sums[lane] = own;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step <<= 1u) {
        var before = 0u;
        if lane >= step {
            before = sums[lane - step];
        }
        workgroupBarrier();
        sums[lane] = together(sums[lane], before);
        workgroupBarrier();
    }
    var at = sums[lane] - own;
    for (var i = begin; i < end; i++) {
        let count = counts[i];
        starts[i] = at;
        next[i] = at;
        counts[i] = 0u;
        at += count;
    }
    if lane == 255u {
        starts[bins.count] = sums[255];
    }
}
