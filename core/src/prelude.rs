//! What the author of a stage needs: `use conefield_core::prelude::*;`.

pub use crate::by_row::{ByRow, RowMap, Sums};
pub use crate::error::{Error, Result, ensure};
pub use crate::half::Stored;
pub use crate::random::{mix, unit};
pub use crate::simd::Real;
pub use crate::spec::{EncoderSpec, FieldSpec, InitializerSpec, NormalizerSpec, ProjectorSpec};
pub use crate::stage::{Encoder, Field, Normalizer, Projector, Samples, Stage, UnitRay};
pub use crate::stage_type;
pub use schemars::JsonSchema;
pub use serde::{Deserialize, Serialize};
