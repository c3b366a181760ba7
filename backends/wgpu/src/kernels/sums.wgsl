// Sums over the 64 rows of a group. Rows hand their numbers over through workgroup memory, 32 channels of each side at a
// time; every one of the 64 then sums a block of 4 × 4 products over all rows. Channel c of row r stands at place
// (c + r) mod 32 of the row, so that neither writing nor reading meets the same bank twice.

var<private> lane: u32;
var<private> group: u32;
var<workgroup> left: array<f32, 2048>;
var<workgroup> right: array<f32, 2048>;

fn sums_place(row: u32, channel: u32) -> u32 {
    return row * 32u + ((channel + row) & 31u);
}

// The sums of a block, whose first channels are `j` on the left and `k` on the right.
fn sums_block(j: u32, k: u32) -> mat4x4<f32> {
    var sum = mat4x4<f32>();
    for (var r = 0u; r < 64u; r++) {
        let a = vec4<f32>(
            left[sums_place(r, j)], left[sums_place(r, j + 1u)], left[sums_place(r, j + 2u)], left[sums_place(r, j + 3u)]);
        let b = vec4<f32>(
            right[sums_place(r, k)], right[sums_place(r, k + 1u)], right[sums_place(r, k + 2u)], right[sums_place(r, k + 3u)]);
        sum[0] += a.x * b;
        sum[1] += a.y * b;
        sum[2] += a.z * b;
        sum[3] += a.w * b;
    }
    return sum;
}

// The sum of channel `lane mod 32` of the left side, by the first 32 of the group.
fn sums_channel() -> f32 {
    let c = lane & 31u;
    let begin = (lane >> 5u) * 32u;
    var sum = 0.0;
    for (var r = begin; r < begin + 32u; r++) {
        sum += left[sums_place(r, c)];
    }
    right[lane] = sum;
    workgroupBarrier();
    return sum + right[(lane + 32u) & 63u];
}
