//! The built-in hash grid as a plugin, to measure the cost of the ABI and to test masks through it; two initializers, to
//! test the ABI's functions for them; and an encoder that panics.

mod panics;
mod started;

use conefield_encoders::hash_grid::HashGrid;
use conefield_plugin::prelude::*;

conefield_plugin::export!();
stage_type!(EncoderSpec, "rehashed", Rehashed, "the built-in hash grid as a plugin");

#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
struct Rehashed(HashGrid);

impl EncoderSpec for Rehashed {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        self.0.build()
    }
}
