//! A field with its own line integrals, trained to match the measured ones.

use crate::field_plan::{Trained, Training, l1, random, rollback};
use crate::optimizer::Optimizer;
use crate::pretrain::Pretraining;
use crate::training::CallbackSpec;
use conefield_core::error::Result;
use conefield_core::method::{Context, Method, Plan, StageLine};
use conefield_core::pipeline::Pipeline;
use conefield_core::scene::SceneSettings;
use conefield_core::settings::{InitializerSpec, LineFieldSpec, LossSpec, PriorSpec};
use conefield_core::spec::stage;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `line-field`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LineField {
    /// How the scan is mapped to the field's unit cube.
    #[serde(default)]
    pub scene: SceneSettings,
    /// The field: line integrals of rays and attenuation at points.
    #[serde(deserialize_with = "stage::needed")]
    #[schemars(schema_with = "stage::schema::<dyn LineFieldSpec>")]
    pub field: Box<dyn LineFieldSpec>,
    /// Source of the initial weights.
    #[serde(default = "random", deserialize_with = "stage::needed")]
    #[schemars(schema_with = "stage::schema::<dyn InitializerSpec>")]
    pub initializer: Box<dyn InitializerSpec>,
    /// Loss between predicted and measured line integrals.
    #[serde(default = "l1", deserialize_with = "stage::needed")]
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

conefield_core::stage_type!(Method, "line-field", LineField, "a field with line integrals of its own, trained on rays");

#[typetag::serde(name = "line-field")]
impl Method for LineField {
    fn plan(&self, context: &Context<'_>) -> Result<Box<dyn Plan>> {
        let field = self.field.build().map_err(|e| e.within("field"))?;
        let pipeline = Pipeline::alone(field)?;
        let stages = vec![StageLine::new("field", self.field.typetag_name(), pipeline.field.as_ref())];
        let trained = Trained {
            kind: self.typetag_name(),
            scene: &self.scene,
            initializer: self.initializer.as_ref(),
            loss: self.loss.as_ref(),
            priors: &self.priors,
            optimizer: &self.optimizer,
            training: &self.training,
            pretraining: &self.pretraining,
            callbacks: &self.callbacks,
        };
        trained.plan(pipeline, stages, vec![], context)
    }
}
