//! A neural attenuation field, trained to match the measured line integrals by the Beer-Lambert law.

use crate::field_plan::{Training, l1, random, rollback};
use crate::optimizer::Optimizer;
use crate::pretrain::Pretraining;
use crate::training::CallbackSpec;
use conefield_core::error::Result;
use conefield_core::method::StartFile;
use conefield_core::method::{Context, Line, Method, Plan, StageLine};
use conefield_core::pipeline::Pipeline;
use conefield_core::scene::SceneSettings;
use conefield_core::settings::{
    EncoderSpec, FieldSpec, InitializerSpec, LossSpec, NormalizerSpec, PriorSpec, ProjectorSpec,
};
use conefield_core::spec::stage;
use conefield_fields::initializers::mci::Mci;
use conefield_fields::initializers::volume::FromVolume;
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

impl Method for NeuralField {
    fn plan(&self, context: &Context<'_>) -> Result<Box<dyn Plan>> {
        let pipeline = self.pipeline()?;
        let mut stages = vec![StageLine::new("encoder", self.encoder.type_name(), pipeline.encoder.as_ref())];
        for (i, (n, spec)) in pipeline.normalizers.iter().zip(&self.normalizers).enumerate() {
            stages.push(StageLine::new(&format!("normalizers.{i}"), spec.type_name(), n.as_ref()));
        }
        stages.push(StageLine::new("field", self.field.type_name(), pipeline.field.as_ref()));
        let projector = Line::new("projector", self.projector.type_name(), &pipeline.projector.describe());
        self.train(pipeline, stages, vec![projector], context)
    }

    fn start_setting(&self, file: &StartFile) -> Option<(String, serde_json::Value)> {
        let initializer: Box<dyn InitializerSpec> = match file {
            StartFile::Weights(file) => Box::new(Mci { weights: file.clone() }),
            StartFile::Volume(file) => Box::new(FromVolume::new(file.clone())),
        };
        Some(("initializer".into(), serde_json::to_value(initializer).ok()?))
    }
}

impl NeuralField {
    /// Builds the stages and connects them.
    fn pipeline(&self) -> Result<Pipeline> {
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
