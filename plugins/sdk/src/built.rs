//! What is behind a pointer that the host holds.

use conefield_core::prelude::*;
use conefield_core::registry::{Settings, read};
use conefield_core::settings::KnownVolume;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::any::Any;
use std::cell::RefCell;
use std::ops::Range;

/// A stage, or what a stage makes for a grid or a scan, in a box of what the functions of its table take.
pub trait Part: Any {
    /// A one-line description.
    fn describe(&self) -> String;
}

/// What functions of tables take.
pub trait Named: 'static {
    /// Its name, for errors.
    const NAME: &str;
}

impl dyn Part {
    /// The part as what a function takes.
    pub fn get<T: Named + ?Sized>(&self) -> Result<&T> {
        (self as &dyn Any).downcast_ref::<Box<T>>().map(|part| &**part).ok_or_else(|| is_no(T::NAME))
    }

    /// As [`Self::get`], mutable.
    pub fn get_mut<T: Named + ?Sized>(&mut self) -> Result<&mut T> {
        (self as &mut dyn Any).downcast_mut::<Box<T>>().map(|part| &mut **part).ok_or_else(|| is_no(T::NAME))
    }
}

/// The error for a function that does not take this stage.
fn is_no(name: &str) -> Error {
    Error::unsupported("this stage", format!("it is no {name}"))
}

/// The settings of a stage, from all keys of its table.
pub fn settings<T: Settings + ?Sized + 'static>(keys: Value) -> Result<Box<T>> {
    read(keys).map_err(|e| Error::invalid("spec", "", e, "settings of this type"))
}

/// What a stage made for one grid, with the grid's shape.
pub struct OnGrid<T: ?Sized> {
    pub shape: [usize; 3],
    pub part: Box<T>,
}

impl<T: ?Sized> OnGrid<T> {
    /// The host describes the stage instead.
    pub fn describe(&self) -> String {
        String::new()
    }
}

/// An initializer, with its known volume.
pub struct Filling {
    pub initializer: Box<dyn Initializer>,
    pub volume: Option<KnownVolume>,
}

impl Filling {
    fn of(initializer: Box<dyn Initializer>) -> Box<Self> {
        Box::new(Self { volume: initializer.volume(), initializer })
    }

    pub fn describe(&self) -> String {
        self.initializer.describe()
    }
}

/// Settings of an initializer that names a weights file.
pub struct Waiting {
    spec: Box<dyn InitializerSpec>,
    pub path: String,
}

impl Waiting {
    /// Builds the initializer, or returns the settings if it needs a weights file.
    pub fn build(spec: Box<dyn InitializerSpec>) -> Result<Box<dyn Part>> {
        let asked = RefCell::new(None);
        let built = spec.build(&|path| {
            asked.replace(Some(path.to_owned()));
            Err(Error::unsupported(path, "it is not read yet"))
        });
        Ok(match asked.into_inner() {
            Some(path) => Box::new(Box::new(Self { spec, path })),
            None => Box::new(Filling::of(built?)),
        })
    }

    /// The initializer with these weights.
    pub fn with(&self, weights: &Weights) -> Result<Box<Filling>> {
        let only = |path: &str| {
            let why = || Error::unsupported(path, "an initializer from a plugin has one weights file");
            (path == self.path).then(|| weights.clone()).ok_or_else(why)
        };
        self.spec.build(&only).map(Filling::of)
    }

    pub fn describe(&self) -> String {
        format!("waits for {}", self.path)
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

    pub fn stage(&self) -> &dyn Stage {
        self.rows.stage()
    }

    pub fn describe(&self) -> String {
        self.stage().describe()
    }

    pub fn encoder(&self) -> Result<&dyn Encoder> {
        match &self.rows {
            Rows::Encoder(encoder) => Ok(encoder.as_ref()),
            _ => Err(is_no("encoder")),
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
