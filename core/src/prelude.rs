//! Imports for authors of stages: `use conefield_core::prelude::*;`.

pub use crate::arena::{Arena, InitReport, Layout, Weights};
pub use crate::basis::{Basis, BasisOperator, BasisSpec, Expansion};
pub use crate::by_row::{ByRow, Channels, ChannelsMut, Gradients, RowMap};
pub use crate::data_term::{DataTerm, DataTermSpec, Misfit};
pub use crate::error::{Error, Result, ensure};
pub use crate::geometry::VoxelGrid;
pub use crate::lanes::Lanes;
pub use crate::loss::{Loss, NoiseModel};
pub use crate::place::StatePart;
pub use crate::prior::{Blocks, Prior};
pub use crate::random::{mix, unit};
pub use crate::regularizer::{Penalty, Regularizer, RegularizerSpec};
pub use crate::settings::{
    EncoderSpec, FieldSpec, Initializer, InitializerSpec, LossSpec, NormalizerSpec, PriorSpec, ProjectorSpec,
};
pub use crate::simd::Real;
pub use crate::space::Space;
pub use crate::stage::{
    Backward, Encoder, Field, GradKind, Grads, Info, Kernel, Normalizer, Parameter, Projector, Reduced, Samples, Scope,
    Stage, Tile, TileMut, UnitRay,
};
pub use crate::stage_type;
pub use crate::wgsl::Fragment;
pub use ndarray::{ArrayView3, ArrayViewMut3};
pub use schemars::JsonSchema;
pub use serde::{Deserialize, Serialize};
