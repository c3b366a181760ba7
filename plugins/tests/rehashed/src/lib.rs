//! The built-in hash grid and FFT mask once more, as a plugin: what the way through the contract costs, and that masks
//! go the same way.

use conefield_encoders::hash_grid::HashGrid;
use conefield_normalizers::fft_mask::FftMask;
use conefield_plugin::error::Result;
use conefield_plugin::spec::{EncoderSpec, NormalizerSpec};
use conefield_plugin::stage::{Encoder, Normalizer};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

conefield_plugin::export!();
conefield_plugin::stage_type!(Encoder, "rehashed", Rehashed, "the built-in hash grid as a plugin");

#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
struct Rehashed(HashGrid);

#[typetag::serde(name = "rehashed")]
impl EncoderSpec for Rehashed {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        self.0.build()
    }
}

conefield_plugin::stage_type!(Normalizer, "remask", Remask, "the built-in FFT mask as a plugin");

#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
struct Remask(FftMask);

#[typetag::serde(name = "remask")]
impl NormalizerSpec for Remask {
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>> {
        self.0.build(width)
    }
}
