//! Settings of stages in a spec. They are checked when they build their stage. A stage does not know its path in a
//! spec: its errors name its own keys, and its owner prepends the path ([`Error::within`](crate::Error::within)).

use crate::arena::{Arena, InitReport, Layout, Weights};
use crate::error::Result;
use crate::loss::Loss;
use crate::prior::Prior;
use crate::registry::Registered;
use crate::stage::{Encoder, Field, Normalizer, Projector};

/// Settings of an encoder.
pub trait EncoderSpec: Registered + Send + Sync {
    /// Builds the stage; fails on invalid settings.
    fn build(&self) -> Result<Box<dyn Encoder>>;
}

crate::settings_of!(Encoder, EncoderSpec);

/// Settings of a normalizer.
pub trait NormalizerSpec: Registered + Send + Sync {
    /// The stage for features of `width` channels.
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>>;
}

crate::settings_of!(Normalizer, NormalizerSpec);

/// Settings of a field.
pub trait FieldSpec: Registered + Send + Sync {
    /// The stage for features of `width` channels.
    fn build(&self, width: usize) -> Result<Box<dyn Field>>;
}

crate::settings_of!(Field, FieldSpec);

/// Settings of a projector that samples rays for a field.
pub trait ProjectorSpec: Registered + Send + Sync {
    /// The stage.
    fn build(&self) -> Result<Box<dyn Projector>>;
}

crate::settings_of!(Projector, ProjectorSpec);

/// Settings of an initializer.
pub trait InitializerSpec: Registered + Send + Sync {
    /// Builds the initializer. `weights` reads a weights file named in the settings.
    fn build(&self, weights: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>>;
}

crate::settings_of!(Initializer, InitializerSpec);

/// Settings of a loss.
pub trait LossSpec: Registered + Send + Sync {
    /// Builds the loss; fails on invalid settings.
    fn build(&self) -> Result<Box<dyn Loss>>;
}

crate::settings_of!(Loss, LossSpec);

/// Settings of a prior.
pub trait PriorSpec: Registered + Send + Sync {
    /// Builds the prior; fails on invalid settings.
    fn build(&self) -> Result<Box<dyn Prior>>;
}

crate::settings_of!(Prior, PriorSpec);

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
