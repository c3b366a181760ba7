// A grid of points: x slowest, z fastest.
struct Grid {
    first: vec3<f32>,
    // Points by which a box reaches further down: a whole one if the points are cells, else for rounding.
    slack: f32,
    spacing: vec3<f32>,
    // Factor of a block's penalty and of its derivatives.
    scale: f32,
    shape: vec3<u32>,
    // Points to evaluate.
    count: u32,
}

// The cutoff of a value, squared standard deviations: `EXTENT` of the module `grid`.
const CUT = 16.0;
