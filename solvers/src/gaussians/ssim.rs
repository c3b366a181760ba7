//! Structural similarity of a projected and a measured view, with its gradient (Wang et al., IEEE Trans. Image Process.
//! 13(4), 2004): a Gaussian window of 11 × 11 pixels with σ 1.5 and zero padding, as in the published code.

use conefield_core::parallel;
use conefield_core::simd::{self, Op, Simd, SimdBase, SimdFloat, V, load, store};

/// Pixels on each side of the window's centre.
const REACH: usize = 5;
const TAPS: usize = 2 * REACH + 1;

/// Intermediate images. Reused from view to view to keep their memory.
#[derive(Debug, Default)]
pub struct Ssim {
    maps: [Vec<f32>; 5],
    slopes: [Vec<f32>; 3],
    between: Vec<f32>,
}

impl Ssim {
    /// Bytes for images of `numbers` values.
    pub fn bytes(numbers: u64) -> u64 {
        9 * 4 * numbers
    }

    /// The mean similarity of `found` and `wanted` over rows of `columns` pixels, `stride` numbers apart; the padding
    /// is 0 in both. `range` is the range of the values. Adds `scale` times the derivative with respect to each pixel
    /// of `found` to `gradient`.
    pub fn add(
        &mut self,
        [found, wanted]: [&[f32]; 2],
        [columns, stride]: [usize; 2],
        range: f64,
        scale: f64,
        gradient: &mut [f32],
    ) -> f64 {
        let Self { maps, slopes, between } = self;
        let taps = window();
        for (map, [a, b]) in
            maps.iter_mut().zip([[found, &[]], [wanted, &[]], [found; 2], [wanted; 2], [found, wanted]])
        {
            blur(&taps, [a, b], map, between, stride);
        }
        let [c1, c2] = [0.01, 0.03].map(|k: f64| ((k * range).powi(2)) as f32);
        let pixels = (found.len() / stride * columns) as f64;
        let weight = (scale / pixels) as f32;
        slopes.iter_mut().for_each(|s| s.resize(found.len(), 0.0));
        let [m1, m2, a, b, c] = &*maps;
        let [by_mean, by_square, by_product] = slopes;
        let rows = by_mean.chunks_mut(stride).zip(by_square.chunks_mut(stride)).zip(by_product.chunks_mut(stride));
        let sums = parallel::map(rows, |row, ((by_mean, by_square), by_product)| {
            let mut sum = 0.0;
            for i in 0..stride {
                let at = row * stride + i;
                let (x, y) = (m1[at], m2[at]);
                let (vx, vy, vxy) = (a[at] - x * x, b[at] - y * y, c[at] - x * y);
                let (a1, a2) = (2.0 * x * y + c1, 2.0 * vxy + c2);
                let (b1, b2) = (x * x + y * y + c1, vx + vy + c2);
                let s = a1 * a2 / (b1 * b2);
                // Windows centred on padding do not count.
                let weight = if i < columns { weight } else { 0.0 };
                sum += if i < columns { f64::from(s) } else { 0.0 };
                by_mean[i] = weight * 2.0 * (y * (a2 - a1) / (b1 * b2) + x * s * (1.0 / b2 - 1.0 / b1));
                by_square[i] = -weight * s / b2;
                by_product[i] = weight * 2.0 * a1 / (b1 * b2);
            }
            sum
        });
        for (slope, map) in [by_mean, by_square, by_product].into_iter().zip(maps.iter_mut()) {
            blur(&taps, [slope, &[]], map, between, stride);
        }
        let [by_mean, by_square, by_product, ..] = &*maps;
        parallel::over(gradient.chunks_mut(stride), |row, gradient| {
            for i in 0..columns {
                let at = row * stride + i;
                gradient[i] += by_mean[at] + 2.0 * found[at] * by_square[at] + wanted[at] * by_product[at];
            }
        });
        sums.iter().sum::<f64>() / pixels
    }
}

