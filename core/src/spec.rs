//! What a user writes: a pipeline spec. TOML or JSON, the same types.
//!
//! Every stage is a table with a `type`; its other keys are that type's settings. [`crate::registry`] lists the
//! types; [`load`] reads files and says where a mistake stands.

mod check;
pub mod load;
mod one_of;
pub mod schema;
pub mod stage;
mod tree;

use crate::arena::{Arena, InitReport, Layout, Weights};
use crate::error::{Error, Result, ensure};
use crate::solver::Solver;
use crate::stage::{Encoder, Field, Normalizer, Projector};
use crate::voxel::VoxelProjector;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A whole pipeline.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spec {
    /// Short name, shown in tables.
    #[serde(default)]
    pub name: String,
    /// What it is for, in a sentence.
    #[serde(default)]
    pub description: String,
    /// How the scan is mapped to what stages see.
    #[serde(default)]
    pub scene: SceneSettings,
    /// Libraries with stages that the spec names.
    #[serde(default, skip_serializing_if = "PluginPaths::is_empty")]
    pub plugins: PluginPaths,
    /// In which precision a field computes.
    #[serde(default, skip_serializing_if = "Precision::is_single")]
    pub precision: Precision,
    /// Points to features.
    #[serde(default, deserialize_with = "stage::one")]
    pub encoder: Option<Box<dyn EncoderSpec>>,
    /// Features to features, in order.
    #[serde(default, deserialize_with = "stage::list")]
    pub normalizers: Vec<Box<dyn NormalizerSpec>>,
    /// Features to attenuation.
    #[serde(default, deserialize_with = "stage::one")]
    pub field: Option<Box<dyn FieldSpec>>,
    /// Rays to samples.
    #[serde(default, deserialize_with = "stage::one")]
    pub projector: Option<Box<dyn ProjectorSpec>>,
    /// Where weights come from.
    #[serde(default, deserialize_with = "stage::one")]
    pub initializer: Option<Box<dyn InitializerSpec>>,
    /// Scan to volume.
    #[serde(deserialize_with = "stage::needed")]
    pub solver: Box<dyn SolverSpec>,
}

impl Spec {
    /// A spec of nothing but a solver on voxels.
    pub fn voxels(solver: Box<dyn SolverSpec>, scene: SceneSettings) -> Self {
        Self {
            name: String::new(),
            description: String::new(),
            scene,
            plugins: PluginPaths::default(),
            precision: Precision::default(),
            encoder: None,
            normalizers: vec![],
            field: None,
            projector: None,
            initializer: None,
            solver,
        }
    }
}

/// Libraries with stages that a spec names. A spec alone never makes the program load one: its user allows it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PluginPaths {
    /// The files of the libraries, relative to the spec's own. Loaded only where the user says so, with
    /// `--allow-plugins-from-spec`, or names the same file with `--plugin`.
    pub paths: Vec<String>,
}

impl PluginPaths {
    /// Whether none is named.
    pub fn is_empty(&self) -> bool {
        self.paths.is_empty()
    }
}

/// In which precision a field computes. Sums, gradients, moments and the parameters that training changes are `f32`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Precision {
    /// In which tables of features are read. Training changes and weights files keep them in `f32`; halves are a copy
    /// of them.
    pub tables: Tables,
}

impl Precision {
    /// Whether all is `f32`.
    pub fn is_single(&self) -> bool {
        self.tables == Tables::F32
    }
}

/// How parameters are read of which a row touches few.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Tables {
    /// As they are.
    #[default]
    F32,
    /// Rounded to 11 bits, magnitudes from 6e-8 to 65504, which stands for all that is larger.
    F16,
    /// Rounded to 8 bits, magnitudes as of `f32`.
    Bf16,
}

impl std::fmt::Display for Tables {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Bf16 => "bf16",
        })
    }
}

/// How the scan is mapped to the unit cube and to attenuations of order one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SceneSettings {
    /// Share of the unit cube's side that the longest side of the volume fills, in (0, 1]. Published codes leave
    /// most of the cube empty; 1 spends every cell on the volume.
    pub fill: f64,
    /// The attenuation that stages see as 1.
    pub attenuation: AttenuationScale,
    /// Where in the volume the object can be.
    pub support: SupportRule,
    /// Whether training takes samples in all of the support.
    pub occupancy: OccupancyRule,
    /// Which of the encoder's channels are computed.
    pub levels: LevelRule,
    /// What lies beyond the volume. Of all solvers.
    #[serde(skip_serializing_if = "SurroundRule::is_none")]
    pub surround: SurroundRule,
}

impl Default for SceneSettings {
    fn default() -> Self {
        let (support, occupancy, levels) = (SupportRule::Box, OccupancyRule::Fixed, LevelRule::All);
        let surround = SurroundRule::None;
        Self { fill: 1.0, attenuation: AttenuationScale::Scan, support, occupancy, levels, surround }
    }
}

/// What lies beyond the volume.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum SurroundRule {
    /// Nothing.
    #[default]
    None,
    /// What coarse cells show, where the object reaches the sides of views: total variation makes them of the whole
    /// field of view first, and their line integrals are taken off the measured ones.
    Coarse(Surround),
}

/// How far and how finely the space beyond the volume is looked at.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Surround {
    /// How far cells go beyond the volume on every side, as a share of its longest side; less where a source stands closer.
    pub margin: f64,
    /// Cells along the volume's longest side.
    pub cells: usize,
    /// Passes over the views.
    pub passes: u64,
}

impl Default for Surround {
    fn default() -> Self {
        Self { margin: 0.75, cells: 64, passes: 16 }
    }
}

