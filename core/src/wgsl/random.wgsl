// Random numbers that depend on a seed and a position only, as in conefield_core::random, bit for bit. 64-bit numbers
// are pairs of 32-bit numbers, the lower first.

fn random_times(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let a0 = a.x & 0xffffu;
    let a1 = a.x >> 16u;
    let b0 = b.x & 0xffffu;
    let b1 = b.x >> 16u;
    let low = a0 * b0;
    let middle = a1 * b0 + (low >> 16u);
    let middle2 = a0 * b1 + (middle & 0xffffu);
    let high = a1 * b1 + (middle >> 16u) + (middle2 >> 16u);
    return vec2<u32>((middle2 << 16u) | (low & 0xffffu), high + a.x * b.y + a.y * b.x);
}

// z ^ (z >> shift), for shifts from 1 to 31.
fn random_fold(z: vec2<u32>, shift: u32) -> vec2<u32> {
    return z ^ vec2<u32>((z.x >> shift) | (z.y << (32u - shift)), z.y >> shift);
}

// The finalizer of SplitMix64 (Steele et al. 2014).
fn random_mix(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    var z = a ^ random_times(b, vec2<u32>(0x7f4a7c15u, 0x9e3779b9u));
    z = random_times(random_fold(z, 30u), vec2<u32>(0x1ce4e5b9u, 0xbf58476du));
    z = random_times(random_fold(z, 27u), vec2<u32>(0x133111ebu, 0x94d049bbu));
    return random_fold(z, 31u);
}

// A number in [0, 1) from the upper 24 bits.
fn random_unit(h: vec2<u32>) -> f32 {
    return f32(h.y >> 8u) * (1.0 / 16777216.0);
}
