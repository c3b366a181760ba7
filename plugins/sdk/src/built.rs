//! A stage behind the pointer that the host holds.

use conefield_core::arena::Weights;
use conefield_core::error::{Error, Result};
use conefield_core::loss::Loss;
use conefield_core::prior::Prior;
use conefield_core::registry::{Kind, StageType};
use conefield_core::settings::{
    EncoderSpec, FieldSpec, Initializer, InitializerSpec, KnownVolume, LossSpec, NormalizerSpec, PriorSpec,
    ProjectorSpec,
};
use conefield_core::spec::stage::read;
use conefield_core::stage::{Encoder, Field, GradKind, Info, Normalizer, Parameter, Projector, Reduced, Scope, Stage};
use conefield_plugin_abi::*;
use serde_json::Value;
use std::cell::RefCell;
use std::ops::Range;

/// What the host holds.
pub struct Built {
    pub stage: AnyStage,
    /// Of an encoder, a normalizer or a field.
    pub map: Option<MapInfo>,
    /// The known volume of an initializer.
    pub volume: Option<KnownVolume>,
    /// What a smaller stage kept of the one that it was made from.
    pub kept: (Vec<ConefieldRange>, Vec<usize>),
}

/// A stage of any kind.
pub enum AnyStage {
    Encoder(Box<dyn Encoder>),
    Normalizer(Box<dyn Normalizer>),
    Field(Box<dyn Field>),
    Projector(Box<dyn Projector>),
    Initializer(Box<dyn Initializer>),
    /// An initializer before its weights were read.
    Waiting(Waiting),
    Loss(Box<dyn Loss>),
    Prior(Box<dyn Prior>),
}

/// Settings of an initializer that name a weights file.
pub struct Waiting {
    spec: Box<dyn InitializerSpec>,
    pub path: String,
}

impl Waiting {
    /// The initializer, or what waits for the file that it asks for.
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

    /// The initializer with what stands in the file.
    pub fn with(&self, weights: &Weights) -> Result<AnyStage> {
        let only = |path: &str| {
            let why = || Error::unsupported(path, "an initializer from a plugin has one weights file");
            (path == self.path).then(|| weights.clone()).ok_or_else(why)
        };
        self.spec.build(&only).map(AnyStage::Initializer)
    }
}

/// What the host asks of a map again and again.
pub struct MapInfo {
    pub info: ConefieldInfo,
    pub blocks: Vec<Parameter>,
    pub partition: Vec<Range<usize>>,
}

impl Built {
    /// The stage that `settings`, without their type, make of `t`.
    pub fn new(t: &StageType, mut settings: Value, width: usize) -> Result<Self> {
        let Some(keys) = settings.as_object_mut() else {
            return Err(Error::invalid("spec", "", &settings, "a table of settings"));
        };
        keys.insert("type".into(), t.name.into());
        let refused = |e: String| Error::invalid("spec", "", e, "settings of this type");
        let stage = match t.kind {
            Kind::Encoder => AnyStage::Encoder(read::<dyn EncoderSpec>(settings).map_err(refused)?.build()?),
            Kind::Normalizer => {
                AnyStage::Normalizer(read::<dyn NormalizerSpec>(settings).map_err(refused)?.build(width)?)
            }
            Kind::Field => AnyStage::Field(read::<dyn FieldSpec>(settings).map_err(refused)?.build(width)?),
            Kind::Projector => AnyStage::Projector(read::<dyn ProjectorSpec>(settings).map_err(refused)?.build()?),
            Kind::Initializer => Waiting::build(read::<dyn InitializerSpec>(settings).map_err(refused)?)?,
            Kind::Loss => AnyStage::Loss(read::<dyn LossSpec>(settings).map_err(refused)?.build()?),
            Kind::Prior => AnyStage::Prior(read::<dyn PriorSpec>(settings).map_err(refused)?.build()?),
            other => return Err(Error::unsupported(t.name, format!("a {other} cannot come from a plugin"))),
        };
        Ok(Self::of(stage))
    }

    /// What the host holds of `stage`.
    pub fn of(stage: AnyStage) -> Self {
        let map = stage.map().map(|s| {
            let i = s.info();
            let partition = if i.grads == GradKind::Scatter { s.partition() } else { vec![] };
            let coarse_to_fine = matches!(&stage, AnyStage::Encoder(e) if e.coarse_to_fine());
            let blocks = s.parameters();
            let mut info = info(&i, blocks.len(), partition.len());
            info.coarse_to_fine = coarse_to_fine.into();
            info.double_precision = s.reference().is_some().into();
            info.halves = s.halves().is_some().into();
            MapInfo { info, blocks, partition }
        });
        let volume = if let AnyStage::Initializer(i) = &stage { i.volume() } else { None };
        Self { stage, map, volume, kept: (vec![], vec![]) }
    }

    /// The stage without some of its channels.
    pub fn reduced(&self, side: u32, keep: &[usize]) -> Result<Self> {
        let of = |params: Vec<Range<usize>>, channels, stage| Self {
            kept: (params.iter().map(|r| ConefieldRange { start: r.start, end: r.end }).collect(), channels),
            ..Self::of(stage)
        };
        Ok(match (&self.stage, side) {
            (AnyStage::Encoder(e), CONEFIELD_OUTPUTS) => {
                let Reduced { stage, params, channels } = e.keep_outputs(keep)?;
                of(params, channels, AnyStage::Encoder(stage))
            }
            (AnyStage::Normalizer(n), CONEFIELD_INPUTS) => {
                let Reduced { stage, params, channels } = n.keep_inputs(keep)?;
                of(params, channels, AnyStage::Normalizer(stage))
            }
            (AnyStage::Field(f), CONEFIELD_INPUTS) => {
                let Reduced { stage, params, channels } = f.keep_inputs(keep)?;
                of(params, channels, AnyStage::Field(stage))
            }
            _ => return Err(Error::unsupported("this stage", "channels cannot be left out on that side")),
        })
    }
}

impl AnyStage {
    /// As an encoder, a normalizer or a field.
    pub fn map(&self) -> Option<&dyn Stage> {
        match self {
            Self::Encoder(s) => Some(s.as_ref()),
            Self::Normalizer(s) => Some(s.as_ref()),
            Self::Field(s) => Some(s.as_ref()),
            Self::Projector(_) | Self::Initializer(_) | Self::Waiting(_) | Self::Loss(_) | Self::Prior(_) => None,
        }
    }

    pub fn describe(&self) -> String {
        match self {
            Self::Projector(p) => p.describe(),
            Self::Initializer(i) => i.describe(),
            Self::Waiting(w) => format!("waits for {}", w.path),
            Self::Loss(l) => l.describe(),
            Self::Prior(p) => p.describe(),
            Self::Encoder(s) => s.describe(),
            Self::Normalizer(s) => s.describe(),
            Self::Field(s) => s.describe(),
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
        halves: 0,
    }
}
