//! The stage behind the pointer that the host holds.

use conefield_core::prelude::*;
use conefield_core::registry::{Kind, Settings, StageType, read};
use conefield_core::settings::KnownVolume;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::any::{Any, type_name};
use std::cell::RefCell;
use std::ops::Range;

/// A stage held by the host.
pub struct Built {
    /// A box of what the functions of its table take, such as a `Box<dyn Loss>` or a `Box<Map>`.
    stage: Box<dyn Any>,
    pub describe: String,
}

/// The settings of a stage.
fn settings<T: Settings + ?Sized + 'static>(settings: Value) -> Result<Box<T>> {
    read(settings).map_err(|e| Error::invalid("spec", "", e, "settings of this type"))
}

impl Built {
    /// The stage of type `t` with `keys`, its settings without their type; some need the number of input channels.
    pub fn new(t: &StageType, mut keys: Value, width: usize) -> Result<Self> {
        let Some(table) = keys.as_object_mut() else {
            return Err(Error::invalid("spec", "", &keys, "a table of settings"));
        };
        table.insert("type".into(), t.name.into());
        macro_rules! built {
            ($spec:ident) => {{
                let stage = settings::<dyn $spec>(keys)?.build()?;
                let describe = stage.describe();
                Self::of(stage, describe)
            }};
        }
        Ok(match t.kind {
            Kind::Encoder => Map::of(Rows::Encoder(settings::<dyn EncoderSpec>(keys)?.build()?)).built(),
            Kind::Normalizer => Map::of(Rows::Normalizer(settings::<dyn NormalizerSpec>(keys)?.build(width)?)).built(),
            Kind::Field => Map::of(Rows::Field(settings::<dyn FieldSpec>(keys)?.build(width)?)).built(),
            Kind::Projector => built!(ProjectorSpec),
            Kind::Loss => built!(LossSpec),
            Kind::Prior => built!(PriorSpec),
            Kind::Regularizer => built!(RegularizerSpec),
            Kind::DataTerm => built!(DataTermSpec),
            Kind::Basis => built!(BasisSpec),
            Kind::Initializer => Waiting::build(settings::<dyn InitializerSpec>(keys)?)?,
            other => return Err(Error::unsupported(t.name, format!("a {other} cannot come from a plugin"))),
        })
    }

    /// The host's object for `stage`.
    pub fn of<T: ?Sized + 'static>(stage: Box<T>, describe: String) -> Self {
        Self { stage: Box::new(stage), describe }
    }

    /// The stage as what a function takes.
    pub fn get<T: ?Sized + 'static>(&self) -> Result<&T> {
        self.stage.downcast_ref::<Box<T>>().map(|stage| &**stage).ok_or_else(is_no::<T>)
    }

    /// As [`Self::get`], mutable.
    pub fn get_mut<T: ?Sized + 'static>(&mut self) -> Result<&mut T> {
        self.stage.downcast_mut::<Box<T>>().map(|stage| &mut **stage).ok_or_else(is_no::<T>)
    }
}

/// The error for a stage of a different kind than requested.
fn is_no<T: ?Sized>() -> Error {
    Error::unsupported("this stage", format!("it is no {}", type_name::<T>()))
}

/// What a stage made for one grid, with the grid's shape.
pub struct OnGrid<T: ?Sized> {
    pub shape: [usize; 3],
    pub part: Box<T>,
}

/// An initializer, with its known volume.
pub struct Filling {
    pub initializer: Box<dyn Initializer>,
    pub volume: Option<KnownVolume>,
}

impl Filling {
    pub fn built(initializer: Box<dyn Initializer>) -> Built {
        let (volume, describe) = (initializer.volume(), initializer.describe());
        Built::of(Box::new(Self { initializer, volume }), describe)
    }
}

/// Settings of an initializer that names a weights file.
pub struct Waiting {
    spec: Box<dyn InitializerSpec>,
    pub path: String,
}

impl Waiting {
    /// Builds the initializer, or returns the settings if it needs a weights file.
    fn build(spec: Box<dyn InitializerSpec>) -> Result<Built> {
        let asked = RefCell::new(None);
        let built = spec.build(&|path| {
            asked.replace(Some(path.to_owned()));
            Err(Error::unsupported(path, "it is not read yet"))
        });
        match asked.into_inner() {
            Some(path) => {
                let describe = format!("waits for {path}");
                Ok(Built::of(Box::new(Self { spec, path }), describe))
            }
            None => built.map(Filling::built),
        }
    }

    /// The initializer with these weights.
    pub fn with(&self, weights: &Weights) -> Result<Built> {
        let only = |path: &str| {
            let why = || Error::unsupported(path, "an initializer from a plugin has one weights file");
            (path == self.path).then(|| weights.clone()).ok_or_else(why)
        };
        self.spec.build(&only).map(Filling::built)
    }
}

/// A stage that maps rows.
pub enum Rows {
    Encoder(Box<dyn Encoder>),
    Normalizer(Box<dyn Normalizer>),
    Field(Box<dyn Field>),
}

/// The same with properties that the host queries repeatedly.
pub struct Map {
    rows: Rows,
    pub info: ConefieldInfo,
    pub blocks: Vec<Parameter>,
    pub partition: Vec<Range<usize>>,
    /// What a reduced stage kept of the original: parameters, and channels on the other side.
    pub kept: (Vec<ConefieldRange>, Vec<usize>),
}

impl Map {
    pub fn of(rows: Rows) -> Self {
        let stage = rows.stage();
        let i = stage.info();
        let partition = if i.grads == GradKind::Scatter { stage.partition() } else { vec![] };
        let blocks = stage.parameters();
        let mut info = info(&i, blocks.len(), partition.len());
        info.coarse_to_fine = matches!(&rows, Rows::Encoder(e) if e.coarse_to_fine()).into();
        info.double_precision = stage.reference().is_some().into();
        Self { rows, info, blocks, partition, kept: (vec![], vec![]) }
    }

    pub fn built(self) -> Built {
        let describe = self.stage().describe();
        Built::of(Box::new(self), describe)
    }

    pub fn stage(&self) -> &dyn Stage {
        self.rows.stage()
    }

    pub fn encoder(&self) -> Result<&dyn Encoder> {
        match &self.rows {
            Rows::Encoder(encoder) => Ok(encoder.as_ref()),
            _ => Err(is_no::<dyn Encoder>()),
        }
    }

    /// The stage without some of its channels.
    pub fn reduced(&self, side: u32, keep: &[usize]) -> Result<Self> {
        fn of<S: ?Sized>(reduced: Reduced<S>, rows: impl FnOnce(Box<S>) -> Rows) -> Map {
            let params = reduced.params.iter().map(|r| ConefieldRange { start: r.start, end: r.end }).collect();
            Map { kept: (params, reduced.channels), ..Map::of(rows(reduced.stage)) }
        }
        Ok(match (&self.rows, side) {
            (Rows::Encoder(e), CONEFIELD_OUTPUTS) => of(e.keep_outputs(keep)?, Rows::Encoder),
            (Rows::Normalizer(n), CONEFIELD_INPUTS) => of(n.keep_inputs(keep)?, Rows::Normalizer),
            (Rows::Field(f), CONEFIELD_INPUTS) => of(f.keep_inputs(keep)?, Rows::Field),
            _ => return Err(Error::unsupported("this stage", "channels cannot be left out on that side")),
        })
    }
}

impl Rows {
    fn stage(&self) -> &dyn Stage {
        match self {
            Self::Encoder(s) => s.as_ref(),
            Self::Normalizer(s) => s.as_ref(),
            Self::Field(s) => s.as_ref(),
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
