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

use conefield_core::stage::{Encoder, Field, Normalizer, Stage};
use std::fmt;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};

pub use bases::check_basis;
pub use data_terms::check_data_term;
pub use kinds::{WIDTHS, With, check_package, check_type};
pub use losses::{Compare, check_loss, check_loss_wgsl, ready};
pub use priors::{Penalise, check_prior, check_prior_wgsl};
pub use rays::check_projector;
pub use regularizers::check_regularizer;
pub use settings::check_settings;
pub use voxels::check_voxel_projector;
pub use weights::check_initializer;
pub use wgsl::{Pass, Sample, check_projector_wgsl, check_wgsl};

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

/// The outcome of a property check.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// It holds, with the evidence.
    Passed(String),
    /// It does not hold, with the finding.
    Failed(String),
    /// It does not apply, with the reason.
    Skipped(String),
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
    /// Names of the violated properties.
    pub fn failed(&self) -> Vec<&'static str> {
        self.entries.iter().filter(|(_, o)| matches!(o, Outcome::Failed(_))).map(|(n, _)| *n).collect()
    }

    /// Whether every property that applies holds.
    pub fn passed(&self) -> bool {
        self.failed().is_empty()
    }

    fn add(&mut self, name: &'static str, property: impl FnOnce() -> Outcome) {
        let outcome = catch_unwind(AssertUnwindSafe(property)).unwrap_or_else(|panic| {
            let text = panic.downcast_ref::<String>().cloned();
            let text = text.or_else(|| panic.downcast_ref::<&str>().map(|s| s.to_string()));
            Outcome::Failed(format!("panicked: {}", text.unwrap_or_default()))
        });
        self.entries.push((name, outcome));
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.stage)?;
        for (name, outcome) in &self.entries {
            let (word, text) = match outcome {
                Outcome::Passed(t) => ("ok", t),
                Outcome::Failed(t) => ("FAILED", t),
                Outcome::Skipped(t) => ("skipped", t),
            };
            writeln!(f, "  {word:<8} {name:<34} {text}")?;
        }
        Ok(())
    }
}

/// Checks all properties that any stage must have.
pub fn check(stage: &dyn Stage, options: &Options) -> Report {
    let mut report = Report { stage: stage.describe(), entries: vec![] };
    report.add("info", || behaviour::info(stage, options));
    report.add("parameters", || behaviour::parameters(stage));
    report.add("init", || behaviour::init(stage, options));
    report.add("finite differences: parameters", || gradients::parameters(stage, options));
    report.add("finite differences: inputs", || gradients::inputs(stage, options));
    report.add("single precision: outputs", || gradients::single_outputs(stage, options));
    report.add("single precision: gradients", || gradients::single_gradients(stage, options));
    report.add("tile sizes: outputs", || behaviour::tile_outputs(stage, options));
    report.add("points off any ray", || behaviour::points(stage, options));
    report.add("passes", || behaviour::passes(stage, options));
    report.add("tile sizes: gradients", || behaviour::tile_gradients(stage, options));
    report.add("outputs overwrite", || behaviour::outputs_overwrite(stage, options));
    report.add("gradients add", || behaviour::gradients_add(stage, options));
    report.add("input gradient overwrites", || behaviour::input_gradient_overwrites(stage, options));
    report.add("partition", || behaviour::partition(stage));
    report.add("partition gradients", || behaviour::partition_gradients(stage, options));
    report.add("guards", || behaviour::guards(stage, options));
    report.add("threads", || behaviour::threads(stage, options));
    report.add("extremes", || behaviour::extremes(stage, options));
    report.add("finite", || behaviour::finite(stage, options));
    report.add("poison rows", || behaviour::poison(stage, options));
    report.add("save and load", || behaviour::save_and_load(stage, options));
    report.add("no fault", || call::settle(stage.fault().err().map(|e| e.to_string()), "none was reported"));
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
