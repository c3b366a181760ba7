//! A known volume as the start: another method's result, or an earlier scan of the same object. The field is trained on
//! it voxel by voxel for some steps before it sees the scan.

use conefield_core::input_file::InputFile;
use conefield_core::prelude::*;
use conefield_core::settings::KnownVolume;
use conefield_core::words::counted;

/// Settings of `volume`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FromVolume {
    /// The volume file, in 1/unit of the scan and with as many voxels.
    pub path: InputFile,
    /// Number of training steps on the volume.
    #[serde(default = "steps")]
    pub steps: u64,
}

impl FromVolume {
    /// The volume `path`, learned in the default number of steps.
    pub fn new(path: InputFile) -> Self {
        Self { path, steps: steps() }
    }
}

fn steps() -> u64 {
    KnownVolume::STEPS
}

conefield_core::stage_type!(
    InitializerSpec,
    "volume",
    FromVolume,
    "a known volume that the field learns first",
    example = r#"{"path": "volume.nii.gz"}"#
);

impl InitializerSpec for FromVolume {
    fn build(&self, _: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>> {
        ensure(!self.path.is_empty(), "spec", "path", "no name", "a volume file")?;
        Ok(Box::new(self.clone()))
    }
}

impl Initializer for FromVolume {
    fn apply(&self, layout: &Layout, _: &mut Arena) -> Result<InitReport> {
        let fresh = layout.blocks.iter().map(|b| (b.name.clone(), "random, then learned".into())).collect();
        Ok(InitReport { fresh, ..InitReport::default() })
    }

    fn volume(&self) -> Option<KnownVolume> {
        Some(KnownVolume { path: self.path.to_string(), steps: self.steps })
    }

    fn describe(&self) -> String {
        format!("volume: {} learned in {}", self.path, counted(self.steps, "step"))
    }
}
