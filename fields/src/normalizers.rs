//! Normalizers between encoder and field: LayerNorm, attention over levels, attention along rays.

pub mod layer_norm;
pub mod level_attention;
pub mod line_attention;
