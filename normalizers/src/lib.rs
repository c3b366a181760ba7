//! Normalizers between encoder and field: LayerNorm, attention over levels.

pub mod layer_norm;
pub mod level_attention;
