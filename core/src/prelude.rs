//! What the author of a stage needs: `use conefield_core::prelude::*;`.

pub use crate::by_row::{ByRow, RowMap, Sums};
pub use crate::error::{Error, Result, ensure};
pub use crate::half::Stored;
pub use crate::loss::{Loss, NoiseModel};
pub use crate::prior::{Blocks, Prior};
pub use crate::random::{mix, unit};
pub use crate::settings::{
    EncoderSpec, FieldSpec, InitializerSpec, LossSpec, NormalizerSpec, PriorSpec, ProjectorSpec,
};
pub use crate::simd::Real;
pub use crate::stage::{Encoder, Field, Normalizer, Projector, Samples, Stage, UnitRay};
pub use crate::stage_type;
pub use crate::wgsl::Fragment;
pub use schemars::JsonSchema;
pub use serde::{Deserialize, Serialize};