impl SurroundRule {
    /// Whether there is none.
    pub fn is_none(&self) -> bool {
        *self == Self::None
    }

    /// Refuses settings that mean nothing.
    pub fn validate(&self) -> Result<()> {
        let Self::Coarse(Surround { margin, cells, passes }) = *self else { return Ok(()) };
        let key = |name: &str| format!("scene.surround.coarse.{name}");
        ensure(margin > 0.0 && margin <= 4.0, "spec", &key("margin"), margin, "a number above 0 and at most 4")?;
        ensure((4..=256).contains(&cells), "spec", &key("cells"), cells, "4 to 256")?;
        ensure((1..=1000).contains(&passes), "spec", &key("passes"), passes, "1 to 1000")
    }
}

/// Whether training takes samples in all of the support.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum OccupancyRule {
    /// In all of it.
    Fixed,
    /// In cells where the field has been empty for a while only now and then: it counts as 0 there.
    Refined(Refined),
}

/// When a cell counts as empty. The volume is cut into 64 cells along its longest side.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Refined {
    /// Steps before the first cell may be empty, and after a run went back to an earlier state.
    pub after: u64,
    /// Steps from one look at the field to the next.
    pub every: u64,
    /// Share of the attenuation that stages see as 1 below which a cell and its neighbours must have been.
    pub below: f64,
    /// One ray in so many takes its samples in empty cells as well.
    pub probe: u32,
}

impl Default for Refined {
    fn default() -> Self {
        Self { after: 256, every: 16, below: 0.01, probe: 16 }
    }
}

impl OccupancyRule {
    /// Refuses settings that mean nothing.
    pub fn validate(&self) -> Result<()> {
        let Self::Refined(Refined { after, every, below, probe }) = *self else { return Ok(()) };
        let key = |name: &str| format!("scene.occupancy.refined.{name}");
        ensure(after > 0, "spec", &key("after"), after, "at least 1")?;
        ensure(every > 0, "spec", &key("every"), every, "at least 1")?;
        ensure(below > 0.0 && below < 1.0, "spec", &key("below"), below, "a number above 0 and below 1")?;
        ensure(probe > 0, "spec", &key("probe"), probe, "at least 1")
    }
}

/// Which of the encoder's channels are computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LevelRule {
    /// All.
    All,
    /// None that is finer than the data: than a voxel to export, or than what a pixel sees at the distance of the volume's
    /// centre. The coarsest that suffice stay.
    Needed,
}

/// Where in the volume the object can be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum SupportRule {
    /// Anywhere.
    Box,
    /// Where no view shows air: a cell that several views see nothing but air through is left out, the unit cube is
    /// fitted to the rest, and rays are sampled between the first and the last cell that is left; solvers that improve voxels
    /// keep the others at 0. Views whose sides the object reaches say nothing.
    Carve,
}

/// The attenuation that stages see as 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum AttenuationScale {
    /// Four times the mean attenuation of the most absorbing rays over the volume's longest side: from the scan
    /// alone, so that the result does not depend on units.
    Scan,
    /// A value in the scan's own unit (1/unit).
    Fixed(f64),
}

/// Settings of an encoder.
#[typetag::serde(tag = "type")]
pub trait EncoderSpec: Send + Sync {
    /// The stage, or why the settings make none.
    fn build(&self) -> Result<Box<dyn Encoder>>;
}

/// Settings of a normalizer.
#[typetag::serde(tag = "type")]
pub trait NormalizerSpec: Send + Sync {
    /// The stage for features of `width` channels.
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>>;
}

/// Settings of a field.
#[typetag::serde(tag = "type")]
pub trait FieldSpec: Send + Sync {
    /// The stage for features of `width` channels.
    fn build(&self, width: usize) -> Result<Box<dyn Field>>;
}

/// Settings of a projector: of one that samples rays for a field, of one that projects voxels, or of both.
#[typetag::serde(tag = "type")]
pub trait ProjectorSpec: Send + Sync {
    /// The stage that samples rays.
    fn build(&self) -> Result<Box<dyn Projector>> {
        let found = format!("{:?}, which projects voxels", self.typetag_name());
        Err(Error::invalid("spec", "projector.type", found, "one that samples rays"))
    }

    /// The stage that projects voxels.
    fn build_voxel(&self) -> Result<Box<dyn VoxelProjector>> {
        let found = format!("{:?}, which samples rays", self.typetag_name());
        Err(Error::invalid("spec", "projector.type", found, "one that projects voxels"))
    }
}

/// Settings of an initializer.
#[typetag::serde(tag = "type")]
pub trait InitializerSpec: Send + Sync {
    /// The stage that fills weights. `weights` reads a weights file that the settings name.
    fn build(&self, weights: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>> {
        let _ = weights;
        Err(Error::unsupported(format!("initializer {:?}", self.typetag_name()), "it brings a volume, not weights"))
    }

    /// The volume that it brings instead of weights.
    fn volume(&self) -> Result<Option<VolumeStart>> {
        Ok(None)
    }
}

/// A known volume to start from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VolumeStart {
    /// Its file.
    pub path: String,
    /// Steps in which a field learns it; solvers on voxels take it as it is.
    pub steps: u64,
}

/// Settings of a solver.
#[typetag::serde(tag = "type")]
pub trait SolverSpec: Send + Sync {
    /// The solver.
    fn build(&self) -> Result<Box<dyn Solver>>;
}

/// Brings named weights into the arena.
pub trait Initializer: Send + Sync {
    /// Fills what it fills (the stages' own random scheme has run before) and reports it.
    fn apply(&self, layout: &Layout, arena: &mut Arena) -> Result<InitReport>;
    /// A line for `explain`.
    fn describe(&self) -> String;
}
