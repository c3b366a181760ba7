// A Gaussian on a view's detector: see the module `view`, whose polynomials these are.
struct Footprint {
    middle: vec2<f32>,
    // Coefficients of N: of du², du·dv; dv² and the first of a follow.
    n0: vec2<f32>,
    // Of N: of dv². Of a: of 1, du, dv.
    n2_a0: vec4<f32>,
    // Of a: of du², du·dv, dv². Then ρ·√(2π).
    a3_weight: vec4<f32>,
}

// N at the distances du and dv from the middle.
fn numerator(f: Footprint, du: f32, dv: vec4<f32>) -> vec4<f32> {
    return f.n0.x * du * du + dv * (f.n0.y * du + f.n2_a0.x * dv);
}

// a at the same distances.
fn square(f: Footprint, du: f32, dv: vec4<f32>) -> vec4<f32> {
    let flat = f.n2_a0.y + du * (f.n2_a0.z + f.a3_weight.x * du);
    return flat + dv * (f.n2_a0.w + f.a3_weight.y * du + f.a3_weight.z * dv);
}

// The cutoff of a line integral, squared standard deviations: `EXTENT` of the module `view`.
const CUT = 12.25;
