// Which samples a step takes where cells are known to be empty: conefield_core::occupancy.

struct Cells {
    low: vec3<f32>,
    // One ray in so many takes all its samples; 0 for none.
    probe: u32,
    per_side: vec3<f32>,
    shape: vec3<u32>,
}

fn holds(p: vec3<f32>) -> bool {
    let at = (p - cells.low) * cells.per_side;
    if !(all(at >= vec3<f32>(0.0)) && all(at < vec3<f32>(cells.shape))) {
        return true;
    }
    let cell = vec3<u32>(at);
    let i = (cell.x * cells.shape.y + cell.y) * cells.shape.z + cell.z;
    return ((occupied[i >> 5u] >> (i & 31u)) & 1u) == 1u;
}

fn probes(seed: vec2<u32>) -> bool {
    return cells.probe > 0u && random_mix(seed, PROBE).x % cells.probe == 0u;
}

fn taken(ray: Ray, sample: vec4<f32>) -> vec4<f32> {
    if holds(sample.xyz) || probes(ray.seed) {
        return sample;
    }
    atomicAdd(&left_out[0], 1u);
    return vec4<f32>(sample.xyz, 0.0);
}
