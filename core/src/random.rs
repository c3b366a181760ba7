//! Random numbers that depend on a seed and a position only, not on threads or the number of draws.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// A separate generator for `(seed, stream)`.
pub fn stream(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}

/// A well-mixed hash of two numbers (the finalizer of SplitMix64, Steele et al. 2014).
#[inline(always)]
pub fn mix(a: u64, b: u64) -> u64 {
    let mut z = a ^ b.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// A number in [0, 1) from the upper bits of `h`.
#[inline(always)]
pub fn unit(h: u64) -> f32 {
    (h >> 40) as f32 * (1.0 / 16_777_216.0)
}

/// Number `i` of a seed, uniform in ±`bound`.
#[inline(always)]
pub fn uniform(seed: u64, i: usize, bound: f64) -> f32 {
    ((2.0 * f64::from(unit(mix(seed, i as u64))) - 1.0) * bound) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unit_numbers_stay_below_one_and_average_half() {
        let n = 10_000u64;
        let mean: f64 = (0..n).map(|i| f64::from(unit(mix(7, i)))).sum::<f64>() / n as f64;
        assert!((mean - 0.5).abs() < 0.01, "{mean}");
        assert!(unit(u64::MAX) < 1.0);
    }
}
