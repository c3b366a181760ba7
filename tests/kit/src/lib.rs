//! The conformance kit: checks every property of a stage that hosts rely on, and reports each.
//!
//! Gradients are compared with central differences of the stage's own forward pass: in double precision if the stage
//! has a reference kernel, otherwise coarsely in single precision. Rows for this are sampled where the stage is smooth:
//! a row is accepted only if differences over one step and over four steps agree, so that no cell boundary and no kink
//! of an activation is nearby.

mod bases;
mod behaviour;
mod call;
mod channels;
mod data_terms;
mod gradients;
mod kinds;
mod losses;
mod priors;
mod rays;
mod regularizers;
mod settings;
mod voxels;
mod weights;
mod wgsl;

use call::{Subject, failed, settle};
use conefield_core::error::Error;
use conefield_core::parallel;
use conefield_core::stage::{Encoder, Field, GradKind, Info, Normalizer, Scope, Stage};
use serde::ser::{Serialize, SerializeStruct, Serializer};
use serde_json::json;
use std::fmt;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};

pub use bases::check_basis;
pub use data_terms::check_data_term;
pub use kinds::{WIDTHS, With, check_package, check_type, tried};
pub use losses::{check_loss, check_loss_wgsl};
pub use priors::{check_prior, check_prior_wgsl};
pub use rays::check_projector;
pub use regularizers::check_regularizer;
pub use settings::check_settings;
pub use voxels::check_voxel_projector;
pub use weights::check_initializer;
pub use wgsl::{check_projector_wgsl, check_wgsl};

/// Options of the checks.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Range of the uniformly random inputs.
    pub inputs: Range<f64>,
    /// Parameters are uniformly random in ± this; `None`: initialized by the stage.
    pub params: Option<f64>,
    /// Number of rows for gradients.
    pub rows: usize,
    /// Largest relative error of double-precision gradients against differences.
    pub tolerance: f64,
    /// Largest error of single against double precision, relative to the largest output; four times as much for
    /// gradients.
    pub single: f64,
    /// Seed of all random numbers.
    pub seed: u64,
}

impl Options {
    /// For encoders: points of the unit cube, features of order one.
    pub fn encoder() -> Self {
        Self { inputs: 0.0..1.0, params: Some(0.7), rows: 24, tolerance: 1e-6, single: 2e-5, seed: 1 }
    }

    /// For normalizers and fields that read features of order one.
    pub fn features() -> Self {
        Self { inputs: -2.0..2.0, params: None, ..Self::encoder() }
    }
}

/// The outcome of a property check: the evidence that it holds, or why it is not met.
pub type Outcome = Result<String, Unmet>;

/// Why a property is not met.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Unmet {
    /// It does not hold, with the finding.
    Failed(String),
    /// It does not apply, with the reason.
    Skipped(String),
}

impl Unmet {
    /// The same, with where or when before the finding.
    fn at(self, place: String) -> Self {
        match self {
            Self::Failed(what) => Self::Failed(format!("{place}: {what}")),
            skipped => skipped,
        }
    }
}

impl From<Error> for Unmet {
    fn from(e: Error) -> Self {
        Self::Failed(e.to_string())
    }
}

/// The outcomes of all property checks of a stage, in order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Report {
    /// The stage's own description.
    pub stage: String,
    /// Name and outcome of each property.
    pub entries: Vec<(&'static str, Outcome)>,
}

impl Report {
    fn of(stage: String) -> Self {
        Self { stage, entries: vec![] }
    }

    /// Names of the violated properties.
    pub fn failed(&self) -> Vec<&'static str> {
        self.entries.iter().filter(|(_, o)| matches!(o, Err(Unmet::Failed(_)))).map(|(n, _)| *n).collect()
    }

    /// Whether every property that applies holds.
    pub fn passed(&self) -> bool {
        self.failed().is_empty()
    }

    /// Each property with its outcome in a word, and the evidence, finding or reason.
    pub fn properties(&self) -> impl Iterator<Item = (&'static str, &'static str, &str)> {
        self.entries.iter().map(|(name, outcome)| match outcome {
            Ok(text) => (*name, "passed", text.as_str()),
            Err(Unmet::Failed(text)) => (*name, "failed", text.as_str()),
            Err(Unmet::Skipped(text)) => (*name, "skipped", text.as_str()),
        })
    }

    fn add(&mut self, name: &'static str, property: impl FnOnce() -> Outcome) {
        parallel::look();
        let outcome = catch_unwind(AssertUnwindSafe(property)).unwrap_or_else(|panic| {
            let text = panic.downcast_ref::<String>().cloned();
            let text = text.or_else(|| panic.downcast_ref::<&str>().map(|s| s.to_string()));
            failed(format!("panicked: {}", text.unwrap_or_default()))
        });
        self.entries.push((name, outcome));
    }

    /// Adds a property that holds without a complaint; `fine` is the evidence.
    fn holds(&mut self, name: &'static str, fine: &str, complaint: impl FnOnce() -> Option<String>) {
        self.add(name, || settle(complaint(), fine));
    }
}

