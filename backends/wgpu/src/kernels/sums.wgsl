// Sums over the 64 rows of a group. Rows hand their numbers over through workgroup memory, 32 channels of each side at a
// time, four to a vector; every one of the 64 then sums a block of 4 × 4 products over all rows. Vector q of row r stands at
// place q xor (r mod 8) of the row, so that neither writing nor reading meets the same bank twice.

var<private> lane: u32;
var<private> group: u32;
var<workgroup> left: array<vec4<f32>, 512>;
var<workgroup> right: array<vec4<f32>, 512>;

fn sums_place(row: u32, quad: u32) -> u32 {
    return row * 8u + (quad ^ (row & 7u));
}

// The sums of a block of vectors `j` on the left and `k` on the right.
fn sums_block(j: u32, k: u32) -> mat4x4<f32> {
    var sum0 = vec4<f32>();
    var sum1 = vec4<f32>();
    var sum2 = vec4<f32>();
    var sum3 = vec4<f32>();
    for (var first = 0u; first < 512u; first += 64u) {
        for (var r = 0u; r < 8u; r++) {
            let a = left[first + r * 8u + (j ^ r)];
            let b = right[first + r * 8u + (k ^ r)];
            sum0 += a.x * b;
            sum1 += a.y * b;
            sum2 += a.z * b;
            sum3 += a.w * b;
        }
    }
    return mat4x4<f32>(sum0, sum1, sum2, sum3);
}

// The sum of channel `lane mod 32` of the left side, by the first 32 of the group.
fn sums_channel() -> f32 {
    let c = lane & 31u;
    let begin = (lane >> 5u) * 32u;
    var sum = 0.0;
    for (var r = begin; r < begin + 32u; r++) {
        sum += left[sums_place(r, c >> 2u)][c & 3u];
    }
    right[lane].x = sum;
    workgroupBarrier();
    return sum + right[(lane + 32u) & 63u].x;
}
