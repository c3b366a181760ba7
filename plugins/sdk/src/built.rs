//! The stage behind the pointer that the host holds.

use conefield_core::prelude::*;
use conefield_core::registry::read;
use conefield_core::registry::{Kind, StageType};
use conefield_core::settings::KnownVolume;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::cell::RefCell;
use std::ops::Range;

/// A stage held by the host.
pub struct Built {
    pub stage: AnyStage,
    /// For an encoder, a normalizer or a field.
    map: Option<MapInfo>,
    /// The known volume of an initializer.
    pub volume: Option<KnownVolume>,
    /// What a reduced stage kept of the original.
    pub kept: (Vec<ConefieldRange>, Vec<usize>),
    /// The grid shape of a penalty or an expansion.
    pub shape: [usize; 3],
}

/// Defines the kinds of stages with their settings, which may need the number of input channels, and the parts that
/// stages make for a grid or a scan, each with its description.
macro_rules! any_stage {
    (
        stages { $($kind:ident $($name:ident)?: $stage:ident from $spec:ident($($width:ident)?),)* }
        parts { $($part:ident $part_name:ident: $described:pat => $description:expr,)* }
    ) => {
        /// A stage of any kind, or a part.
        pub enum AnyStage {
            $($kind(Box<dyn $stage>),)*
            $($part(Box<dyn $part>),)*
            /// An initializer whose weights are not read yet.
            Waiting(Waiting),
        }

        $(impl From<Box<dyn $stage>> for AnyStage {
            fn from(stage: Box<dyn $stage>) -> Self {
                Self::$kind(stage)
            }
        })*

        $(impl From<Box<dyn $part>> for AnyStage {
            fn from(stage: Box<dyn $part>) -> Self {
                Self::$part(stage)
            }
        })*

        impl AnyStage {
            /// The stage of type `t` with `settings`, which include the type.
            fn new(t: &StageType, settings: Value, width: usize) -> Result<Self> {
                let refused = |e: String| Error::invalid("spec", "", e, "settings of this type");
                Ok(match t.kind {
                    $(Kind::$kind => {
                        $(let $width = width;)?
                        Self::from(read::<dyn $spec>(settings).map_err(refused)?.build($($width)?)?)
                    })*
                    Kind::Initializer => Waiting::build(read::<dyn InitializerSpec>(settings).map_err(refused)?)?,
                    other => return Err(Error::unsupported(t.name, format!("a {other} cannot come from a plugin"))),
                })
            }

            pub fn describe(&self) -> String {
                match self {
                    $(Self::$kind(stage) => stage.describe(),)*
                    $(Self::$part($described) => $description,)*
                    Self::Waiting(w) => format!("waits for {}", w.path),
                }
            }
        }

        impl Built {
            $($(pub fn $name(&self) -> Result<&dyn $stage> {
                match &self.stage {
                    AnyStage::$kind(stage) => Ok(stage.as_ref()),
                    other => Err(other.is_no(stringify!($name))),
                }
            })?)*

            $(pub fn $part_name(&self) -> Result<&dyn $part> {
                match &self.stage {
                    AnyStage::$part(stage) => Ok(stage.as_ref()),
                    other => Err(other.is_no(stringify!($part_name))),
                }
            })*
        }
    };
}

any_stage! {
    stages {
        Encoder encoder: Encoder from EncoderSpec(),
        Normalizer: Normalizer from NormalizerSpec(width),
        Field: Field from FieldSpec(width),
        Projector projector: Projector from ProjectorSpec(),
        Loss loss: Loss from LossSpec(),
        Prior prior: Prior from PriorSpec(),
        Regularizer regularizer: Regularizer from RegularizerSpec(),
        DataTerm data_term: DataTerm from DataTermSpec(),
        Basis basis: Basis from BasisSpec(),
    }
    parts {
        Initializer initializer: stage => stage.describe(),
        Penalty penalty: _ => String::new(),
        Misfit misfit: stage => stage.describe(),
        Expansion expansion: _ => String::new(),
    }
}

/// Settings of an initializer that names a weights file.
pub struct Waiting {
    spec: Box<dyn InitializerSpec>,
    pub path: String,
}

impl Waiting {
    /// Builds the initializer, or returns the settings if it needs a weights file.
    fn build(spec: Box<dyn InitializerSpec>) -> Result<AnyStage> {
        let asked = RefCell::new(None);
        let built = spec.build(&|path| {
            asked.replace(Some(path.to_owned()));
            Err(Error::unsupported(path, "it is not read yet"))
        });
        match asked.into_inner() {
            Some(path) => Ok(AnyStage::Waiting(Self { spec, path })),
            None => built.map(AnyStage::Initializer),
        }
    }