/// The window along one axis.
pub(super) fn window() -> [f32; TAPS] {
    let raw: [f64; TAPS] = std::array::from_fn(|i| (-0.5 * ((i as f64 - REACH as f64) / 1.5).powi(2)).exp());
    let sum: f64 = raw.iter().sum();
    raw.map(|x| (x / sum) as f32)
}

/// Blurs the product of two images, or one image if the other is empty, with the window. The window is symmetric, so
/// that the blur is its own adjoint.
fn blur(
    taps: &[f32; TAPS],
    [image, times]: [&[f32]; 2],
    blurred: &mut Vec<f32>,
    between: &mut Vec<f32>,
    stride: usize,
) {
    between.resize(image.len(), 0.0);
    blurred.resize(image.len(), 0.0);
    let rows = image.len() / stride;
    parallel::over(between.chunks_mut(stride), |row, out| {
        let own = row * stride..(row + 1) * stride;
        let mut padded = vec![0.0; stride + TAPS];
        padded[REACH..REACH + stride].copy_from_slice(&image[own.clone()]);
        if let Some(times) = times.get(own) {
            padded[REACH..].iter_mut().zip(times).for_each(|(x, y)| *x *= y);
        }
        let lines: [&[f32]; TAPS] = std::array::from_fn(|k| &padded[k..k + stride]);
        simd::run(Weighted { taps, lines, out });
    });
    let between = &*between;
    parallel::over(blurred.chunks_mut(stride), |row, out| {
        let lines: [&[f32]; TAPS] = std::array::from_fn(|k| match (row + k).checked_sub(REACH) {
            Some(r) if r < rows => &between[r * stride..(r + 1) * stride],
            _ => &[],
        });
        simd::run(Weighted { taps, lines, out });
    });
}

/// The weighted sum of some lines; an empty line counts as zeros.
struct Weighted<'a> {
    taps: &'a [f32; TAPS],
    lines: [&'a [f32]; TAPS],
    out: &'a mut [f32],
}

impl Op for Weighted<'_> {
    type Number = f32;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let mut i = 0;
        while i < self.out.len() {
            let mut sum = V::<S, f32>::splat(s, 0.0);
            for (line, tap) in self.lines.iter().zip(self.taps) {
                if !line.is_empty() {
                    sum = load(s, line, i).mul_add(V::<S, f32>::splat(s, *tap), sum);
                }
            }
            store::<S, f32>(sum, self.out, i);
            i += V::<S, f32>::LEN;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 3] = [13, 17, 21];

    fn image(seed: usize) -> Vec<f32> {
        let [rows, columns, stride] = SIZE;
        let value = |i: usize| ((i * 37 + seed * 11) % 29) as f32 / 29.0;
        (0..rows * stride).map(|i| if i % stride < columns { value(i) } else { 0.0 }).collect()
    }

    fn similarity(x: &[f32], y: &[f32]) -> (f64, Vec<f32>) {
        let mut gradient = vec![0.0; x.len()];
        let s = Ssim::default().add([x, y], [SIZE[1], SIZE[2]], 1.0, 1.0, &mut gradient);
        (s, gradient)
    }

    #[test]
    fn an_image_is_like_itself_and_less_like_another() {
        let (x, y) = (image(1), image(2));
        let (same, gradient) = similarity(&x, &x);
        assert!((same - 1.0).abs() < 1e-5 && gradient.iter().all(|g| g.abs() < 1e-4), "{same}");
        assert!(similarity(&x, &y).0 < 0.9);
    }

    #[test]
    fn the_gradient_is_that_of_finite_differences() {
        let (x, y) = (image(1), image(2));
        let (_, gradient) = similarity(&x, &y);
        let most = gradient.iter().fold(0.0f32, |m, g| m.max(g.abs()));
        for at in [0, 16, 3 * 21 + 4, 6 * 21 + 8, 12 * 21 + 2] {
            let moved = |h: f32| {
                let mut x = x.clone();
                x[at] += h;
                similarity(&x, &y).0
            };
            let slope = (moved(0.01) - moved(-0.01)) / 0.02;
            assert!((slope - f64::from(gradient[at])).abs() < 0.02 * f64::from(most), "{at}: {slope} {}", gradient[at]);
        }
    }
}
