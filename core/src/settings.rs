//! Settings of stages in a spec. They are checked when they build their stage. A stage does not know its path in a
//! spec: its errors name its own keys, and its owner prepends the path ([`Error::within`](crate::Error::within)).

use crate::arena::{Arena, InitReport, Layout, Weights};
use crate::error::Result;
use crate::loss::Loss;
use crate::prior::Prior;
use crate::stage::{Encoder, Field, Normalizer, Projector};

/// Settings of an encoder.
#[typetag::serde(tag = "type")]
pub trait EncoderSpec: Send + Sync {
    /// Builds the stage; fails on invalid settings.
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

/// Settings of a projector that samples rays for a field.
#[typetag::serde(tag = "type")]
pub trait ProjectorSpec: Send + Sync {
    /// The stage.
    fn build(&self) -> Result<Box<dyn Projector>>;
}

/// Settings of an initializer.
#[typetag::serde(tag = "type")]
pub trait InitializerSpec: Send + Sync {
    /// Builds the initializer. `weights` reads a weights file named in the settings.
    fn build(&self, weights: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>>;
}

/// Settings of a loss.
#[typetag::serde(tag = "type")]
pub trait LossSpec: Send + Sync {
    /// Builds the loss; fails on invalid settings.
    fn build(&self) -> Result<Box<dyn Loss>>;
}

/// Settings of a prior.
#[typetag::serde(tag = "type")]
pub trait PriorSpec: Send + Sync {
    /// Builds the prior; fails on invalid settings.
    fn build(&self) -> Result<Box<dyn Prior>>;
}

/// Initializes parameters in the arena.
pub trait Initializer: Send + Sync {
    /// Refuses weights that do not fit the layout.
    fn check(&self, layout: &Layout) -> Result<()> {
        let _ = layout;
        Ok(())
    }

    /// Fills its parameters, after the stages' own random initialization, and reports which.
    fn apply(&self, layout: &Layout, arena: &mut Arena) -> Result<InitReport>;

    /// A known volume that the field learns voxel by voxel after the weights are filled.
    fn volume(&self) -> Option<KnownVolume> {
        None
    }

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// A known volume as initial state of a field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KnownVolume {
    /// Its file.
    pub path: String,
    /// Training steps on it.
    pub steps: u64,
}

impl KnownVolume {
    /// Default number of steps.
    pub const STEPS: u64 = 500;
}
