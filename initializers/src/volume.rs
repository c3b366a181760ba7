//! A known volume to start from: another solver's result, an earlier scan of the same object.
//!
//! Solvers on voxels take it as their first iterate. A field is trained on it voxel by voxel for some steps before it
//! sees the scan.

use conefield_core::error::{Result, ensure};
use conefield_core::spec::{InitializerSpec, VolumeStart};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `volume`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FromVolume {
    /// The volume's file, in 1/unit of the scan and with as many voxels.
    pub path: String,
    /// Steps in which a field learns it.
    #[serde(default = "steps")]
    pub steps: u64,
}

fn steps() -> u64 {
    500
}

conefield_core::stage_type!(Initializer, "volume", FromVolume, "a known volume to start from");

#[typetag::serde(name = "volume")]
impl InitializerSpec for FromVolume {
    fn volume(&self) -> Result<Option<VolumeStart>> {
        ensure(!self.path.is_empty(), "spec", "initializer.path", "no name", "a volume file")?;
        Ok(Some(VolumeStart { path: self.path.clone(), steps: self.steps }))
    }
}
