//! Settings of stages: what a spec says of each. They are checked when they build their stage. A stage does not know where
//! it stands in a spec: its errors name its own keys, and its owner puts the way to it before them
//! ([`Error::within`](crate::Error::within)).

use crate::arena::{Arena, InitReport, Layout, Weights};
use crate::error::Result;
use crate::loss::Loss;
use crate::prior::Prior;
use crate::stage::{Encoder, Field, Normalizer, Projector};

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

/// Settings of a field that brings line integrals of its own ([`Field::lines`]). It reads positions.
#[typetag::serde(tag = "type")]
pub trait LineFieldSpec: Send + Sync {
    /// The stage.
    fn build(&self) -> Result<Box<dyn Field>>;
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
    /// The stage that fills weights. `weights` reads a weights file that the settings name.
    fn build(&self, weights: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>>;
}

/// Settings of a loss.
#[typetag::serde(tag = "type")]
pub trait LossSpec: Send + Sync {
    /// The loss, or why the settings make none.
    fn build(&self) -> Result<Box<dyn Loss>>;
}

/// Settings of a prior.
#[typetag::serde(tag = "type")]
pub trait PriorSpec: Send + Sync {
    /// The prior, or why the settings make none.
    fn build(&self) -> Result<Box<dyn Prior>>;
}

/// Brings named weights into the arena.
pub trait Initializer: Send + Sync {
    /// Refuses weights that do not fit.
    fn check(&self, layout: &Layout) -> Result<()> {
        let _ = layout;
        Ok(())
    }

    /// Fills what it fills (the stages' own random scheme has run before) and reports it.
    fn apply(&self, layout: &Layout, arena: &mut Arena) -> Result<InitReport>;

    /// A known volume that the field learns voxel by voxel, once the weights are filled.
    fn volume(&self) -> Option<KnownVolume> {
        None
    }

    /// A line for `explain`.
    fn describe(&self) -> String;
}

/// A known volume for a field to begin with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KnownVolume {
    /// Its file.
    pub path: String,
    /// Steps in which the field learns it.
    pub steps: u64,
}

impl KnownVolume {
    /// Steps where settings say nothing.
    pub const STEPS: u64 = 500;
}
