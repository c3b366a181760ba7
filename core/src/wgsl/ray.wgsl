// A ray in the unit cube: origin + t·direction, t in cube sides.
struct Ray {
    origin: vec3<f32>,
    // Cube sides per millimetre.
    per_mm: f32,
    direction: vec3<f32>,
    // The measured line integral.
    measured: f32,
    // Entry into and exit from the reconstruction box; equal if the ray misses it.
    inside: vec2<f32>,
    // Beginning and end of the published sampling range.
    published: vec2<f32>,
    // 64 bits, the lower first.
    seed: vec2<u32>,
    // Row of the first sample.
    first: u32,
    // Number of samples.
    count: u32,
}
