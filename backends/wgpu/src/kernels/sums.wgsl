// Sums over rows. A group takes one block of products over its share of the rows. Rows pass 32 channels of each side
// through workgroup memory, 64 rows at a time, four channels to a vector; every lane sums a block of 4 × 4 products. Vector q of
// row r has position q xor (r mod 8) in the row, so that neither writes nor reads conflict in a bank.

struct Block {
    // First kept channel on the left, and number of channels.
    left: u32,
    outputs: u32,
    right: u32,
    inputs: u32,
    // First partial sum, and partial sums from one channel on the left to the next.
    at: u32,
    ld: u32,
    // First partial sum of the left channels themselves.
    own: u32,
}

const none = 0xffffffffu;

var<workgroup> left: array<vec4<f32>, 512>;
var<workgroup> right: array<vec4<f32>, 512>;

fn place(row: u32, quad: u32) -> u32 {
    return row * 8u + (quad ^ (row & 7u));
}

// Four channels of a row; 0 from `end` on. Without a branch, so that all of a row's reads wait at the same time.
fn quad(c: u32, end: u32, row: u32) -> vec4<f32> {
    let channels = vec4<u32>(c, c + 1u, c + 2u, c + 3u);
    let at = min(channels, vec4<u32>(max(end, 1u) - 1u)) * step.stride + row;
    return select(vec4<f32>(), vec4<f32>(tape[at.x], tape[at.y], tape[at.z], tape[at.w]), channels < vec4<u32>(end));
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) all: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let shares = arrayLength(&partial) / summed;
    let j = lane >> 3u;
    let k = lane & 7u;
    for (var piece = id.x; piece < blocks * shares; piece += all.x) {
        let block = block_of(piece % blocks);
        let share = piece / blocks;
        let left_end = block.left + block.outputs;
        let right_end = block.right + block.inputs;
        var sum0 = vec4<f32>();
        var sum1 = vec4<f32>();
        var sum2 = vec4<f32>();
        var sum3 = vec4<f32>();
        var own = vec4<f32>();
        for (var first = share * 64u; first < step.rows; first += shares * 64u) {
            let row = min(first + lane, step.rows - 1u);
            let live = first + lane < step.rows && dmu[row] != 0.0;
            workgroupBarrier();
            // Four vectors of each side wait for memory at the same time: more would leave too few registers to other groups.
            for (var half = 0u; half < 8u; half += 4u) {
                var a: array<vec4<f32>, 4>;
                var b: array<vec4<f32>, 4>;
                for (var q = 0u; q < 4u; q++) {
                    a[q] = quad(block.left + 4u * (half + q), left_end, row);
                    b[q] = quad(block.right + 4u * (half + q), right_end, row);
                }
                for (var q = 0u; q < 4u; q++) {
                    left[place(lane, half + q)] = select(vec4<f32>(), a[q], live);
                    right[place(lane, half + q)] = select(vec4<f32>(), b[q], live);
                }
            }
            workgroupBarrier();
            if block.inputs == 0u {
                for (var r = 0u; r < 64u && k == 0u; r++) {
                    own += left[place(r, j)];
                }
                continue;
            }
            for (var eight = 0u; eight < 512u; eight += 64u) {
                for (var r = 0u; r < 8u; r++) {
                    let a = left[eight + r * 8u + (j ^ r)];
                    let b = right[eight + r * 8u + (k ^ r)];
                    own += a;
                    sum0 += a.x * b;
                    sum1 += a.y * b;
                    sum2 += a.z * b;
                    sum3 += a.w * b;
                }
            }
        }
        let sums = mat4x4<f32>(sum0, sum1, sum2, sum3);
        for (var p = 0u; p < 4u; p++) {
            let o = 4u * j + p;
            if o < block.outputs {
                let begin = share * summed + block.at + o * block.ld;
                for (var q = 0u; q < 4u; q++) {
                    let i = 4u * k + q;
                    if i < block.inputs { partial[begin + i] += sums[p][q]; }
                }
                if k == 0u && block.own != none { partial[share * summed + block.own + o] += own[p]; }
            }
        }
    }
}
