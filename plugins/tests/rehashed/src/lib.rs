//! The built-in hash grid as a plugin, to measure the cost of the ABI and to test masks through it; and two
//! initializers, to test the ABI's functions for them.

mod started;

use conefield_encoders::hash_grid::HashGrid;
use conefield_plugin::error::Result;
use conefield_plugin::settings::EncoderSpec;
use conefield_plugin::stage::Encoder;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

conefield_plugin::export!();
conefield_plugin::stage_type!(EncoderSpec, "rehashed", Rehashed, "the built-in hash grid as a plugin");

#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
struct Rehashed(HashGrid);

impl EncoderSpec for Rehashed {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        self.0.build()
    }
}
