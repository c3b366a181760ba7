//! Normalizers between encoder and field: LayerNorm, FFT channel mask
