//! Mapping-consistency initialization (Xu et al. 2025, NI-NeRF, section 2.4): the map from features to attenuation
//! comes from a model trained on a known volume; the features themselves start afresh.
//!
//! Loads the weights of the normalizers and the field, that is every block whose name does not start with `encoder.`.
//! Refuses a file that lacks a block or has it in another shape.

use super::checkpoint::FromWeights;
use conefield_core::input_file::InputFile;
use conefield_core::prelude::*;

/// Settings of `mci`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Mci {
    /// The weights file of the trained model.
    pub weights: InputFile,
}

conefield_core::stage_type!(
    InitializerSpec,
    "mci",
    Mci,
    "normalizers and field from a trained model, a fresh encoder",
    example = r#"{"weights": "weights.safetensors"}"#
);

impl InitializerSpec for Mci {
    fn build(&self, weights: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>> {
        FromWeights::read(&self.weights, weights, false)
    }
}
