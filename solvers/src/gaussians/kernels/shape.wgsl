// A Gaussian `density·exp(-½|M(x - centre)|²)`; a free slot has density 0.
struct Shape {
    centre: vec3<f32>,
    density: f32,
    // Rows of M, with the standard deviation along each.
    m0: vec3<f32>,
    s0: f32,
    m1: vec3<f32>,
    s1: f32,
    m2: vec3<f32>,
    s2: f32,
}

// M·x.
fn to_deviations(s: Shape, x: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(dot(s.m0, x), dot(s.m1, x), dot(s.m2, x));
}

// Mᵀ·x.
fn from_deviations(s: Shape, x: vec3<f32>) -> vec3<f32> {
    return x.x * s.m0 + x.y * s.m1 + x.z * s.m2;
}