impl Serialize for Report {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let property = |(name, outcome, text)| json!({ "name": name, "outcome": outcome, "text": text });
        let mut table = to.serialize_struct("Report", 3)?;
        table.serialize_field("stage", &self.stage)?;
        table.serialize_field("properties", &self.properties().map(property).collect::<Vec<_>>())?;
        table.serialize_field("passed", &self.passed())?;
        table.end()
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.stage)?;
        for (name, outcome, text) in self.properties() {
            let word = if outcome == "failed" { "FAILED" } else { outcome };
            writeln!(f, "  {word:<8} {name:<34} {text}")?;
        }
        Ok(())
    }
}

/// A property, why it does not apply to a stage, and its check.
type Property = (&'static str, fn(&Info) -> Option<&'static str>, fn(&Subject<'_>) -> Outcome);

/// The properties that any stage must have, in order.
const PROPERTIES: [Property; 23] = [
    ("info", always, behaviour::info),
    ("parameters", always, behaviour::parameters),
    ("init", always, behaviour::init),
    ("finite differences: parameters", without_parameters, gradients::parameters),
    ("finite differences: inputs", always, gradients::inputs),
    ("single precision: outputs", always, gradients::single_outputs),
    ("single precision: gradients", always, gradients::single_gradients),
    ("tile sizes: outputs", along_rays, behaviour::tile_outputs),
    ("points off any ray", always, behaviour::points),
    ("passes", always, behaviour::passes),
    ("tile sizes: gradients", |i| along_rays(i).or(without_parameters(i)), behaviour::tile_gradients),
    ("outputs overwrite", always, behaviour::outputs_overwrite),
    ("gradients add", without_parameters, behaviour::gradients_add),
    ("input gradient overwrites", always, behaviour::input_gradient_overwrites),
    ("partition", not_scattered, behaviour::partition),
    ("partition gradients", not_scattered, behaviour::partition_gradients),
    ("guards", always, behaviour::guards),
    ("threads", always, behaviour::threads),
    ("extremes", always, behaviour::extremes),
    ("finite", along_rays, behaviour::finite),
    ("poison rows", along_rays, behaviour::poison),
    ("save and load", always, behaviour::save_and_load),
    ("no fault", always, |of| call::no_fault(of.stage.fault())),
];

fn always(_: &Info) -> Option<&'static str> {
    None
}

fn along_rays(info: &Info) -> Option<&'static str> {
    (info.scope == Scope::Ray).then_some("its rows look at each other")
}

fn without_parameters(info: &Info) -> Option<&'static str> {
    (info.params == 0).then_some("no parameters")
}

fn not_scattered(info: &Info) -> Option<&'static str> {
    (info.grads != GradKind::Scatter).then_some("gradients are not scattered")
}

/// Checks all properties that any stage must have.
pub fn check(stage: &dyn Stage, options: &Options) -> Report {
    let mut report = Report::of(stage.describe());
    let of = Subject::new(stage, options);
    for (name, skipped, property) in PROPERTIES {
        report.add(name, || match skipped(&stage.info()) {
            Some(why) => Err(Unmet::Skipped(why.into())),
            None => property(&of),
        });
    }
    report
}

/// [`check`], and the properties of an encoder's resolutions and reduced channels.
pub fn check_encoder(stage: &dyn Encoder, options: &Options) -> Report {
    let mut report = check(stage, options);
    report.add("resolutions", || channels::resolutions(stage));
    report.add("keep outputs", || channels::encoder_outputs(stage, options));
    report
}

/// [`check`], and the properties of a normalizer with reduced channels.
pub fn check_normalizer(stage: &dyn Normalizer, options: &Options) -> Report {
    let mut report = check(stage, options);
    report.add("keep inputs", || channels::normalizer_inputs(stage, options));
    report
}

/// [`check`], and the properties of a field with reduced channels.
pub fn check_field(stage: &dyn Field, options: &Options) -> Report {
    let mut report = check(stage, options);
    report.add("keep inputs", || channels::field_inputs(stage, options));
    report
}
