// Bins of points: pixels of an image, or points of a grid. A box has a range of points per axis: first | end << 16.
struct Bins {
    // Bins per axis, and in all.
    shape: vec3<u32>,
    count: u32,
    // Points per bin and axis.
    tile: vec3<u32>,
    // Room in `entries`.
    room: u32,
}

// First bins of a box, and the bins after its last.
fn begin_of(box: vec4<u32>) -> vec3<u32> {
    return (box.xyz & vec3<u32>(0xffffu)) / bins.tile;
}

fn end_of(box: vec4<u32>) -> vec3<u32> {
    return ((box.xyz >> vec3<u32>(16u)) + bins.tile - 1u) / bins.tile;
}
