//! The record of a run.

use super::{EndOptions, evaluate};
use crate::out;
use conefield::machine::Machine;
use conefield::memory::Memory;
use conefield::plugins::Used;
use conefield::tradeoff::schedule::Schedule;
use conefield::tradeoff::trial::ScanRecord;
use conefield_core::backend::Explain;
use conefield_evaluation::metrics::Scores;
use serde::Serialize;
use std::path::Path;

/// Everything needed to repeat a run, and its result.
#[derive(Debug, Serialize)]
pub struct RunRecord {
    pub version: &'static str,
    pub spec: String,
    pub seed: u64,
    pub scan: ScanRecord,
    pub held_out_views: Vec<usize>,
    pub limits: EndOptions,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub budget_s: Option<f64>,
    /// The plan of a budget.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub plan: Option<Schedule>,
    pub init: Option<String>,
    pub reference: Option<String>,
    /// The plugins whose stages the spec names.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub plugins: Vec<Used>,
    pub backend: Explain,
    pub simd: String,
    pub threads: usize,
    pub machine: Machine,
    pub memory: Memory,
    pub peak_bytes: Option<u64>,
    pub steps: u64,
    /// Number of returns to an earlier state after training diverged.
    pub rollbacks: u64,
    /// Seconds to read the inputs.
    pub load_s: f64,
    /// Seconds of solving without training: before the first step, and for metrics.
    pub prepare_s: f64,
    pub train_s: f64,
    #[serde(flatten)]
    pub written: Written,
    /// Seconds from the start of the command to this record. Before a --resume only training counts.
    pub total_s: f64,
    pub samples: u64,
    /// For methods that take samples.
    pub samples_per_s: Option<f64>,
    pub loss: Option<f64>,
    /// Held-out error of the result.
    pub held_out: Option<f64>,
    /// The step of the result, if held-out views selected it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best_step: Option<u64>,
    pub peak: f64,
}

/// Written files and the time for them.
#[derive(Debug, Serialize)]
pub struct Written {
    /// Number of parameters of a field.
    pub parameters: usize,
    /// Seconds to write weights and voxels.
    pub export_s: f64,
    pub picture_s: f64,
    pub score_s: f64,
    pub scores: Option<Scores>,
}

/// Below this share a budget counts as not used up.
const USED: f64 = 0.8;

/// The record as text.
pub fn summary(r: &RunRecord, output: &Path) -> String {
    let [x, y, z] = r.scan.volume;
    let speed = r.samples_per_s.map(|s| format!(" ({:.2} M samples/s)", s / 1e6)).unwrap_or_default();
    let mut lines = vec![format!(
        "{x} x {y} x {z} voxels from {} views: {} in {}{speed}, export {}",
        r.scan.views - r.held_out_views.len(),
        if r.steps == 1 { "1 step".into() } else { format!("{} steps", r.steps) },
        out::duration(r.train_s),
        out::duration(r.written.export_s),
    )];
    if let Some(budget) = r.budget_s {
        let why = if r.total_s < USED * budget { ": the method stopped by itself" } else { "" };
        lines.push(format!("{} in all, of a budget of {}{why}", out::duration(r.total_s), out::duration(budget)));
    }
    if r.rollbacks > 0 {
        let times = if r.rollbacks == 1 { "once".into() } else { format!("{} times", r.rollbacks) };
        lines.push(format!(
            "training diverged and was rolled back {times}; each rollback halved the learning rate; metrics.jsonl has \
             the steps"
        ));
    }
    if let Some(h) = r.held_out {
        let best =
            r.best_step.map_or(String::new(), |n| format!(", the smallest: the state after step {n} is the result"));
        let views = r.held_out_views.len();
        lines.push(format!("held-out error  {h:.5} of the largest line integral ({views} views){best}"));
    }
    if let Some(s) = &r.written.scores {
        lines.push(evaluate::lines(s));
    }
    lines.push(format!("results in {}", output.display()));
    lines.join("\n")
}