    /// The initializer with these weights.
    pub fn with(&self, weights: &Weights) -> Result<AnyStage> {
        let only = |path: &str| {
            let why = || Error::unsupported(path, "an initializer from a plugin has one weights file");
            (path == self.path).then(|| weights.clone()).ok_or_else(why)
        };
        self.spec.build(&only).map(AnyStage::Initializer)
    }
}

/// Properties of a map that the host queries repeatedly.
pub struct MapInfo {
    pub info: ConefieldInfo,
    pub blocks: Vec<Parameter>,
    pub partition: Vec<Range<usize>>,
}

impl Built {
    /// The stage of type `t` with `settings`, which have no type key.
    pub fn new(t: &StageType, mut settings: Value, width: usize) -> Result<Self> {
        let Some(keys) = settings.as_object_mut() else {
            return Err(Error::invalid("spec", "", &settings, "a table of settings"));
        };
        keys.insert("type".into(), t.name.into());
        Ok(Self::of(AnyStage::new(t, settings, width)?))
    }

    /// The host's object for `stage`.
    pub fn of(stage: impl Into<AnyStage>) -> Self {
        let stage = stage.into();
        let map = stage.map().map(|s| {
            let i = s.info();
            let partition = if i.grads == GradKind::Scatter { s.partition() } else { vec![] };
            let blocks = s.parameters();
            let mut info = info(&i, blocks.len(), partition.len());
            info.coarse_to_fine = matches!(&stage, AnyStage::Encoder(e) if e.coarse_to_fine()).into();
            info.double_precision = s.reference().is_some().into();
            MapInfo { info, blocks, partition }
        });
        let volume = if let AnyStage::Initializer(i) = &stage { i.volume() } else { None };
        Self { stage, map, volume, kept: (vec![], vec![]), shape: [0; 3] }
    }

    /// Returns the stage, whatever its kind.
    pub fn any(&self) -> Result<&Self> {
        Ok(self)
    }

    /// As [`Self::any`], mutable.
    pub fn any_mut(&mut self) -> Result<&mut Self> {
        Ok(self)
    }

    /// As a map of rows, with its properties.
    pub fn map(&self) -> Result<(&dyn Stage, &MapInfo)> {
        self.stage.map().zip(self.map.as_ref()).ok_or_else(|| self.stage.is_no("encoder, normalizer or field"))
    }

    /// As a mutable penalty.
    pub fn penalty_mut(&mut self) -> Result<&mut dyn Penalty> {
        match &mut self.stage {
            AnyStage::Penalty(penalty) => Ok(penalty.as_mut()),
            other => Err(other.is_no("penalty")),
        }
    }

    /// The stage without some of its channels.
    pub fn reduced(&self, side: u32, keep: &[usize]) -> Result<Self> {
        fn of<S: ?Sized>(reduced: Reduced<S>) -> Built
        where
            AnyStage: From<Box<S>>,
        {
            let Reduced { stage, params, channels } = reduced;
            let params = params.iter().map(|r| ConefieldRange { start: r.start, end: r.end }).collect();
            Built { kept: (params, channels), ..Built::of(stage) }
        }
        Ok(match (&self.stage, side) {
            (AnyStage::Encoder(e), CONEFIELD_OUTPUTS) => of(e.keep_outputs(keep)?),
            (AnyStage::Normalizer(n), CONEFIELD_INPUTS) => of(n.keep_inputs(keep)?),
            (AnyStage::Field(f), CONEFIELD_INPUTS) => of(f.keep_inputs(keep)?),
            _ => return Err(Error::unsupported("this stage", "channels cannot be left out on that side")),
        })
    }
}

impl AnyStage {
    /// As an encoder, normalizer or field.
    fn map(&self) -> Option<&dyn Stage> {
        match self {
            Self::Encoder(s) => Some(s.as_ref()),
            Self::Normalizer(s) => Some(s.as_ref()),
            Self::Field(s) => Some(s.as_ref()),
            _ => None,
        }
    }

    /// The error for a stage of a different kind than requested.
    fn is_no(&self, kind: &str) -> Error {
        match self {
            Self::Waiting(w) => Error::unsupported(&w.path, "the weights were not handed over"),
            _ => Error::unsupported("this stage", format!("it is no {kind}")),
        }
    }
}

fn info(i: &Info, blocks: usize, partitions: usize) -> ConefieldInfo {
    ConefieldInfo {
        input: i.input,
        output: i.output,
        params: i.params,
        blocks,
        partitions,
        tape: i.tape,
        macs: i.macs,
        scope: match i.scope {
            Scope::Row => CONEFIELD_SCOPE_ROW,
            Scope::Ray => CONEFIELD_SCOPE_RAY,
        },
        grads: match i.grads {
            GradKind::None => CONEFIELD_GRADS_NONE,
            GradKind::Dense => CONEFIELD_GRADS_DENSE,
            GradKind::Scatter => CONEFIELD_GRADS_SCATTER,
        },
        identity: i.identity.into(),
        coarse_to_fine: 0,
        double_precision: 0,
    }
}
