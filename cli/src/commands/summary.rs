//! The record of a run as text.

use super::evaluate;
use crate::out;
use conefield::record::RunRecord;
use std::path::Path;

/// Below this share a budget counts as not used up.
const USED: f64 = 0.8;

/// The record as text.
pub fn summary(r: &RunRecord, output: &Path) -> String {
    let ([x, y, z], views) = r.scan.as_ref().map_or(([0; 3], 0), |scan| (scan.volume, scan.views));
    let speed = r.samples_per_s.map(|s| format!(" ({:.2} M samples/s)", s / 1e6)).unwrap_or_default();
    let used = views - r.held_out_views.len();
    let mut lines = vec![format!(
        "{x} x {y} x {z} voxels from {}: {} in {}{speed}, export {}",
        out::counted(used, "view"),
        out::counted(r.steps, "step"),
        out::duration(r.train_s),
        out::duration(r.written.export_s),
    )];
    if let Some(plan) = r.plan.as_ref().map(|plan| &plan.reason) {
        let point = plan.point.as_ref().map_or(String::new(), |p| format!("{p}, "));
        lines.push(format!("method: {point}spec {}, {}", r.spec, plan.why));
    }
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
        lines.push(format!(
            "held-out error  {h:.5} of the largest line integral ({}){best}",
            out::counted(views, "view")
        ));
    }
    if let Some(s) = &r.written.scores {
        lines.push(evaluate::lines(s));
    }
    if let Some(levels) = &r.hounsfield {
        lines.push(format!("volume-hu.nii.gz  {}", levels.note));
    }
    lines.push(format!("results in {}", output.display()));
    lines.join("\n")
}
