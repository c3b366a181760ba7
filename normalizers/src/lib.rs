//! Normalizers between encoder and field: LayerNorm, FFT channel mask

pub mod fft_mask;
pub mod layer_norm;
