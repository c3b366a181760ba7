//! The ramp filter along detector rows.
//!
//! The ramp is the discrete one in space (Kak and Slaney, Principles of Computerized Tomographic Imaging, eq. 3.61):
//! `h(0) = 1/4τ²`, `h(n) = −1/(πnτ)²` for odd n, 0 for even n. A ramp sampled in frequency would lose the mean. Rows
//! are zero-padded to twice their length, so that the convolution does not wrap; a window may damp high frequencies.

use conefield_fourier::{Complex, Fft, forward_f64, pair_f32};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;
use std::sync::Arc;

/// The window of the ramp filter; `x` is the frequency divided by the window's cutoff.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Window {
    /// None: 1.
    Ramp,
    /// `sin(πx/2)/(πx/2)`.
    SheppLogan,
    /// `cos(πx/2)`.
    Cosine,
    /// `0.54 + 0.46·cos(πx)`.
    Hamming,
    /// `(1 + cos(πx))/2`.
    Hann,
}

impl Window {
    /// The window at `x` in [0, 1].
    pub fn at(self, x: f64) -> f64 {
        match self {
            Window::Ramp => 1.0,
            Window::SheppLogan if x == 0.0 => 1.0,
            Window::SheppLogan => (PI * x / 2.0).sin() / (PI * x / 2.0),
            Window::Cosine => (PI * x / 2.0).cos(),
            Window::Hamming => 0.54 + 0.46 * (PI * x).cos(),
            Window::Hann => 0.5 * (1.0 + (PI * x).cos()),
        }
    }
}

/// A ramp filter for rows of one length and pixel pitch.
pub struct Ramp {
    forward: Arc<dyn Fft<f32>>,
    inverse: Arc<dyn Fft<f32>>,
    /// The filter's transform over the padded length, with the normalization of the inverse transform.
    response: Vec<f32>,
}

impl Ramp {
    /// A filter for rows of `columns` pixels of `pitch` mm. The window ends at `cutoff` times the Nyquist frequency and
    /// blocks everything beyond.
    pub fn new(columns: usize, pitch: f64, window: Window, cutoff: f64) -> Self {
        let n = (2 * columns).next_power_of_two();
        let kernel = |i: usize| {
            let i = i.min(n - i);
            match i {
                0 => 0.25 / (pitch * pitch),
                i if i % 2 == 1 => -1.0 / (PI * i as f64 * pitch).powi(2),
                _ => 0.0,
            }
        };
        let mut spectrum: Vec<Complex<f64>> = (0..n).map(|i| Complex::new(kernel(i), 0.0)).collect();
        forward_f64(n).process(&mut spectrum);
        let response = spectrum.iter().enumerate().map(|(i, h)| {
            let x = i.min(n - i) as f64 / (0.5 * n as f64) / cutoff;
            let window = if x > 1.0 { 0.0 } else { window.at(x) };
            (h.re * window * pitch / n as f64) as f32
        });
        let response = response.collect();
        let [forward, inverse] = pair_f32(n);
        Self { forward, inverse, response }
    }

    /// The same filter in space: the factor of a pixel by its distance, for distances below `columns`.
    pub fn taps(&self, columns: usize) -> Vec<f32> {
        let mut taps: Vec<Complex<f64>> = self.response.iter().map(|r| Complex::new(f64::from(*r), 0.0)).collect();
        forward_f64(taps.len()).process(&mut taps);
        taps[..columns].iter().map(|tap| tap.re as f32).collect()
    }

    /// Filters consecutive rows of equal length in `rows`, two per complex transform.
    pub fn filter(&self, rows: &mut [f32], columns: usize) {
        let n = self.response.len();
        let mut pair = vec![Complex::new(0.0, 0.0); n];
        let scratch = self.forward.get_inplace_scratch_len().max(self.inverse.get_inplace_scratch_len());
        let mut scratch = vec![Complex::new(0.0, 0.0); scratch];
        for two in rows.chunks_mut(2 * columns) {
            let (a, b) = two.split_at_mut(columns);
            for (i, p) in pair.iter_mut().enumerate() {
                let at = |row: &[f32]| row.get(i).copied().unwrap_or(0.0);
                *p = Complex::new(at(a), at(b));
            }
            self.forward.process_with_scratch(&mut pair, &mut scratch);
            for (p, r) in pair.iter_mut().zip(&self.response) {
                *p *= r;
            }
            self.inverse.process_with_scratch(&mut pair, &mut scratch);
            a.iter_mut().zip(&pair).for_each(|(x, p)| *x = p.re);
            b.iter_mut().zip(&pair).for_each(|(x, p)| *x = p.im);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_rows_at_once_are_two_convolutions() {
        let (columns, pitch) = (9, 0.7);
        let a: Vec<f32> = (0..columns).map(|i| (i as f32 * 0.9).sin() + 1.0).collect();
        let b: Vec<f32> = (0..columns).map(|i| (i * i % 5) as f32).collect();
        let mut rows = [a.clone(), b.clone(), a.clone()].concat();
        Ramp::new(columns, pitch, Window::Ramp, 1.0).filter(&mut rows, columns);
        let kernel = |n: i64| match n {
            0 => 0.25 / (pitch * pitch),
            n if n % 2 != 0 => -1.0 / (PI * n as f64 * pitch).powi(2),
            _ => 0.0,
        };
        for (row, want) in rows.chunks(columns).zip([&a, &b, &a]) {
            for (i, x) in row.iter().enumerate() {
                let sum: f64 = (0..columns).map(|k| f64::from(want[k]) * kernel(i as i64 - k as i64)).sum();
                assert!((f64::from(*x) - pitch * sum).abs() < 1e-5, "{i}: {x} and {}", pitch * sum);
            }
        }
    }

    #[test]
    fn taps_are_the_filter_in_space() {
        let (columns, pitch) = (23, 0.7);
        for (window, cutoff) in [(Window::Ramp, 1.0), (Window::Hann, 0.6)] {
            let ramp = Ramp::new(columns, pitch, window, cutoff);
            let row: Vec<f32> = (0..columns).map(|i| (i as f32 * 0.9).sin() + 1.0).collect();
            let (taps, mut filtered) = (ramp.taps(columns), row.clone());
            ramp.filter(&mut filtered, columns);
            for (i, x) in filtered.iter().enumerate() {
                let sum: f32 = row.iter().enumerate().map(|(k, v)| taps[i.abs_diff(k)] * v).sum();
                assert!((x - sum).abs() < 1e-5, "{window:?}, {i}: {x} and {sum}");
            }
        }
    }

    #[test]
    fn windows_start_at_one_and_damp_high_frequencies() {
        for w in [Window::SheppLogan, Window::Cosine, Window::Hamming, Window::Hann] {
            assert!((w.at(0.0) - 1.0).abs() < 1e-12, "{w:?}");
            assert!(w.at(1.0) < 0.7 && w.at(0.5) > w.at(1.0), "{w:?}");
        }
    }
}
