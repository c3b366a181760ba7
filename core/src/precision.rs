//! In which precision a field computes.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// In which precision a field computes. Sums, gradients, moments and the parameters that training changes are `f32`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Precision {
    /// In which tables of features are read. Training changes and weights files keep them in `f32`; halves are a copy
    /// of them.
    pub tables: Tables,
}

impl Precision {
    /// Whether all is `f32`.
    pub fn is_single(&self) -> bool {
        self.tables == Tables::F32
    }
}

/// How parameters are read of which a row touches few.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Tables {
    /// As they are.
    #[default]
    F32,
    /// Rounded to 11 bits, magnitudes from 6e-8 to 65504, which stands for all that is larger.
    F16,
    /// Rounded to 8 bits, magnitudes as of `f32`.
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
