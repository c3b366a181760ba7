//! Precision of a field's arithmetic.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The precision of a field. Sums, gradients, moments and trained parameters are always `f32`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Precision {
    /// Storage precision of feature tables for reading. Training and weights files keep `f32`; half precision is a
    /// copy.
    pub tables: Tables,
}

impl Precision {
    /// Whether everything is `f32`.
    pub fn is_single(&self) -> bool {
        self.tables == Tables::F32
    }
}

/// Storage precision of sparsely accessed tables.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Tables {
    /// Single precision, without a copy.
    #[default]
    F32,
    /// 11 significant bits, magnitudes from 6e-8 to 65504; larger ones become 65504.
    F16,
    /// 8 significant bits, the range of `f32`.
    Bf16,
}

impl std::fmt::Display for Tables {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Bf16 => "bf16",
        })
    }
}
