//! Normalizers between encoder and field: LayerNorm.

pub mod layer_norm;
