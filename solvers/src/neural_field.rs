//! A neural attenuation field, trained to match the measured line integrals by the Beer-Lambert law.

use crate::field_plan::{Training, l1, random, rollback};
use crate::optimizer::Optimizer;
use crate::pretrain::Pretraining;
use crate::training::CallbackSpec;
use conefield_core::error::Result;
use conefield_core::method::Method;
use conefield_core::pipeline::Pipeline;
use conefield_core::scene::SceneSettings;
use conefield_core::settings::{
    EncoderSpec, FieldSpec, InitializerSpec, LossSpec, NormalizerSpec, PriorSpec, ProjectorSpec,
};
use conefield_core::spec::stage;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `neural-field`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NeuralField {
    /// How the scan is mapped to the unit cube of the stages.
    #[serde(default)]
    pub scene: SceneSettings,
    /// Encoder: points to features.
    #[schemars(schema_with = "stage::schema::<dyn EncoderSpec>")]
    pub encoder: Box<dyn EncoderSpec>,
    /// Normalizers: features to features, in order.
    #[serde(default, deserialize_with = "stage::list")]
    #[schemars(schema_with = "stage::schema_of_list::<dyn NormalizerSpec>")]
    pub normalizers: Vec<Box<dyn NormalizerSpec>>,
    /// Field: features to attenuation.
    #[schemars(schema_with = "stage::schema::<dyn FieldSpec>")]
    pub field: Box<dyn FieldSpec>,
    /// Projector: rays to samples.
    #[schemars(schema_with = "stage::schema::<dyn ProjectorSpec>")]
    pub projector: Box<dyn ProjectorSpec>,
    /// Source of the initial weights.
    #[serde(default = "random")]
    #[schemars(schema_with = "stage::schema::<dyn InitializerSpec>")]
    pub initializer: Box<dyn InitializerSpec>,
    /// Loss between predicted and measured line integrals.
    #[serde(default = "l1")]
    #[schemars(schema_with = "stage::schema::<dyn LossSpec>")]
    pub loss: Box<dyn LossSpec>,
    /// Priors on the field, independent of the measurements.
    #[serde(default, deserialize_with = "stage::list")]
    #[schemars(schema_with = "stage::schema_of_list::<dyn PriorSpec>")]
    pub priors: Vec<Box<dyn PriorSpec>>,
    /// Optimizer.
    #[serde(default)]
    pub optimizer: Optimizer,
    /// Batch of a step, and the end of training.
    #[serde(default)]
    pub training: Training,
    /// How the field learns known volumes, in `conefield pretrain` and for a warm start.
    #[serde(default)]
    pub pretraining: Pretraining,
    /// Callbacks during training.
    #[serde(default = "rollback", deserialize_with = "stage::list")]
    #[schemars(schema_with = "stage::schema_of_list::<dyn CallbackSpec>")]
    pub callbacks: Vec<Box<dyn CallbackSpec>>,
}

conefield_core::stage_type!(Method, "neural-field", NeuralField, "a neural attenuation field, trained on rays");

impl NeuralField {
    /// Builds the stages and connects them.
    pub(crate) fn pipeline(&self) -> Result<Pipeline> {
        let encoder = self.encoder.build().map_err(|e| e.within("encoder"))?;
        let mut width = encoder.info().output;
        let mut normalizers = vec![];
        for (i, n) in self.normalizers.iter().enumerate() {
            let n = n.build(width).map_err(|e| e.within(&format!("normalizers.{i}")))?;
            width = n.info().output;
            normalizers.push(n);
        }
        let field = self.field.build(width).map_err(|e| e.within("field"))?;
        let projector = self.projector.build().map_err(|e| e.within("projector"))?;
        Pipeline::new(encoder, normalizers, field, projector)
    }
}
