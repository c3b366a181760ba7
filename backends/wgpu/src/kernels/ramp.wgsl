// Rows of views convolved with the ramp, with rows and columns exchanged and a rim of zeros: a tile of four rows and 64
// columns per group. The rows come in pieces that stay in workgroup memory, four side by side.

const PIECE = 256u;

var<workgroup> piece: array<vec4<f32>, PIECE>;

// Pixel of four rows from row r on; rows beyond the image are 0.
fn four(view: u32, r: u32, c: u32) -> vec4<f32> {
    let at = ((back.first + view) * back.rows + r) * back.columns + c;
    var found = vec4<f32>();
    for (var k = 0u; k < 4u; k++) {
        if r + k < back.rows { found[k] = images[at + k * back.columns]; }
    }
    return found;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32, @builtin(num_workgroups) groups: vec3<u32>) {
    let column = back.rows + 2u;
    let view_size = (back.columns + 2u) * column;
    let down = (column + 3u) / 4u;
    let across = (back.columns + 2u + 63u) / 64u;
    for (var tile = back.begin / 64u + group.x; tile < back.end / 64u; tile += groups.x) {
        let view = tile / (down * across);
        // Of the padded view: row and column 0 are the rim.
        let r = 4u * (tile / across % down);
        let c = 64u * (tile % across) + lane;
        let inside = c > 0u && c <= back.columns;
        var sum = vec4<f32>();
        for (var start = 0u; start < back.columns; start += PIECE) {
            for (var k = lane; k < PIECE; k += 64u) {
                var found = vec4<f32>();
                if start + k < back.columns { found = four(view, r, start + k); }
                piece[k] = found;
            }
            workgroupBarrier();
            if inside {
                let most = min(PIECE, back.columns - start);
                for (var k = 0u; k < most; k++) {
                    sum += taps[u32(abs(i32(c - 1u) - i32(start + k)))] * piece[k];
                }
            }
            workgroupBarrier();
        }
        // Image rows r to r + 3 are padded rows r + 1 to r + 4; row 0 is the rim.
        if c < back.columns + 2u {
            let at = view * view_size + c * column + r;
            if r == 0u { padded[at] = 0.0; }
            for (var k = 0u; k < 4u; k++) {
                if r + k + 1u < column { padded[at + k + 1u] = sum[k]; }
            }
        }
    }
}
